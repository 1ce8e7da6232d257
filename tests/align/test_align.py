"""A scene is moved onto a reference, and everything in it moves alike."""

from __future__ import annotations

import json
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from click.testing import CliRunner, Result

from sattools.align.estimate import ControlPoint, Shift, shift_to_dem, shift_to_points
from sattools.align.stage import Move, _write_moved
from sattools.camera.ground import project
from sattools.camera.rpc import RPC
from sattools.cli import main
from sattools.errors import InputError
from sattools.scene import Asset, Scene
from sattools.scene.grid import Grid
from sattools.scene.raster import raster_vertical, read_raster, write_cog

CRS = "EPSG:32617"
GRID = Grid(crs=CRS, left=436000.0, top=3355400.0, cell_size=1.0, width=400, height=400)
SHIFT = (3.0, -2.0, 5.0)


def run(command: str, *arguments: Any) -> Result:
    return CliRunner().invoke(main, [command, *map(str, arguments)])


def relief(x: Any, y: Any) -> Any:
    """Hills of 8 to 30 m, smooth, so that heights between cells are known [m]."""
    hills = 12 * np.sin(x / 35.0) * np.cos(y / 28.0) + 8 * np.sin(x / 71.0 + 1) + 4 * np.cos((x + y) / 19.0)
    return hills.astype(np.float32)


def surface(grid: Grid, moved: tuple[float, float, float] = (0.0, 0.0, 0.0), fine: int = 1) -> Any:
    """Means of the relief over the cells of a grid, as if it stood elsewhere."""
    small = Grid(grid.crs, grid.left, grid.top, grid.cell_size / fine, grid.width * fine, grid.height * fine)
    x, y = np.meshgrid(small.x() - 436000.0 - moved[0], small.y() - 3355000.0 - moved[1])
    heights = relief(x, y) + np.float32(moved[2])
    return heights.reshape(grid.height, fine, grid.width, fine).mean(axis=(1, 3))


@pytest.mark.parametrize("cell", [0.5, 1.0, 10.0])
def test_a_shift_is_found_to_a_third_of_a_metre_whatever_the_references_cells(cell: float) -> None:
    rng = np.random.default_rng(0)
    count = round(400 / cell)
    other = Grid(crs=CRS, left=436000.0, top=3355400.0, cell_size=cell, width=count, height=count)
    height = surface(GRID) + rng.normal(0, 0.5, GRID.shape).astype(np.float32)
    height[100:150, 200:230] += 15.0  # a building that the reference does not know
    found = shift_to_dem(height, GRID, surface(other, SHIFT, fine=10 if cell == 10 else 1), other)
    assert (found.east, found.north, found.up) == pytest.approx(SHIFT, abs=0.3)
    assert found.after < found.before


def test_height_alone_is_moved_if_asked_for() -> None:
    found = shift_to_dem(surface(GRID), GRID, surface(GRID) + 5.0, GRID, "z")
    assert (found.east, found.north) == (0.0, 0.0)
    assert found.up == pytest.approx(5.0, abs=1e-4)


def test_a_flat_reference_says_nothing_about_east_and_north() -> None:
    with pytest.raises(InputError, match="sloping cells"):
        shift_to_dem(surface(GRID), GRID, np.zeros(GRID.shape, np.float32), GRID)


def test_a_moved_camera_sees_the_same_at_the_moved_place(town_source: Scene) -> None:
    rpc = RPC.from_file(town_source.path(town_source.items[0].assets["rpc"].href))
    moved = rpc.moved(3e-5, -2e-5, 5.0)
    assert moved.projection(-81.66 + 3e-5, 30.35 - 2e-5, 10.0) == pytest.approx(rpc.projection(-81.66, 30.35, 5.0))


def control_points(scene: Scene, count: int = 6) -> list[ControlPoint]:
    """Places whose images say that the cameras stand off by `SHIFT`."""
    grid, rng = scene.require_grid(), np.random.default_rng(1)
    points = []
    for k in range(count):
        item = scene.items[k % len(scene.items)]
        rpc = RPC.from_file(scene.path(item.assets["rpc"].href))
        x, y = grid.left + rng.uniform(10, 50), grid.top - rng.uniform(10, 50)
        z = rng.uniform(-20, 0)
        column, row = project(rpc, grid.crs, x, y, z)
        there = np.array([x, y, z]) + SHIFT
        points.append(ControlPoint(f"p{k}", *map(float, there), item.id, float(column), float(row)))
    return points


def cameras(scene: Scene) -> dict[str, RPC]:
    return {item.id: RPC.from_file(scene.path(item.assets["rpc"].href)) for item in scene.items}


def test_control_points_give_all_three_directions(town_source: Scene) -> None:
    found = shift_to_points(control_points(town_source), cameras(town_source), town_source.require_grid().crs)
    assert (found.east, found.north, found.up) == pytest.approx(SHIFT, abs=1e-3)
    assert found.after < 1e-3 < found.before


def test_control_points_in_one_image_leave_a_direction_open(town_source: Scene) -> None:
    points = [p for p in control_points(town_source, 18) if p.item == town_source.items[0].id]
    with pytest.raises(InputError, match="leave a direction open"):
        shift_to_points(points, cameras(town_source), town_source.require_grid().crs)


@pytest.fixture
def exported(make_town: Any) -> Scene:
    scene: Scene = make_town()
    document = scene.output("scene.json")
    quick = ("--resolution", 2, "--coarsest", 2, "--epochs", 1, "--prior-weight", 0)
    assert run("fit", *quick, document).exit_code == 0
    assert run("export", document).exit_code == 0
    return Scene.from_file(document)


def reference_of(scene: Scene, path: Path) -> Path:
    """The scene's own surface, moved."""
    heights, grid = read_raster(scene.path(scene.products["dsm"]))
    write_cog(path, heights + np.float32(SHIFT[2]), grid.moved(SHIFT[0], SHIFT[1]))
    return path


def test_surface_maps_model_and_cameras_move_together(exported: Scene, tmp_path: Path) -> None:
    document = exported.output("scene.json")
    with_colours = exported.items[0]  # its multispectral image has the same camera here
    shutil.copy(exported.path(with_colours.assets["rpc"].href), exported.output("rpc/ms_RPC.TXT"))
    with_colours.assets["colours_rpc"] = Asset("rpc/ms_RPC.TXT", "text/plain", ["metadata"])
    exported.write()
    before, grid = read_raster(exported.path(exported.products["dsm"]))
    assert run("compare", document).exit_code == 0
    score = json.loads(exported.path("compare/errors.json").read_text())["mae"]
    result = run("align", "--to", reference_of(exported, tmp_path / "dem.tif"), document)
    assert result.exit_code == 0, result.stderr
    scene = Scene.from_file(document)
    found = scene.history[-1]["shift"]
    # the town has few slopes besides its walls, where cells of 2 m say little below a cell
    assert [found[n] for n in ("east", "north", "up")] == pytest.approx(SHIFT, abs=0.3)
    moved, there = read_raster(scene.path(scene.products["dsm"]))
    assert there == grid.moved(found["east"], found["north"])
    np.testing.assert_allclose(moved, before + found["up"], atol=1e-4)
    assert scene.require_grid() == exported.require_grid().moved(found["east"], found["north"])
    old, new = cameras(exported), cameras(scene)
    x, y = grid.left + 30, grid.top - 30
    for name, camera in old.items():
        place = (x + found["east"], y + found["north"], 3.0 + found["up"])
        assert project(new[name], CRS, *place) == pytest.approx(project(camera, CRS, x, y, 3.0), abs=1e-3)
    moved_colours = RPC.from_file(scene.path(scene.items[0].assets["colours_rpc"].href))
    assert project(moved_colours, CRS, x, y, 3.0) == pytest.approx(project(new[with_colours.id], CRS, x, y, 3.0))
    # all later commands work on, and find nothing stale: what is exported again is what was moved
    assert "errors" not in scene.products
    assert scene.products["truth_dsm"] == exported.products["truth_dsm"]
    assert run("compare", "--overwrite", document).exit_code == 0
    assert json.loads(scene.path("compare/errors.json").read_text())["mae"] == pytest.approx(score, abs=0.02)
    assert run("export", "--overwrite", document).exit_code == 0
    again, _ = read_raster(Scene.from_file(document).path("export/dsm.tif"))
    np.testing.assert_allclose(again, moved, atol=1e-4)
    # the files from before are still there, but for those that a later command replaced on demand
    assert exported.path(exported.items[0].assets["rpc"].href).exists()


def test_heights_above_a_geoid_stay_so_when_they_are_moved(tmp_path: Path) -> None:
    grid = Grid("EPSG:32617", 436000.0, 3355000.0, 1.0, 20, 20)
    write_cog(tmp_path / "dsm.tif", np.zeros(grid.shape, np.float32), grid, units="m", vertical="EPSG:5773")
    move = Move(tmp_path / "dsm.tif", "moved.tif", 5.0)
    _write_moved(Scene("A", tmp_path, [], grid), move, Shift(3.0, -2.0, 5.0, 0.1, 0.1, 100))
    assert raster_vertical(tmp_path / "moved.tif") == "EPSG:5773"
    heights, moved = read_raster(tmp_path / "moved.tif")
    assert heights[0, 0, 0] == 5.0
    assert (moved.crs, moved.left, moved.top) == ("EPSG:32617", 436003.0, 3354998.0)


def test_control_points_in_a_file(exported: Scene, tmp_path: Path) -> None:
    rows = ["name,x,y,z,item,column,row"]
    rows += [f"{p.name},{p.x},{p.y},{p.z},{p.item},{p.column},{p.row}" for p in control_points(exported)]
    (tmp_path / "points.csv").write_text("\n".join(rows))
    result = run("align", "--to", tmp_path / "points.csv", exported.output("scene.json"))
    assert result.exit_code == 0, result.stderr
    assert "moved by +3.00 m east, -2.00 m north, +5.00 m up" in result.stderr


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("name,x,y,z,item,column,row\n", "found no control point"),
        ("name,x,y,z,item,column,row\na,1,2,3,TOWN_001,4,\n", "found no row in row 1"),
        ("name,x,y,z,item,column,row\na,1,2,nan,TOWN_001,4,5\n", "not finite in row 1"),
        ("name,x,y,z,item,column,row\na,1,two,3,TOWN_001,4,5\n", "no number in row 1"),
        ("name,x,y,z,item,column,row\na,436000,3355000,3,NOBODY,4,5\n", "found image 'NOBODY'"),
    ],
)
def test_bad_control_points_are_told_and_nothing_is_written(
    exported: Scene, tmp_path: Path, text: str, message: str
) -> None:
    (tmp_path / "points.csv").write_text(text)
    document = exported.output("scene.json")
    old = document.read_bytes()
    result = run("align", "--to", tmp_path / "points.csv", document)
    assert result.exit_code == 1
    assert message in result.stderr
    assert document.read_bytes() == old
    assert not exported.path("align").exists()


def test_a_shift_that_is_too_large_is_refused(exported: Scene, tmp_path: Path) -> None:
    reference = reference_of(exported, tmp_path / "dem.tif")
    result = run("align", "--to", reference, "--max-shift", "2", exported.output("scene.json"))
    assert result.exit_code == 1
    assert "vertical datums" in result.stderr
    assert run("align", exported.output("scene.json")).exit_code == 1
