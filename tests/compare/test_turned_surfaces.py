"""Surfaces whose cells are turned, oblong or stored from another corner are taken as references are."""

import json
import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import rasterio
from affine import Affine
from click.testing import CliRunner

from sattools.cli import main
from sattools.compare.truth import read_reference
from sattools.scene import Grid
from sattools.scene.raster import raster_grid, write_cog
from sattools.scene.warped import ground_grid

CRS = "EPSG:32617"
GRID = Grid(CRS, 436000.0, 3357800.0, 1.0, 120, 90)
MIDDLE = 436060.0, 3357755.0
Heights = Callable[[Any, Any], Any]


def plane(x: Any, y: Any) -> Any:
    return 20.0 + 0.25 * (x - MIDDLE[0]) + 0.5 * (y - MIDDLE[1])


def waves(x: Any, y: Any) -> Any:
    """5 m high, 40 m long east and north: its second derivatives are 5 (2 pi / 40)^2 = 0.123 / m at most."""
    return 5.0 * np.sin(2 * np.pi * (x - MIDDLE[0]) / 40) * np.cos(2 * np.pi * (y - MIDDLE[1]) / 40)


def heap(x: Any, y: Any) -> Any:
    """8 m higher on a square of 20 m; the ground itself rises to the east."""
    inside = (abs(x - MIDDLE[0]) < 10) & (abs(y - MIDDLE[1]) < 10)
    return 0.1 * (x - MIDDLE[0]) + 8.0 * inside


def ground(x: Any, y: Any) -> Any:
    return 0.1 * (x - MIDDLE[0]) + 0.0 * y


def stored(path: Path, heights: Heights, place: Affine, shape: tuple[int, int] = (200, 200)) -> str:
    """A raster that says at its cells' centres what a function says, wherever they lie."""
    col, row = np.meshgrid(np.arange(shape[1]) + 0.5, np.arange(shape[0]) + 0.5)
    x, y = place.a * col + place.b * row + place.c, place.d * col + place.e * row + place.f
    about: dict[str, Any] = {"width": shape[1], "height": shape[0], "count": 1, "dtype": "float32", "crs": CRS}
    with rasterio.open(path, "w", driver="GTiff", transform=place, **about) as data:
        data.write(heights(x, y).astype(np.float32), 1)
    return str(path)


def turned(degrees: float, cell: tuple[float, float] = (1.0, 1.0)) -> Affine:
    """200 x 200 cells around the middle of the grid; 30 degrees leave all of the grid within."""
    around = Affine.translation(*MIDDLE) @ Affine.rotation(degrees) @ Affine.scale(cell[0], -cell[1])
    return around @ Affine.translation(-100, -100)


def on_grid(path: Path, heights: Heights) -> str:
    x, y = np.meshgrid(GRID.x(), GRID.y())
    write_cog(path, heights(x, y).astype(np.float32), GRID)
    return str(path)


def ran(*arguments: str) -> Any:
    result = CliRunner().invoke(main, arguments)
    assert result.exit_code == 0, result.stderr
    return json.loads(result.stdout)


@pytest.mark.parametrize(
    "place",
    [
        turned(30), turned(30, (1.0, 1.3)), turned(90), turned(180), turned(0, (1.0, 1.3)), turned(0, (1.0, -1.0)),
        turned(0, (-1.0, 1.0)), turned(0) @ Affine.shear(10),
    ],
    ids=["turned", "turned and oblong", "quarter", "half", "oblong", "south first", "east first", "sheared"],
)  # fmt: skip
def test_a_surface_is_scored_however_its_cells_lie(tmp_path: Path, place: Affine) -> None:
    """Interpolation keeps a plane: what is left are roundings of float32 and of GDAL's weights."""
    reference = on_grid(tmp_path / "reference.tif", plane)
    surface = stored(tmp_path / "surface.tif", lambda x, y: plane(x, y) + 1.5, place)
    figures = ran("compare", "--predicted", surface, "--dsm", reference, "--register", "none")
    assert figures["completeness"] == 1.0
    assert (figures["mae"], figures["median"]) == pytest.approx((1.5, 1.5), abs=1e-4)
    assert figures["nmad"] == pytest.approx(0.0, abs=1e-4)


def test_a_surface_that_is_turned_has_the_figures_of_the_same_one_that_is_not(tmp_path: Path) -> None:
    """Between cells of 1 m a bilinear value of the waves is off by 1/8 (0.123 + 0.123) m = 0.031 m at most."""
    reference = on_grid(tmp_path / "reference.tif", waves)

    def surface(x: Any, y: Any) -> Any:  # 3 m too far east, 2 m too far south, too high, and tilted
        return waves(x - 3.0, y + 2.0) + 1.5 + 0.02 * (x - MIDDLE[0])

    straight = stored(tmp_path / "straight.tif", surface, turned(0))
    oblique = stored(tmp_path / "oblique.tif", surface, turned(30))
    figures = {name: ran("compare", "--predicted", name, "--dsm", reference) for name in (straight, oblique)}
    # 0.02 of 30 m in the mean, and 0.02 of 3 m where it is moved back to
    assert figures[straight]["shift_m"] == pytest.approx([-3.0, 2.0, -1.56], abs=0.01)
    assert figures[straight]["mae"] == pytest.approx(0.6, abs=0.02)
    assert figures[oblique]["shift_m"] == pytest.approx(figures[straight]["shift_m"], abs=0.031)
    for name in ("mae", "rmse", "median", "nmad"):
        assert figures[oblique][name] == pytest.approx(figures[straight][name], abs=0.031)


@pytest.mark.parametrize("oblique", ["before", "after", "both"])
def test_changes_of_surfaces_that_are_turned_are_those_of_the_ground(tmp_path: Path, oblique: str) -> None:
    """Of a wall that runs across cells each has its share: areas are right to half a cell of 80 m of walls."""
    dates = []
    for name, heights in (("before", ground), ("after", heap)):
        path = tmp_path / f"{name}.tif"
        dates.append(stored(path, heights, turned(30)) if oblique in (name, "both") else on_grid(path, heights))
    table = ran("change", *dates, "--out", str(tmp_path / "out"), "--register", "none")
    (region,) = table["regions"]
    assert region["area_m2"] == pytest.approx(400, abs=40)
    assert region["volume_m3"] == pytest.approx(8 * 400, rel=0.05)
    grid = raster_grid(tmp_path / "out" / "height_change.tif")
    assert grid.crs == CRS
    assert grid.cell_size == pytest.approx(1.0, abs=1e-6)  # north-up cells of the area of the earlier date's
    if oblique == "after":
        assert grid == GRID


def test_a_reference_that_is_turned_keeps_its_relief(tmp_path: Path) -> None:
    """To the 0.031 m of a bilinear value; it lost twice as much, more than cells of its size can."""
    truth = read_reference(stored(tmp_path / "turned.tif", waves, turned(30)))
    x, y = np.meshgrid(truth.grid.x(), truth.grid.y())
    inside = (abs(x - MIDDLE[0]) < 60) & (abs(y - MIDDLE[1]) < 60)
    assert np.abs(truth.heights - waves(x, y))[inside].max() < 0.031


def test_cells_for_a_raster_that_is_turned_are_as_large_as_its_own(tmp_path: Path) -> None:
    """Its box is (cos 30 + sin 30)^2 = 1.87 times as large, of which the corners are empty."""
    path = Path(stored(tmp_path / "turned.tif", plane, turned(30, (0.5, 2.0))))
    grid = ground_grid(path, lambda lon, lat: CRS)
    assert grid.cell_size == pytest.approx(1.0, abs=1e-9)
    wide = 200 * (0.5 * math.cos(math.radians(30)) + 2.0 * math.sin(math.radians(30)))
    assert grid.width == pytest.approx(wide, abs=2)


def test_a_surface_of_no_place_is_refused_in_one_line(tmp_path: Path) -> None:
    reference = on_grid(tmp_path / "reference.tif", plane)
    with rasterio.open(tmp_path / "nowhere.tif", "w", "GTiff", 9, 9, 1, dtype="float32", transform=turned(30)) as data:
        data.write(np.zeros((1, 9, 9), np.float32))
    for command in (
        ("compare", "--predicted", str(tmp_path / "nowhere.tif"), "--dsm", reference),
        ("change", str(tmp_path / "nowhere.tif"), reference, "--out", str(tmp_path / "out")),
    ):
        result = CliRunner().invoke(main, command)
        assert result.exit_code == 1
        assert "nowhere.tif: found no coordinate reference system" in result.stderr
        assert result.stderr.count("\n") == 1
