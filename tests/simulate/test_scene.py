"""A whole simulated scene."""

import ast
import hashlib
import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from click.testing import CliRunner

import sattools.simulate
from sattools.camera.ground import project
from sattools.camera.rpc import RPC
from sattools.cli import main
from sattools.compare import read_dfc2019, read_reference
from sattools.errors import OutputExistsError
from sattools.scene import Grid, Scene
from sattools.scene.raster import heights_above, read_image, read_raster
from sattools.simulate import SimulateOptions, simulate
from sattools.simulate.stage import check_start, plan_views

SMALL = {"size": 48.0, "views": 3, "dates": 2, "bias_px": 2.0, "gsd": 0.5, "test_views": 1}


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Scene:
    return simulate(SimulateOptions(**SMALL), tmp_path_factory.mktemp("sim"))


def digest(folder: Path) -> dict[str, str]:
    """Check sum of every file below a folder."""
    files = sorted(p for p in folder.rglob("*") if p.is_file())
    return {str(p.relative_to(folder)): hashlib.sha256(p.read_bytes()).hexdigest() for p in files}


def test_document_survives_a_round_trip_and_names_existing_files(scene: Any) -> None:
    again = Scene.from_json(scene.to_json())
    assert [item.id for item in again.items] == ["SIM_001_001", "SIM_001_002", "SIM_001_003"]
    for item in again.items:
        for asset in item.assets.values():
            assert again.path(asset.href).is_file(), asset.href
    for href in again.products.values():
        assert again.path(href).is_file()
    assert sum(item.role == "test" for item in again.items) == 1


def test_images_are_eleven_bit_numbers_with_contrast_and_hardly_any_saturation(scene: Any) -> None:
    for item in scene.items:
        image = read_image(scene.path(item.assets["image"].href))
        assert image.shape[0] == 3
        assert image.max() <= 2047
        assert (image == 2047).mean() < 0.001
        low, high = np.percentile(image, (5, 95))
        assert high > 3 * low


def test_rpc_of_the_scene_is_exact_and_that_of_the_image_has_the_bias(scene: Any) -> None:
    for item in scene.items:
        true = RPC.from_file(scene.path(item.assets["rpc"].href))
        tagged = RPC.from_file(scene.path(item.assets["image"].href))
        metadata = RPC.from_file(scene.path(item.assets["metadata"].href))
        bias = item.properties["sattools:simulated"]["rpc_bias_px"]
        assert 0 < np.hypot(*bias) <= 2
        at = (-81.66, 30.35, -20.0)
        delta = np.subtract(tagged.projection(*at), true.projection(*at))
        assert delta == pytest.approx(bias, abs=1e-5)
        assert metadata.projection(*at) == pytest.approx(tagged.projection(*at), abs=1e-9)
        assert item.properties["sattools:simulated"]["rpc_fit_error_px"] < 0.001


def test_true_heights_say_that_they_are_above_the_ellipsoid(scene: Any) -> None:
    """So that `compare` warns of a surface above a geoid."""
    assert heights_above(scene.path(scene.products["truth_dsm"])) == "ellipsoid"
    assert heights_above(scene.path(scene.products["truth_dtm"])) == "ellipsoid"
    assert heights_above(scene.path(scene.products["truth_classes"])) is None


def test_heights_seen_by_a_view_agree_with_the_truth_where_its_pixels_lie(scene: Any) -> None:
    """Carry truth cells into a view: where the view sees a roof or the ground, both give one height."""
    truth, grid = read_raster(scene.path(scene.products["truth_dsm"]))
    east, north = np.meshgrid(grid.x(), grid.y())
    for item in scene.items:
        rpc = RPC.from_file(scene.path(item.assets["rpc"].href))
        seen = read_image(scene.path(item.assets["truth_height"].href))[0]
        col, row = project(rpc, grid.crs, east, north, truth[0])
        c, r = np.rint(col).astype(int), np.rint(row).astype(int)
        assert c.min() >= 0
        assert r.min() >= 0
        assert c.max() < seen.shape[1]
        assert r.max() < seen.shape[0]
        difference = seen[r, c] - truth[0]
        # hidden cells show what stands before them, which is higher: nothing may be seen through a surface
        assert np.quantile(np.abs(difference), 0.6) < 0.15
        # rounding to whole pixels touches the far side of edges and crowns in a few cells
        assert (difference < -0.5).mean() < 0.05


def test_numbers_of_sunlit_ground_are_its_reflectance_seen_through_the_cameras(scene: Any) -> None:
    """Reflectance carried into each view by its RPC explains the numbers there, band by band."""
    truth, grid = read_raster(scene.path(scene.products["truth_dsm"]))
    albedo, _ = read_raster(scene.path(scene.products["truth_albedo"]))
    classes, _ = read_raster(scene.path(scene.products["truth_classes"]))
    east, north = np.meshgrid(grid.x(), grid.y())
    for item in scene.items:
        rpc = RPC.from_file(scene.path(item.assets["rpc"].href))
        image, lit, seen = (
            read_image(scene.path(item.assets[name].href)) for name in ("image", "truth_lit", "truth_height")
        )
        col, row = (np.rint(v).astype(int) for v in project(rpc, grid.crs, east, north, truth[0]))
        use = (classes[0] == 2) & (lit[0, row, col] == 1) & (np.abs(seen[0, row, col] - truth[0]) < 0.1)
        assert use.sum() > 1000
        for band in range(3):
            likeness = {
                (dr, dc): np.corrcoef(image[band, row + dr, col + dc][use], albedo[band][use])[0, 1]
                for dr, dc in ((0, 0), (0, 1), (0, -1), (1, 0), (-1, 0))
            }
            # a pixel is the mean of some four cells, of which one is compared: that costs a part of the fine grain
            assert likeness[0, 0] > 0.85
            # one pixel aside it must be worse, or the cameras would be off by half a pixel
            assert likeness[0, 0] > max(v for k, v in likeness.items() if k != (0, 0)) + 0.1


def test_truth_reads_as_reference_in_both_layouts(scene: Any) -> None:
    contest = read_dfc2019(scene.root / "truth", "SIM_001")
    plain = read_reference(scene.path(scene.products["truth_dsm"]), scene.path(scene.products["truth_classes"]))
    assert contest.grid == plain.grid == scene.grid
    np.testing.assert_array_equal(contest.heights, plain.heights)
    np.testing.assert_array_equal(contest.classes, plain.classes)
    assert {2, 6} <= set(np.unique(plain.classes))
    low, high = scene.height_range_m
    assert low < plain.heights.min() < plain.heights.max() < high


def test_suns_come_from_dates_and_metadata_gives_the_same(scene: Any) -> None:
    for item in scene.items:
        document = json.loads(scene.path(item.assets["metadata"].href).read_text())
        azimuth, elevation = item.sun
        assert 90 < azimuth < 180  # mornings
        assert 25 < elevation < 75
        assert float(document["sun_azimuth"]) == pytest.approx(azimuth, abs=1e-3)
        assert float(document["sun_elevation"]) == pytest.approx(elevation, abs=1e-3)
        assert document["acquisition_date"][:4] == item.properties["datetime"][:4]
    assert len({item.properties["datetime"][:10] for item in scene.items}) == 2


def test_same_seed_same_files_other_seed_other_city(scene: Any, tmp_path: Path) -> None:
    same = simulate(SimulateOptions(**SMALL), tmp_path / "same")
    assert digest(same.root) == digest(scene.root)
    other = simulate(SimulateOptions(**SMALL | {"views": 1, "seed": 1}), tmp_path / "other")  # its ground alone counts
    a, b = (read_raster(s.path(s.products["truth_dsm"]))[0] for s in (scene, other))
    assert np.abs(a - b).max() > 3


@pytest.mark.parametrize(
    ("views", "asked", "held"),
    [
        (12, 3, [1, 5, 9]),
        (12, 5, [1, 3, 5, 8, 10]),
        (12, 7, [1, 2, 4, 6, 7, 9, 11]),
        (5, 0, []),
        (4, 12, [1, 2, 3]),  # one is for training
        (1, 1, []),
    ],
)
def test_as_many_views_as_asked_for_are_held_out(views: int, asked: int, held: list[int]) -> None:
    options = SimulateOptions(views=views, test_views=asked, size=40)
    grid = Grid("EPSG:32617", 436000.0, 3357000.0, 0.5, 80, 80)
    planned = plan_views(options, grid, (-22.0, 10.0), np.random.default_rng(0))
    assert [k for k, view in enumerate(planned) if view.role == "test"] == held


def test_more_test_views_than_views_are_told(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    check_start(SimulateOptions(views=4, test_views=12), tmp_path)
    assert "--test-views: found 12 of 4 views, one of which is for training" in caplog.text


def test_a_given_surface_has_no_streets_for_cars(tmp_path: Path) -> None:
    arguments = ["simulate", "--dsm", "dsm.tif", "--cars", "3", "--out", str(tmp_path)]
    refused = CliRunner().invoke(main, arguments)
    assert refused.exit_code == 2
    assert "--cars: found --dsm, expected none" in refused.stderr


def test_eight_bit_images_are_tone_mapped(tmp_path: Path) -> None:
    options = SimulateOptions(**{**SMALL, "size": 32.0, "views": 1, "bits": 8})
    scene = simulate(options, tmp_path)
    image = read_raster_dtype(scene.path(scene.items[0].assets["image"].href))
    assert image == "uint8"


def read_raster_dtype(path: Path) -> str:
    import rasterio

    with rasterio.open(path) as data:
        return str(data.dtypes[0])


def test_an_existing_scene_is_not_replaced_unasked(tmp_path: Path) -> None:
    runner = CliRunner()
    arguments = ["simulate", "--out", str(tmp_path / "s"), "--size", "32", "--gsd", "1", "--views", "1"]
    first = runner.invoke(main, arguments)
    assert first.exit_code == 0, first.output
    document = json.loads(first.stdout)
    assert document["sattools"]["history"][0]["command"] == "simulate"
    assert document["sattools"]["history"][0]["rpc_fit_error_px"] < 0.001
    second = runner.invoke(main, arguments)
    assert second.exit_code == 1
    assert "--overwrite" in second.stderr
    assert runner.invoke(main, [*arguments, "--overwrite"]).exit_code == 0
    with pytest.raises(OutputExistsError):
        simulate(SimulateOptions(), tmp_path / "s/SIM_001")


def test_views_of_an_earlier_world_go_with_it_and_files_of_others_stay(tmp_path: Path) -> None:
    """`prep X/images` reads the whole folder and would mix two worlds."""

    def made(*more: str) -> Any:
        world = ["simulate", "--out", str(tmp_path), "--id", "X", "--size", "32", "--gsd", "1"]
        return CliRunner().invoke(main, [*world, *more])

    def names(folder: str) -> list[str]:
        return sorted(path.name for path in (tmp_path / "X" / folder).iterdir())

    assert made("--views", "3", "--pan", "2").exit_code == 0
    (tmp_path / "X/images/mine_003.tif").write_text("mine")
    (tmp_path / "X/images/X_003.tif.aux.xml").write_text("of another program")
    before = digest(tmp_path / "X/images")
    assert made("--views", "0", "--overwrite").exit_code != 0  # nothing new: nothing goes
    assert digest(tmp_path / "X/images") == before
    assert made("--views", "2", "--overwrite").exit_code == 0
    assert names("images") == ["X_001.tif", "X_002.tif", "X_003.tif.aux.xml", "mine_003.tif"]
    assert names("metadata") == ["X_001.json", "X_002.json"]
    assert names("rpc") == ["X_001_RPC.TXT", "X_002_RPC.TXT"]
    assert names("truth/views") == ["X_001_HEIGHT.tif", "X_001_LIT.tif", "X_002_HEIGHT.tif", "X_002_LIT.tif"]
    assert names("colours") == names("truth/rpc") == []


def test_simulation_imports_nothing_of_the_renderer_that_it_tests() -> None:
    folder = Path(sattools.simulate.__file__).parent
    imported = set()
    for file in folder.glob("*.py"):
        for node in ast.walk(ast.parse(file.read_text(encoding="utf-8"))):
            if isinstance(node, ast.Import):
                imported |= {alias.name for alias in node.names}
            elif isinstance(node, ast.ImportFrom):
                imported.add(node.module or "")
    forbidden = ("torch", "sattools.render", "sattools.field", "sattools.fit", "sattools.prior", "sattools.reflectance")
    assert [name for name in imported if name.startswith(forbidden)] == []
    code = "import sys, sattools.simulate.stage, sattools.simulate.trace; sys.exit('torch' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0
