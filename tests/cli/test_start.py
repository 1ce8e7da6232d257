"""The command starts at once and explains itself."""

import os
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
import rasterio
from click.testing import CliRunner

from sattools.cli import COMMANDS, main

ROOT = Path(__file__).parents[2]
PRESENT = main.list_commands(None)


@pytest.mark.parametrize("name", ["", *PRESENT])
def test_help_loads_no_heavy_library(name: Any) -> None:
    code = (
        "import sys; from sattools.cli import main; main(sys.argv[1:], standalone_mode=False); "
        "heavy = {'torch', 'numpy', 'rasterio', 'shapely', 'geopandas', 'matplotlib', 'numba', 'cv2', 'erfa'}; "
        "print('loaded', sorted(heavy & set(sys.modules)))"
    )
    arguments = [name, "--help"] if name else ["--help"]
    done = subprocess.run([sys.executable, "-c", code, *arguments], check=True, capture_output=True, text=True)
    assert done.stdout.endswith("loaded []\n")


def test_all_commands_are_listed_and_described() -> None:
    result = CliRunner().invoke(main, ["--help"])
    assert result.exit_code == 0
    for name in PRESENT:
        assert name in COMMANDS
        assert COMMANDS[name] in " ".join(result.stdout.split())
        assert CliRunner().invoke(main, [name, "--help"]).exit_code == 0


def test_version() -> None:
    from sattools import __version__

    assert CliRunner().invoke(main, ["--version"]).stdout == f"sattools, version {__version__}\n"


@pytest.mark.parametrize("shell", ["bash", "zsh", "fish"])
def test_completion_scripts_are_printed(shell: Any) -> None:
    environment = {**os.environ, "_SATTOOLS_COMPLETE": f"{shell}_source"}
    if shell == "bash" and not shutil.which("bash"):
        pytest.skip("click asks bash for its version")
    program = Path(sys.executable).with_name("sattools")
    done = subprocess.run([program], env=environment, capture_output=True, text=True, check=True)
    assert "_SATTOOLS_COMPLETE" in done.stdout


def test_every_option_is_in_the_document_of_commands() -> None:
    """If this fails: `make docs`."""
    text = (ROOT / "docs/commands.md").read_text(encoding="utf-8")
    sections = dict(part.split("\n", 1) for part in text.split("\n## ")[1:])
    for name in PRESENT:
        for parameter in main.get_command(None, name).params:
            if parameter.param_type_name == "option":
                assert parameter.opts[0] in sections[name], f"{name} {parameter.opts[0]}"


def test_small_matrices_get_one_thread_unless_the_user_wants_more() -> None:
    code = "import os; from sattools.cli import set_threads; set_threads(4); print(os.environ['OPENBLAS_NUM_THREADS'])"
    plain = {k: v for k, v in os.environ.items() if "THREADS" not in k}
    for extra, expected in (({}, "1"), ({"OPENBLAS_NUM_THREADS": "3"}, "3")):
        done = subprocess.run(
            [sys.executable, "-c", code], env=plain | extra, capture_output=True, text=True, check=True
        )
        assert done.stdout.split() == [expected]


def test_images_are_filtered_by_as_many_threads_as_asked_for() -> None:
    code = "from sattools.cli import set_threads; set_threads(1); import cv2; print(cv2.getNumThreads())"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.split() == ["1"]


def test_gdal_keeps_no_share_of_the_machine_of_what_it_has_read() -> None:
    code = (
        "from sattools.cli import main\n"
        "try: main(['info', 'nowhere.json'])\n"
        "except SystemExit: from rasterio._env import get_gdal_config; print(get_gdal_config('GDAL_CACHEMAX'))"
    )
    environment = {k: v for k, v in os.environ.items() if k != "GDAL_CACHEMAX"}
    for given, kept in (({}, 16 << 20), ({"GDAL_CACHEMAX": "300"}, 300 << 20)):
        done = subprocess.run(
            [sys.executable, "-c", code], env=environment | given, capture_output=True, text=True, check=True
        )
        assert done.stdout.split()[-1] == str(kept)


@pytest.mark.parametrize(
    ("name", "shown"),
    [
        ("MPLBACKEND", "matplotlib.get_backend(auto_select=False)"),
        ("PROJ_DATA", "rasterio.crs.CRS.from_epsg(32617).is_projected"),
        ("PROJ_LIB", "rasterio.crs.CRS.from_epsg(32617).is_projected"),
    ],
)
def test_what_other_programs_want_of_their_libraries_does_not_count(name: str, shown: str, tmp_path: Path) -> None:
    if not (Path(rasterio.__file__).parent / "proj_data").is_dir():
        pytest.skip("rasterio has no PROJ of its own")
    code = (
        "import sys; sys.argv = ['sattools', '--version']; from sattools.cli import entry\n"
        "try: entry()\n"
        f"except SystemExit: import matplotlib, rasterio.crs; print({shown})"
    )
    environment = {**os.environ, name: str(tmp_path)}  # no backend, and no folder with PROJ's database
    done = subprocess.run([sys.executable, "-c", code], env=environment, capture_output=True, text=True, check=True)
    assert done.stdout.split()[-1] in ("None", "True")


def test_threads_are_settled_before_numerical_libraries_start() -> None:
    code = (
        "import os; from sattools.cli import set_threads; set_threads(1); "
        "print(os.environ['OMP_NUM_THREADS'], os.environ['NUMBA_NUM_THREADS'], os.environ['OMP_WAIT_POLICY']); "
        "import torch; print(torch.get_num_threads())"
    )
    environment = {k: v for k, v in os.environ.items() if "THREADS" not in k and k != "OMP_WAIT_POLICY"}
    done = subprocess.run([sys.executable, "-c", code], env=environment, capture_output=True, text=True, check=True)
    assert done.stdout.split() == ["1", "1", "PASSIVE", "1"]


def test_libraries_that_are_loaded_already_are_told_the_number_of_threads() -> None:
    code = (
        "import torch, cv2, sattools.compiled as compiled; from sattools.cli import set_threads as use; "
        "[print((use(n), torch.get_num_threads(), cv2.getNumThreads(), compiled.MOST_THREADS)[1:]) for n in (2, 1)]"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.split("\n")[:2] == ["(2, 2, 2)", "(1, 1, 1)"]
