"""Maps that are finished side by side: all there at the end, or none, as when they were finished in turns."""

import threading
import warnings
from pathlib import Path

import numpy as np
import pytest
import rasterio
from patience import HANGING_S
from rasterio.errors import NotGeoreferencedWarning

from sattools import processors
from sattools.errors import SattoolsError
from sattools.scene import Grid
from sattools.scene.cog import CogWriter, cogs
from sattools.scene.files import all_or_nothing
from sattools.scene.gdal import not_georeferenced
from sattools.scene.raster import read_raster

GRID = Grid("EPSG:32617", 0.0, 0.0, 1.0, 40, 30)


@pytest.fixture(autouse=True)
def four_threads(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(processors, "threads", lambda: 4)


def written(folder: Path) -> None:
    files = [CogWriter(folder / f"{k}.tif", GRID) for k in range(7)]
    with cogs(files):
        for k, file in enumerate(files):
            file.write(np.full(GRID.shape, k, np.float32))


def test_every_map_holds_its_own_numbers(tmp_path: Path) -> None:
    written(tmp_path)
    assert [float(read_raster(tmp_path / f"{k}.tif")[0].mean()) for k in range(7)] == [0, 1, 2, 3, 4, 5, 6]
    assert len(list(tmp_path.iterdir())) == 7


@pytest.mark.parametrize("in_memory", [1 << 20, 0])
def test_bands_that_are_named_after_colours_are_shown_in_them(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, in_memory: int
) -> None:
    monkeypatch.setattr("sattools.scene.cog.IN_MEMORY", in_memory)

    def shown(*names: str) -> list[str]:
        path = tmp_path / "map.tif"
        with CogWriter(path, GRID, bands=len(names), descriptions=names) as file:
            file.write(np.zeros((len(names), *GRID.shape), np.float32))
        with rasterio.open(path) as data:
            return [kind.name for kind in data.colorinterp]

    assert shown("w blue", "w green", "w red", "w nir") == ["blue", "green", "red", "undefined"]
    assert shown("w red", "w nir") == ["gray", "undefined"]
    assert shown("albedo 1", "albedo 2", "albedo 3") == ["red", "green", "blue"]  # as pictures have them
    assert shown("albedo 1", "albedo 2", "albedo 3", "albedo 4") == ["gray", "undefined", "undefined", "undefined"]
    assert shown("east", "north", "up") == ["gray", "undefined", "undefined"]


def test_they_appear_together_with_what_is_held_back(tmp_path: Path) -> None:
    """Whoever holds files back until all are there does so for what other threads write on its behalf, too."""
    with all_or_nothing():
        written(tmp_path)
        assert not [path for path in tmp_path.iterdir() if not path.name.startswith(".")]
    assert sorted(path.name for path in tmp_path.iterdir()) == [f"{k}.tif" for k in range(7)]


def test_one_that_cannot_be_written_is_named_and_nothing_unfinished_stays(tmp_path: Path) -> None:
    (tmp_path / "3.tif").mkdir()
    with pytest.raises(SattoolsError, match=r"3\.tif: cannot be written"):
        written(tmp_path)
    assert not [path for path in tmp_path.iterdir() if path.name.startswith(".")]


def test_an_error_in_between_writes_none(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="between"), cogs([CogWriter(tmp_path / "0.tif", GRID)]):
        raise ValueError("between")
    assert not list(tmp_path.iterdir())


def test_threads_side_by_side_leave_the_filters_of_warnings_as_they_were(tmp_path: Path) -> None:
    """The first to come goes before the second, which still hears nothing of images without a place."""
    image = tmp_path / "image.tif"
    with not_georeferenced, rasterio.open(image, "w", driver="GTiff", width=2, height=2, count=1, dtype="uint8"):
        pass
    inside, gone = threading.Event(), threading.Event()
    heard: list[str] = []

    def first() -> None:
        with not_georeferenced:
            inside.set()
            assert gone.wait(HANGING_S)

    def second() -> None:
        with not_georeferenced:
            gone.set()
            other.join(HANGING_S)
            rasterio.open(image).close()

    with warnings.catch_warnings():
        warnings.simplefilter("error", NotGeoreferencedWarning)
        before = list(warnings.filters)
        other = threading.Thread(target=first)
        other.start()
        assert inside.wait(HANGING_S)
        try:
            second()
        except NotGeoreferencedWarning as error:
            heard.append(str(error))
        assert not heard
        assert warnings.filters == before
        with pytest.raises(NotGeoreferencedWarning):
            rasterio.open(image)
