"""The ways to install: each names what the package needs, and the source archive is complete."""

import re
import shutil
import subprocess
import sys
import tarfile
import tomllib
from pathlib import Path
from typing import Any

import pytest
import yaml
from patience import HANGING_S

ROOT = Path(__file__).parents[1]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
# names on conda-forge where they differ from those on PyPI
CONDA = {
    "matplotlib": "matplotlib-base",
    "opencv-python-headless": "py-opencv",
    "torch": "pytorch-cpu",
    "lazrs": "lazrs-python",
}
EXTRAS = ("products", "batch", "notebook")


def requirement(text: str) -> tuple[str, str]:
    """Name without extras, and the versions; conda has no markers of systems."""
    name, _, versions = re.match(r"([A-Za-z0-9-]+)(\[[^]]*\])?(.*)", text.partition(";")[0].replace(" ", "")).groups()
    return name, versions


def test_conda_and_pip_ask_for_the_same() -> None:
    listed = dict(requirement(line) for line in yaml.safe_load((ROOT / "environment.yml").read_text())["dependencies"])
    wanted = [*PROJECT["dependencies"], *(line for extra in EXTRAS for line in PROJECT["optional-dependencies"][extra])]
    for text in wanted:
        name, versions = requirement(text)
        assert listed[CONDA.get(name, name)] == versions, name


def test_the_image_is_made_by_the_script_that_people_run() -> None:
    lines = [line for line in (ROOT / "Dockerfile").read_text().splitlines() if line.startswith(("RUN", "COPY"))]
    assert [line for line in lines if line.startswith("RUN")] == [
        "RUN bash /opt/sattools/install.sh products,batch,notebook && sattools doctor --slim"
    ]
    copied = " ".join(line for line in lines if line.startswith("COPY")).split()
    needed = {"pyproject.toml", PROJECT["readme"], *PROJECT["license-files"], "install.sh", "sattools"}
    assert needed <= set(copied)
    kept = {line.removeprefix("!") for line in (ROOT / ".dockerignore").read_text().splitlines() if line[:1] == "!"}
    assert needed == kept


def test_the_script_takes_the_cpu_build_before_anything_that_depends_on_torch(tmp_path: Path) -> None:
    """Run with programs in place of python3 and sattools that only say what they were asked."""
    bash = shutil.which("bash")
    if bash is None:
        pytest.skip("needs bash")
    for name in ("python3", "sattools"):
        program = tmp_path / name
        program.write_text(f'#!/bin/sh\necho {name} "$@"\n')
        program.chmod(0o755)
    path = f"{tmp_path}:/usr/bin:/bin"
    done = subprocess.run(
        [bash, str(ROOT / "install.sh")],
        env={"PATH": path},
        capture_output=True,
        text=True,
        timeout=HANGING_S,
        check=True,
    )
    said = done.stdout.splitlines()
    assert said[0].endswith("torch==2.13.0 --index-url https://download.pytorch.org/whl/cpu")
    assert said[2].endswith("install --no-cache-dir --no-compile .[products,batch,notebook]")
    assert said[-1] == "sattools doctor --try"


def test_the_versions_of_python_are_those_that_doctor_takes() -> None:
    from sattools.doctor import PYTHON

    named = {
        m[1] for c in PROJECT["classifiers"] if (m := re.fullmatch(r"Programming Language :: Python :: (3\.\d+)", c))
    }
    assert named == {f"3.{minor}" for minor in range(PYTHON[0][1], PYTHON[1][1] + 1)}


def test_the_citation_is_of_this_version() -> None:
    import sattools

    citation: Any = yaml.safe_load((ROOT / "CITATION.cff").read_text())
    assert citation["version"] == sattools.__version__
    assert citation["license"] == PROJECT["license"]


def test_the_source_archive_is_complete(tmp_path: Path) -> None:
    """Built from a copy, as building leaves files beside the source."""
    copy = tmp_path / "sattools"
    skipped = shutil.ignore_patterns(".*", "*.egg-info", "build", "dist", "demo", "__pycache__", "shared")
    shutil.copytree(ROOT, copy, ignore=skipped)
    build = "import setuptools.build_meta as b; print(b.build_sdist('.'))"
    done = subprocess.run(
        [sys.executable, "-c", build], cwd=copy, capture_output=True, text=True, timeout=HANGING_S, check=True
    )
    with tarfile.open(copy / done.stdout.splitlines()[-1]) as archive:
        names = {name.partition("/")[2] for name in archive.getnames()}
    for name in ("docs/index.md", "docs/images/demo_dsm.png", "examples/quickstart.sh", "examples/notebook.ipynb",
                 "tests/conftest.py", "tests/export/test_mesh.py", "benchmarks/fuzz.py", "Makefile", "CITATION.cff",
                 "qgis_plugin/sattools_qgis/metadata.txt", "sattools/py.typed", "install.sh"):  # fmt: skip
        assert name in names, name
