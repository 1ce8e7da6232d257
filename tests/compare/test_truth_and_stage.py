"""Reading references, and the whole comparison of a DSM with them."""

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import rasterio

from sattools.compare import (
    CompareOptions,
    Truth,
    compare,
    compare_dsm,
    compare_file,
    read_dfc2019,
    read_reference,
    table,
)
from sattools.errors import InputError, OutputExistsError, SceneError
from sattools.scene import Grid, Scene
from sattools.scene.raster import read_raster, write_cog

GRID = Grid("EPSG:32617", 436000.0, 3357800.0, 0.5, 160, 160)


def city(size: int = 160) -> np.ndarray:
    rng = np.random.default_rng(5)
    heights = np.zeros((size, size), np.float32)
    for _ in range(25):
        row, column = rng.integers(0, size - 15, 2)
        heights[row : row + rng.integers(6, 15), column : column + rng.integers(6, 15)] = rng.uniform(3, 20)
    return heights


def write_contest_tile(folder: Any, aoi: Any, heights: Any, classes: Any, corrected: Any = None) -> None:
    size = heights.shape[0]
    files = {f"{aoi}_DSM.tif": heights, f"{aoi}_CLS.tif": classes}
    if corrected is not None:
        files[f"{aoi}_CLS_v2.tif"] = corrected
    for name, array in files.items():
        with rasterio.open(
            folder / name, "w", driver="GTiff", width=size, height=size, count=1, dtype=array.dtype
        ) as data:
            data.write(array, 1)
    (folder / f"{aoi}_DSM.txt").write_text(f"436000.0\n3357720.0\n{size}.000\n0.500000\n")


def test_contest_tile_lies_where_its_text_file_says(tmp_path: Path) -> None:
    write_contest_tile(tmp_path, "JAX_068", city(), np.full((160, 160), 2, np.uint8))
    truth = read_dfc2019(tmp_path, "JAX_068")
    assert truth.grid == GRID  # the file gives the southern edge: 3357720 + 160 * 0.5 = 3357800
    assert truth.protocol == "dfc2019"


def test_a_contest_dsm_named_alone_is_read_with_its_text_file_and_classes(tmp_path: Path) -> None:
    write_contest_tile(tmp_path, "JAX_068", city(), np.full((160, 160), 9, np.uint8))
    truth = read_reference(tmp_path / "JAX_068_DSM.tif")
    assert (truth.grid, truth.protocol, truth.classes[0, 0]) == (GRID, "dfc2019", 9)


def test_a_georeferenced_dsm_of_the_contests_name_needs_no_classes(tmp_path: Path) -> None:
    write_contest_tile(tmp_path, "HAP", city(), np.full((160, 160), 2, np.uint8))
    (tmp_path / "HAP_CLS.tif").unlink()
    write_cog(tmp_path / "HAP_DSM.tif", city(), GRID)
    truth = read_reference(tmp_path / "HAP_DSM.tif")
    assert truth.grid == GRID
    assert truth.classes is None


def test_omaha_is_in_zone_15_and_other_places_are_refused(tmp_path: Path) -> None:
    for aoi in ("OMA_001", "XYZ_001"):
        write_contest_tile(tmp_path, aoi, city(), np.full((160, 160), 2, np.uint8))
    assert read_dfc2019(tmp_path, "OMA_001").grid.crs == "EPSG:32615"
    with pytest.raises(InputError, match="XYZ_001"):
        read_dfc2019(tmp_path, "XYZ_001")


@pytest.mark.parametrize(("aoi", "water"), [("JAX_004", 9), ("JAX_068", 2)])
def test_corrected_classes_replace_the_first_ones_of_two_tiles_only(tmp_path: Path, aoi: Any, water: Any) -> None:
    plain, corrected = np.full((160, 160), 2, np.uint8), np.full((160, 160), 9, np.uint8)
    write_contest_tile(tmp_path, aoi, city(), plain, corrected)
    assert read_dfc2019(tmp_path, aoi).classes[0, 0] == water


def test_contest_files_that_contradict_each_other_are_refused(tmp_path: Path) -> None:
    write_contest_tile(tmp_path, "JAX_001", city(), np.full((160, 160), 2, np.uint8))
    (tmp_path / "JAX_001_DSM.txt").write_text("436000 3357720 512 0.5")
    with pytest.raises(InputError, match="512"):
        read_dfc2019(tmp_path, "JAX_001")
    write_contest_tile(tmp_path, "JAX_002", city()[:80, :80], np.full((80, 80), 2, np.uint8))
    (tmp_path / "JAX_002_CLS.tif").rename(tmp_path / "JAX_001_CLS.tif")
    (tmp_path / "JAX_001_DSM.txt").write_text("436000 3357720 160 0.5")
    with pytest.raises(
        InputError, match=r"JAX_001_CLS\.tif: found \(80, 80\) cells, expected \(160, 160\) as in JAX_001_"
    ):
        read_dfc2019(tmp_path, "JAX_001")
    for wrong in (256.0, -1.0, 2.5):
        write_contest_tile(tmp_path, "JAX_003", city(), np.full((160, 160), wrong, np.float32))
        with pytest.raises(InputError, match=f"found {wrong:g}, expected class codes, whole numbers from 0 to 255"):
            read_dfc2019(tmp_path, "JAX_003")
    (tmp_path / "JAX_001_DSM.txt").write_text("left bottom")
    with pytest.raises(InputError, match="four numbers"):
        read_dfc2019(tmp_path, "JAX_001")
    (tmp_path / "JAX_001_DSM.txt").unlink()
    with pytest.raises(InputError, match=r"JAX_001_DSM\.txt"):
        read_dfc2019(tmp_path, "JAX_001")


def test_a_truth_that_is_no_folder_or_of_other_tiles_is_told_with_what_is_there(tmp_path: Path) -> None:
    write_contest_tile(tmp_path, "JAX_004", city(), np.full((160, 160), 2, np.uint8))
    expected = r"expected a folder with JAX_068_DSM\.tif, JAX_068_DSM\.txt and JAX_068_CLS\.tif"
    (tmp_path / "empty").mkdir()
    for place, found in (
        (tmp_path / "JAX_004_DSM.tif", rf"JAX_004_DSM\.tif: found a file, {expected} \(--dsm takes a file\)"),
        (tmp_path / "nowhere", f"nowhere: no such folder, {expected}"),
        (tmp_path / "empty", f"empty: found no tile, {expected}"),
        (tmp_path, rf"found tiles JAX_004 \(--aoi NAME takes one\), {expected}"),
    ):
        with pytest.raises(InputError, match=found):
            read_dfc2019(place, "JAX_068")


def test_no_data_values_of_a_reference_become_nan(tmp_path: Path) -> None:
    heights = city()
    heights[:10] = -9999
    write_cog(tmp_path / "ref.tif", heights, GRID, nodata=None)
    truth = read_reference(tmp_path / "ref.tif")
    assert np.isnan(truth.heights[:10]).all()
    assert np.isfinite(truth.heights[10:]).all()


def test_class_map_of_another_grid_is_carried_over_by_nearest_cell(tmp_path: Path) -> None:
    write_cog(tmp_path / "ref.tif", city(), GRID)
    classes = np.repeat(np.array([[2, 6]], np.uint8), 40, axis=1).repeat(80, axis=0)
    write_cog(tmp_path / "cls.tif", classes, GRID.resized(1.0), nodata=None)
    truth = read_reference(tmp_path / "ref.tif", tmp_path / "cls.tif")
    assert truth.classes.shape == (160, 160)
    assert (truth.classes[:, :80] == 2).all()
    assert (truth.classes[:, 80:] == 6).all()


def test_regions_are_halves_or_boxes() -> None:
    def known(region: str) -> np.ndarray:
        return np.isfinite(truth_of(np.zeros(GRID.shape, np.float32)).within(region).heights)

    assert known("west")[:, :80].all()
    assert not known("west")[:, 80:].any()
    assert known("north")[:80].all()
    assert known("436000,3357790,436010,3357800").sum() == 20 * 20
    with pytest.raises(InputError, match="region"):
        known("centre")
    with pytest.raises(InputError, match="no reference cell"):
        known("0 0 1 1")


def truth_of(heights: Any, classes: Any = None) -> Any:
    return Truth("tile", "dsm", GRID, heights, classes)


def test_shift_of_a_georeferenced_prediction_is_reported_in_metres() -> None:
    truth = truth_of(city())
    # the file says 3 m further east and 2 m further north than it should, and heights 1.25 m too high
    displaced = replace(GRID, left=GRID.left + 3.0, top=GRID.top + 2.0)
    result = compare_dsm(truth.heights + 1.25, truth, displaced)
    east, north, up = result.figures["shift_m"]
    assert (east, north) == (-3.0, -2.0)
    # mean over the cells of the overlap
    assert up == pytest.approx(-1.25, abs=1e-4)
    assert result.figures["mae"] < 1e-5
    assert compare_dsm(truth.heights + 1.25, truth, displaced, "none").figures["mae"] > 1


def test_only_the_known_half_of_a_reference_counts_and_the_rest_may_be_missing() -> None:
    heights = city()
    heights[:, 80:] = np.nan
    predicted = np.where(np.isfinite(heights), heights, np.float32(np.nan))
    figures = compare_dsm(predicted, truth_of(heights), GRID).figures
    assert figures["completeness"] == 1.0
    assert figures["cells"] == 80 * 160


def test_a_region_is_scored_alone() -> None:
    heights = city()
    predicted = heights.copy()
    predicted[:, 80:] += 7
    east = compare_dsm(predicted, truth_of(heights).within("east"), GRID, "none").figures
    west = compare_dsm(predicted, truth_of(heights).within("west"), GRID, "none").figures
    assert east["mae"] == pytest.approx(7.0, abs=1e-4)
    assert west["mae"] == 0.0
    assert west["mask"].endswith("region west")


def test_prediction_in_another_crs_and_cell_size_scores_as_well() -> None:
    y, x = np.mgrid[:160, :160] * 0.05
    truth = truth_of((5 * np.sin(x) + 4 * np.cos(y)).astype(np.float32))
    from pyproj import Transformer
    from rasterio.warp import reproject

    # the neighbouring UTM zone, where the tile is turned by some 3 degrees
    east, north = Transformer.from_crs("EPSG:32617", "EPSG:32616", always_xy=True).transform(436040.0, 3357760.0)
    grid = Grid("EPSG:32616", round(east) - 60, round(north) + 60, 1.0, 120, 120)
    other = np.full(grid.shape, np.nan, np.float32)
    reproject(
        truth.heights, other, src_transform=GRID.transform, src_crs=GRID.crs, dst_transform=grid.transform,
        dst_crs=grid.crs, dst_nodata=np.nan, resampling=1,
    )  # fmt: skip
    assert np.isfinite(other).any()
    figures = compare_dsm(other, truth, grid, "none").figures
    # two bilinear interpolations of slopes up to 0.5 m a cell
    assert figures["mae"] < 0.02
    assert figures["completeness"] > 0.97


def test_a_hole_of_the_prediction_stays_a_hole_of_the_same_size() -> None:
    heights = city()
    predicted = heights.copy()
    predicted[40:60, 40:80] = np.nan
    figures = compare_dsm(predicted, truth_of(heights), GRID).figures
    assert figures["completeness"] == pytest.approx(1 - 20 * 40 / 160**2)
    assert figures["mae_filled"] > figures["mae"]


def test_prediction_of_another_place_is_an_error() -> None:
    with pytest.raises(InputError, match="no height where the reference tile lies"):
        compare_dsm(city(), truth_of(city()), replace(GRID, left=GRID.left + 5000))


@pytest.fixture
def scene(tmp_path: Path) -> Any:
    scene = Scene("SIM_1", tmp_path / "work", grid=GRID)
    write_cog(scene.output("dsm.tif"), city() + 0.5, GRID)
    write_cog(scene.output("theta.tif"), np.full(GRID.shape, 20, np.float32), GRID)
    write_cog(scene.output("truth/SIM_1_DSM.tif"), city(), GRID)
    write_cog(scene.output("truth/SIM_1_CLS.tif"), np.full(GRID.shape, 2, np.uint8), GRID, nodata=None)
    scene.products = {"dsm": "dsm.tif", "theta": "theta.tif"}
    return scene


@pytest.mark.drawn
def test_a_map_that_claims_nothing_has_nothing_to_score(scene: Any) -> None:
    truth = scene.root / "truth"
    write_cog(scene.output("c.tif"), np.full(GRID.shape, np.nan, np.float32), GRID)
    scene.products["c"] = "c.tif"
    options = CompareOptions(
        dsm=str(truth / "SIM_1_DSM.tif"), register="none",
        map=[f"c={scene.root}/theta.tif", f"theta={scene.root}/theta.tif"],
    )  # fmt: skip
    figures = compare(options, scene)
    assert figures["parameters"]["c"]["n"] == 0
    assert figures["parameters"]["c"]["nrmse"] is None
    assert figures["parameters"]["theta"]["n"] > 0
    assert "c         no cell was determined" in table(figures)
    assert not (scene.root / "compare/scatter_c.png").exists()
    assert (scene.root / "compare/scatter_theta.png").exists()


def test_a_map_about_zero_has_its_rmse_told(scene: Any) -> None:
    for name, value in (("asymmetry", -0.05), ("TRUTH", -0.1)):
        write_cog(scene.output(f"{name}.tif"), np.full(GRID.shape, value, np.float32), GRID)
    scene.products["asymmetry"] = "asymmetry.tif"
    dsm = str(scene.root / "truth/SIM_1_DSM.tif")
    options = CompareOptions(dsm=dsm, register="none", map=[f"asymmetry={scene.root}/TRUTH.tif"])
    text = table(compare(options, scene))
    assert "asymmetry RMSE 0.050 (no NRMSE, as the reference's mean is not above 0)" in text


def test_a_map_that_the_scene_does_not_have_is_told_with_those_that_it_has(scene: Any) -> None:
    scene.products |= {"rho0": "export/rho0.tif", "dsm_picture": "export/dsm.png", "truth_dsm": "truth/SIM_1_DSM.tif"}
    with pytest.raises(SceneError, match=r"^scene SIM_1: found no product 'w', expected one of dsm, theta, rho0$"):
        compare(CompareOptions(map=["w=w.tif"]), scene)


@pytest.mark.drawn
def test_a_scene_is_scored_and_the_difference_map_written(scene: Any) -> None:
    truth = scene.root / "truth"
    options = CompareOptions(
        dsm=str(truth / "SIM_1_DSM.tif"), classes=str(truth / "SIM_1_CLS.tif"), register="none",
        map=[f"theta={scene.root}/theta.tif"],
    )  # fmt: skip
    figures = compare(options, scene)
    assert figures["mae"] == pytest.approx(0.5)
    assert figures["classes"]["ground"]["mae"] == pytest.approx(0.5)
    assert figures["parameters"]["theta"]["rmse"] == 0.0
    difference, grid = read_raster(scene.root / "compare/difference.tif")
    assert grid == GRID
    np.testing.assert_allclose(difference[0], 0.5, atol=1e-5)
    with rasterio.open(scene.root / "compare/difference.tif") as data:
        assert data.descriptions == ("height, prediction minus reference",)  # what QGIS calls the band
    assert (scene.root / "compare/difference.png").read_bytes()[:4] == b"\x89PNG"
    assert json.loads((scene.root / "compare/errors.json").read_text())["mae"] == figures["mae"]
    assert "MAE 0.500 m" in table(figures)
    with pytest.raises(OutputExistsError):
        compare(options, scene)
    compare(options, scene, overwrite=True)


def test_a_simulated_scene_brings_its_own_truth(scene: Any) -> None:
    with pytest.raises(InputError, match="no reference"):
        compare(CompareOptions(), scene)
    scene.products["truth_dsm"] = "truth/SIM_1_DSM.tif"
    assert compare(CompareOptions(), scene)["mae"] < 1e-5


def test_a_scene_without_a_dsm_is_an_error(scene: Any) -> None:
    del scene.products["dsm"]
    with pytest.raises(SceneError, match="no DSM"):
        compare(CompareOptions(dsm="x.tif"), scene)


def test_a_file_is_scored_without_a_scene(scene: Any, tmp_path: Path) -> None:
    options = CompareOptions(
        predicted=str(scene.root / "dsm.tif"), dsm=str(scene.root / "truth/SIM_1_DSM.tif"), out=str(tmp_path / "out")
    )
    figures = compare_file(options)
    assert figures["shift_m"] == pytest.approx([0.0, 0.0, -0.5])
    assert (tmp_path / "out/difference.tif").exists()


def test_lidar_of_jax_068_is_read(data_dir: Any) -> None:
    truth = read_dfc2019(data_dir / "dfc2019/Track3-Truth", "JAX_068")
    assert truth.grid.shape == (512, 512)
    assert truth.grid.cell_size == 0.5
    assert truth.grid.bounds == pytest.approx((436078.995946, 3357495.999923, 436334.995946, 3357751.999923))
    scored = np.isfinite(truth.scored())
    assert scored.sum() == 512 * 256  # the west half
    assert not scored[:, 256:].any()
    assert (np.nanmin(truth.heights), np.nanmax(truth.heights)) == pytest.approx((-21.95, 29.22), abs=0.01)
    assert set(np.unique(truth.classes)) == {2, 5, 6, 65}


def test_an_array_that_is_not_of_its_grids_shape_is_told() -> None:
    """It would be scored in another place, or as one with a hole."""
    grid = Grid("EPSG:32617", 440000.0, 3350000.0, 1.0, 30, 20)
    truth = Truth("a", "dsm", grid, np.zeros(grid.shape, np.float32))
    with pytest.raises(InputError, match=r"prediction: found shape \(19, 30\), expected \(20, 30\) as the grid has"):
        compare_dsm(np.zeros((19, 30)), truth, grid)
    with pytest.raises(InputError, match=r"measured cells: found shape \(20, 1\), expected \(20, 30\)"):
        compare_dsm(np.zeros((20, 30)), truth, grid, measured=np.ones((20, 1), bool))
