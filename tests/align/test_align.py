"""A scene is moved onto a reference, and everything in it moves alike."""

from __future__ import annotations

import json
import re
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import geopandas
import numpy as np
import pytest
import rasterio
import rasterio.warp
from affine import Affine
from align_ground import CRS
from click.testing import CliRunner, Result
from towns import copied

from sattools.align.estimate import ControlPoint, shift_to_points
from sattools.align.options import AlignOptions
from sattools.align.shift import Shift
from sattools.align.stage import Move, _check, _write_moved
from sattools.camera.ground import project, to_geographic
from sattools.camera.rpc import RPC
from sattools.cli import main
from sattools.errors import InputError
from sattools.scene import Asset, Scene
from sattools.scene.dependencies import drop
from sattools.scene.grid import Grid
from sattools.scene.raster import raster_vertical, read_raster, write_cog

SHIFT = (3.0, -2.0, 5.0)


def run(command: str, *arguments: Any) -> Result:
    return CliRunner().invoke(main, [command, *map(str, arguments)])


def test_a_moved_camera_sees_the_same_at_the_moved_place(town_source: Scene) -> None:
    rpc = RPC.from_file(town_source.path(town_source.items[0].assets["rpc"].href))
    moved = rpc.moved(3e-5, -2e-5, 5.0)
    assert moved.projection(-81.66 + 3e-5, 30.35 - 2e-5, 10.0) == pytest.approx(rpc.projection(-81.66, 30.35, 5.0))


def test_a_tilted_camera_sees_the_same_at_the_raised_place(town_source: Scene) -> None:
    rpc = RPC.from_file(town_source.path(town_source.items[0].assets["rpc"].href))
    slope = (150.0, -80.0)  # metres a degree
    rng = np.random.default_rng(0)
    lon, lat, h = -81.66 + rng.uniform(-5e-3, 5e-3, 50), 30.35 + rng.uniform(-5e-3, 5e-3, 50), rng.uniform(-30, 30, 50)
    raised = h + slope[0] * (lon + 81.66) + slope[1] * (lat - 30.35)
    seen = rpc.tilted(-81.66, 30.35, slope).projection(lon, lat, raised)
    np.testing.assert_allclose(seen, rpc.projection(lon, lat, h), atol=1e-6)


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


def test_one_mistaken_control_point_moves_nothing_and_is_named(exported: Scene, tmp_path: Path) -> None:
    points = control_points(exported, 7)
    wrong = replace(points[3], column=points[3].column + 40.0, row=points[3].row - 25.0)
    rng = np.random.default_rng(0)
    measured = [
        replace(p, column=p.column + rng.normal(0, 0.2), row=p.row + rng.normal(0, 0.2))
        for p in [*points[:3], wrong, *points[4:]]
    ]
    found = shift_to_points(measured, cameras(exported), CRS)
    assert (found.east, found.north, found.up) == pytest.approx(SHIFT, abs=0.5)
    rows = ["name,x,y,z,item,column,row"]
    rows += [f"{p.name},{p.x},{p.y},{p.z},{p.item},{p.column},{p.row}" for p in measured]
    (tmp_path / "points.csv").write_text("\n".join(rows))
    result = run("align", "--to", tmp_path / "points.csv", exported.output("scene.json"))
    assert result.exit_code == 0, result.stderr
    assert re.search(rf"control point p3 in {wrong.item} is 4\d\.\d px off", result.stderr)
    assert result.stderr.count("px off") == 1


def test_control_points_in_one_image_leave_a_direction_open(town_source: Scene) -> None:
    points = [p for p in control_points(town_source, 18) if p.item == town_source.items[0].id]
    with pytest.raises(InputError, match="leave a direction open"):
        shift_to_points(points, cameras(town_source), town_source.require_grid().crs)


@pytest.fixture(scope="module")
def exported_source(town_source: Scene, tmp_path_factory: pytest.TempPathFactory) -> Scene:
    scene = copied(town_source, tmp_path_factory.mktemp("exported") / "TOWN")
    document = scene.output("scene.json")
    quick = ("--resolution", 2, "--coarsest", 2, "--epochs", 1, "--prior-weight", 0)
    assert run("fit", *quick, document).exit_code == 0
    assert run("export", document).exit_code == 0
    return Scene.from_file(document)


@pytest.fixture
def exported(exported_source: Scene, tmp_path: Path) -> Scene:
    return copied(exported_source, tmp_path / "TOWN")


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


def test_the_picture_of_the_surface_before_it_moved_is_no_product_any_more(exported: Scene, tmp_path: Path) -> None:
    assert exported.products["dsm_picture"] == "export/dsm.png"
    document = exported.output("scene.json")
    assert run("align", "--to", reference_of(exported, tmp_path / "dem.tif"), document).exit_code == 0
    scene = Scene.from_file(document)
    assert "dsm_picture" not in scene.products
    assert "dsm_picture" in scene.history[-1]["dropped"]


def test_heights_above_a_geoid_stay_so_when_they_are_moved(tmp_path: Path) -> None:
    grid = Grid("EPSG:32617", 436000.0, 3355000.0, 1.0, 20, 20)
    write_cog(tmp_path / "dsm.tif", np.zeros(grid.shape, np.float32), grid, units="m", vertical="EPSG:5773")
    move = Move(tmp_path / "dsm.tif", "moved.tif", heights=True)
    _write_moved(Scene("A", tmp_path, [], grid), move, Shift(3.0, -2.0, 5.0, 0.1, 0.1, 100))
    assert raster_vertical(tmp_path / "moved.tif") == "EPSG:5773"
    heights, moved = read_raster(tmp_path / "moved.tif")
    assert heights[0, 0, 0] == 5.0
    assert (moved.crs, moved.left, moved.top) == ("EPSG:32617", 436003.0, 3354998.0)


def test_a_number_for_no_data_is_not_raised_with_the_heights(tmp_path: Path) -> None:
    scene = Scene("S", root=tmp_path)
    heights = np.full((20, 30), 12.0, np.float32)
    heights[:5] = -9999.0
    write_cog(tmp_path / "dsm.tif", heights, Grid("EPSG:32617", 436000.0, 3355400.0, 1.0, 30, 20), nodata=-9999.0)
    _write_moved(scene, Move(tmp_path / "dsm.tif", "align/1/dsm.tif", True), Shift(1.0, 2.0, 3.0, 0.0, 0.0, 1))
    with rasterio.open(tmp_path / "align/1/dsm.tif") as data:
        assert data.nodata == -9999.0
        found = data.read(1)
    assert (found[:5] == -9999.0).all()
    assert (found[5:] == 15.0).all()


def test_a_document_from_before_does_not_undo_an_alignment_without_a_word(
    exported: Scene, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """As `exported.json`, that a pipe has left in a file, may be given to a command again."""
    document = exported.output("scene.json")
    before = Scene.from_file(document)
    assert run("align", "--to", reference_of(exported, tmp_path / "dem.tif"), document).exit_code == 0
    result = CliRunner().invoke(main, ["export", "--overwrite"], input=before.to_json())
    assert result.exit_code == 1
    assert f"the document is older than {document}, which has been through align since" in result.stderr
    drop(before, "prior")
    before.history = before.history[:1]
    options = ["--resolution", "2", "--epochs", "1", "--prior-weight", "0", "--overwrite"]
    assert CliRunner().invoke(main, ["fit", *options], input=before.to_json()).exit_code == 0
    assert "cameras and heights are those from before `align`" in caplog.text
    assert "cameras and heights are those from before `align`" in Scene.from_file(document).history[-1]["notes"][-1]


def test_control_points_in_a_file(exported: Scene, tmp_path: Path) -> None:
    rows = ["name,x,y,z,item,column,row"]
    rows += [f"{p.name},{p.x},{p.y},{p.z},{p.item},{p.column},{p.row}" for p in control_points(exported)]
    (tmp_path / "points.csv").write_text("\n".join(rows))
    result = run("align", "--to", tmp_path / "points.csv", exported.output("scene.json"))
    assert result.exit_code == 0, result.stderr
    assert "moved by +3.00 m east, -2.00 m north, +5.00 m up" in result.stderr


def test_a_tilt_moves_surface_model_and_cameras_together(exported: Scene, tmp_path: Path) -> None:
    document = exported.output("scene.json")
    before, grid = read_raster(exported.path(exported.products["dsm"]))
    score = compared(document)
    x, y = np.meshgrid(grid.x() - grid.x().mean(), grid.y() - grid.y().mean())
    along = (4e-3, -6e-3)
    reference = (before[0] + SHIFT[2] + along[0] * x + along[1] * y).astype(np.float32)
    write_cog(tmp_path / "dem.tif", reference, grid.moved(*SHIFT[:2]))
    result = run("align", "--to", tmp_path / "dem.tif", "--tilt", document)
    assert result.exit_code == 0, result.stderr
    assert "mm/m along east and north; NMAD" in result.stderr
    assert "mm/m along east and north; NMAD" in run("info", document).stdout
    scene = Scene.from_file(document)
    shift = Shift(**scene.history[-1]["shift"])
    assert (shift.east, shift.north, shift.up) == pytest.approx(SHIFT, abs=0.3)
    assert (shift.tilt_east, shift.tilt_north) == pytest.approx(along, abs=1e-3)
    moved, _ = read_raster(scene.path(scene.products["dsm"]))
    np.testing.assert_allclose(moved[0], before[0] + shift.rise(grid), atol=1e-4)
    assert np.nanmedian(np.abs(moved[0] - reference)) < 0.1
    old, new = cameras(exported), cameras(scene)
    px, py = np.array([grid.left + 5, grid.left + 50]), np.array([grid.top - 50, grid.top - 10])
    rise = shift.up + shift.tilt_east * (px - shift.x) + shift.tilt_north * (py - shift.y)
    for name, camera in old.items():
        there = project(new[name], CRS, px + shift.east, py + shift.north, 3.0 + rise)
        np.testing.assert_allclose(there, project(camera, CRS, px, py, 3.0), atol=1e-3)
    matrix = np.array(json.loads(scene.path(scene.history[-1]["transform"]).read_text())["matrix"])
    np.testing.assert_allclose(matrix, shift.matrix())
    # the truth has not moved: registered to it in height and place, the tilt is what is left of the difference
    assert run("export", "--overwrite", document).exit_code == 0
    again, _ = read_raster(Scene.from_file(document).path("export/dsm.tif"))
    np.testing.assert_allclose(again, moved, atol=1e-3)
    assert compared(document) == pytest.approx(score, abs=0.2)


def compared(document: Path) -> float:
    assert run("compare", "--overwrite", document).exit_code == 0
    return float(json.loads((document.parent / "compare/errors.json").read_text())["mae"])


def test_a_reference_in_degrees_with_oblong_cells_is_taken(exported: Scene, tmp_path: Path) -> None:
    heights, grid = read_raster(reference_of(exported, tmp_path / "dem.tif"))
    shape = (120, 120)
    lon0, lat0 = to_geographic(CRS, grid.left - 40, grid.top + 40)
    degrees = Affine(1.5e-5, 0, lon0, 0, -1e-5, lat0)
    out = np.full(shape, -9999, np.float32)
    rasterio.warp.reproject(
        heights[0], out, src_transform=grid.transform, src_crs=CRS, src_nodata=np.nan, dst_transform=degrees,
        dst_crs="EPSG:4326", dst_nodata=-9999, resampling=rasterio.warp.Resampling.bilinear,
    )  # fmt: skip
    profile = {"driver": "GTiff", "width": shape[1], "height": shape[0], "count": 1, "dtype": "float32"}
    with rasterio.open(tmp_path / "deg.tif", "w", **profile, crs="EPSG:4326", transform=degrees, nodata=-9999) as file:
        file.write(out, 1)
    result = run("align", "--to", tmp_path / "deg.tif", exported.output("scene.json"))
    assert result.exit_code == 0, result.stderr
    found = Scene.from_file(exported.output("scene.json")).history[-1]["shift"]
    assert [found[n] for n in ("east", "north", "up")] == pytest.approx(SHIFT, abs=0.5)


def test_references_elsewhere_and_of_another_datum_are_told(exported: Scene, tmp_path: Path) -> None:
    heights, grid = read_raster(reference_of(exported, tmp_path / "dem.tif"))
    write_cog(tmp_path / "far.tif", heights, grid.moved(5000, 0))
    result = run("align", "--to", tmp_path / "far.tif", exported.output("scene.json"))
    assert result.exit_code == 1
    assert "far.tif: found no heights within 100 m of the scene" in result.stderr
    write_cog(tmp_path / "geoid.tif", heights, grid, vertical="EPSG:5773")
    result = run("align", "--to", tmp_path / "geoid.tif", exported.output("scene.json"))
    assert "heights are above different things" in result.stderr


@pytest.mark.parametrize(("left", "doubted"), [(2.28, True), (0.2, False)])
def test_a_reference_that_has_little_in_common_with_the_surface_is_doubted(
    exported: Scene, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, left: float, doubted: bool
) -> None:
    reference = reference_of(exported, tmp_path / "feet.tif")
    found = Shift(1.0, 0.0, 5.0, 21.3, 21.1, 900, left=left)
    monkeypatch.setattr("sattools.align.stage.shift_to_raster", lambda *_: (found, "icp"))
    result = run("align", "--to", reference, exported.output("scene.json"))
    doubt = (
        f"{reference}: what is left between it and the surface varies 2.3 times as much as the surface itself: are "
        "they heights of the same ground in metres?"
    )
    assert result.exit_code == 0
    assert (doubt in result.stderr) == doubted
    assert (doubt in Scene.from_file(exported.output("scene.json")).history[-1]["notes"]) == doubted


def test_control_points_in_a_geopackage(exported: Scene, tmp_path: Path) -> None:
    points = control_points(exported)
    places = geopandas.points_from_xy([p.x for p in points], [p.y for p in points], [p.z for p in points], crs=CRS)
    columns = {"name": "name", "item": "item", "column": "column", "row": "row"}
    frame = geopandas.GeoDataFrame(
        {title: [getattr(p, name) for p in points] for title, name in columns.items()}, geometry=places
    )
    frame.to_crs("EPSG:4326").to_file(tmp_path / "points.gpkg", engine="pyogrio")
    result = run("align", "--to", tmp_path / "points.gpkg", exported.output("scene.json"))
    assert result.exit_code == 0, result.stderr
    assert "moved by +3.00 m east, -2.00 m north, +5.00 m up" in result.stderr
    scene = Scene.from_file(exported.output("scene.json"))
    written = json.loads(scene.path("align/1/transform.json").read_text())["residuals"]
    assert [r["name"] for r in written] == [p.name for p in points]
    assert np.abs([r["after_px"] for r in written]).max() < 0.01 < np.abs([r["before_px"] for r in written]).max()
    # the page has the shift and the points, and the command as it may be called again
    assert run("report", exported.output("scene.json")).exit_code == 0
    page = exported.path("report.html").read_text()
    assert "Moved by +3.00 m east, -2.00 m north, +5.00 m up; NMAD" in page
    assert page.count("<td>p") == len(points)
    assert f"sattools align --to {tmp_path / 'points.gpkg'}</pre>" in page


def test_areas_are_no_control_points(exported: Scene, tmp_path: Path) -> None:
    square = geopandas.GeoSeries.from_wkt(["POLYGON((0 0, 1 0, 1 1, 0 0))"], crs=CRS)
    geopandas.GeoDataFrame(geometry=square).to_file(tmp_path / "a.gpkg", engine="pyogrio")
    result = run("align", "--to", tmp_path / "a.gpkg", exported.output("scene.json"))
    assert result.exit_code == 1
    assert "a.gpkg: found Polygon, expected points" in result.stderr


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
    result = run("align", "--to", reference, "--tilt", "--method", "z", exported.output("scene.json"))
    assert result.exit_code == 1
    assert "align: error: found --tilt with --method z, expected --method means or icp" in result.stderr


def test_a_missing_reference_is_told_before_work_and_in_a_dry_run(exported: Scene, tmp_path: Path) -> None:
    result = run("align", exported.output("scene.json"))
    assert result.exit_code == 2
    assert "Missing option '--to'" in result.stderr
    for more in ((), ("--dry-run",)):
        result = run("align", "--to", tmp_path / "nowhere.tif", *more, exported.output("scene.json"))
        assert result.exit_code == 1
        assert "nowhere.tif: no such file, expected one for --to" in result.stderr
    result = run("align", "--to", tmp_path, exported.output("scene.json"))
    assert result.exit_code == 1
    assert "found a folder, expected" in result.stderr


@pytest.mark.parametrize(
    ("east", "north", "told"),
    [(0.02, 0.01, "0.0224 m/m (0.0200 eastwards, 0.0100 northwards)"), (0.02, 0.0001, "0.0201 m/m (0.0200 eastwards")],
)
def test_a_tilt_beyond_the_limit_is_told_as_a_larger_number(east: float, north: float, told: str) -> None:
    with pytest.raises(InputError) as found:
        _check(Shift(0, 0, 0, 1, 1, 100, tilt_east=east, tilt_north=north), Path("dem.tif"), AlignOptions())
    assert str(found.value).startswith(f"dem.tif: found a tilt of {told}")
    assert "expected at most 0.02: " in str(found.value)
