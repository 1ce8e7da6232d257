"""The language of the machine changes nothing in what is written."""

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
import rasterio

WRITE = """
import numpy, rasterio, sys
with rasterio.open(sys.argv[1], "w", driver="GTiff", width=64, height=64, count=1, dtype="uint8",
                   transform=rasterio.Affine(1, 0, 5, 0, -1, 5), tiled=True,
                   blockxsize=32, blockysize=32, interleave="pixel", compress="deflate") as file:
    file.write(numpy.zeros((1, 64, 64), "uint8"))
"""
BEGUN = "import sys; from sattools.cli import compare_letters_plainly as begin; begin()\n"
PARENT = "import subprocess; subprocess.run([sys.executable, '-c', sys.argv[2], sys.argv[1]], check=True)\n"


@pytest.fixture(scope="module")
def turkish(tmp_path_factory: pytest.TempPathFactory) -> dict[str, str]:
    """An environment of Turkish, in which I is no capital of i."""
    if shutil.which("localedef") is None:
        pytest.skip("needs localedef")
    folder = tmp_path_factory.mktemp("locales")
    subprocess.run(["localedef", "-i", "tr_TR", "-f", "UTF-8", str(folder / "tr_TR.UTF-8")], capture_output=True)
    if not (folder / "tr_TR.UTF-8").exists():
        pytest.skip("needs the sources of locales")
    plain = {name: value for name, value in os.environ.items() if not name.startswith("LC_")}
    return {**plain, "LOCPATH": str(folder)}


@pytest.mark.parametrize("variable", ["LC_ALL", "LANG", "LC_CTYPE"])
@pytest.mark.parametrize("program", [BEGUN + WRITE, BEGUN + PARENT], ids=["itself", "a process that it starts"])
def test_rasters_are_written_as_they_should_be_in_turkish(
    turkish: dict[str, str], tmp_path: Path, variable: str, program: str
) -> None:
    path = tmp_path / "image.tif"
    environment = {**turkish, variable: "tr_TR.UTF-8"}
    done = subprocess.run([sys.executable, "-c", program, str(path), WRITE], env=environment, capture_output=True)
    assert done.returncode == 0, done.stderr
    with rasterio.open(path) as data:
        assert (data.block_shapes, data.compression.name) == ([(32, 32)], "deflate")
