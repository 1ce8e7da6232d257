"""Products of a fitted scene: labelled maps on the ground grid."""

import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import rasterio
import torch
from PIL import Image
from pyproj import CRS

from sattools.camera.ground import grid_direction
from sattools.compare.picture import difference_picture
from sattools.errors import InputError, OutputExistsError, SattoolsError
from sattools.export.datum import to_datum
from sattools.export.hillshade import hillshade, write_picture
from sattools.export.options import ExportOptions
from sattools.export.stage import export
from sattools.fit.checkpoint import load, save
from sattools.scene import Grid, Item, Scene
from sattools.scene.raster import read_raster, write_cog

GRID = Grid("EPSG:32617", 436000.0, 3358000.0, 1.0, 60, 40)


@pytest.fixture
def scene(tmp_path: Path) -> Any:
    """A block of 10 m on flat ground, seen by two images of which one does not know its sun."""
    height = torch.full(GRID.shape, -20.0)
    height[15:25, 30:40] = -10.0
    sun = grid_direction(90.0, 45.0, GRID.crs, -81.66, 30.35)
    scene = Scene("BLOCK", tmp_path, [Item(n, None, None, {}) for n in ("a", "b")], GRID)
    tensors = {"height": height, "height_std": height * 0 + 0.3, "albedo": torch.full((*GRID.shape, 3), 0.25)}
    meta = {
        "grid": GRID.to_dict(),
        "items": ["a", "b"],
        "suns": [[float(v) for v in sun], None],
        "shadow": "geometric",
    }
    save(tmp_path / "model", tensors, meta)
    scene.products["model"] = "model"
    return scene


def test_the_surface_model_is_a_map_with_units_and_datum(scene: Any) -> None:
    notes = export(scene, ExportOptions())
    assert notes["vertical_datum"] == "WGS84 ellipsoid"
    with rasterio.open(scene.path(scene.products["dsm"])) as data:
        assert data.tags(ns="IMAGE_STRUCTURE")["LAYOUT"] == "COG"
        assert data.units == ("m",)
        assert data.tags()["VERTICAL_DATUM"] == "WGS84 ellipsoid"
        assert data.crs.to_epsg() == 32617
        heights = data.read(1)
    assert heights.dtype == np.float32
    assert (heights[0, 0], heights[20, 35]) == (-20.0, -10.0)


def test_the_albedo_has_one_band_per_colour_and_says_its_scale(scene: Any) -> None:
    export(scene, ExportOptions())
    albedo, grid = read_raster(scene.path(scene.products["albedo"]))
    assert grid == GRID
    assert albedo.shape == (3, 40, 60)
    assert (albedo == 0.25).all()


def test_no_ground_is_darker_than_black(scene: Any) -> None:
    tensors, meta = load(scene.path("model"))
    tensors["albedo"][20, 35] = torch.tensor([-0.1, 0.0, 0.3])  # an image's offset was found wrong
    save(scene.path("model"), tensors, meta)
    export(scene, ExportOptions())
    albedo, _ = read_raster(scene.path(scene.products["albedo"]))
    assert albedo[:, 20, 35].tolist() == pytest.approx([0.0, 0.0, 0.3])
    assert (albedo[:, 0, 0] == 0.25).all()


def test_shadow_masks_show_cast_shadow_opposite_the_sun(scene: Any) -> None:
    export(scene, ExportOptions())
    mask, grid = read_raster(scene.path(scene.items[0].assets["shadow"].href))
    assert grid == GRID
    # the sun stands in the east at 45 degrees: the block's shadow reaches 10 m west
    assert mask[0, 20, 21:29].tolist() == [1] * 8
    assert mask[0, 20, 10:19].tolist() == [0] * 9
    assert mask[0, 20, 31:].max() == 0
    assert "shadow" not in scene.items[1].assets
    with rasterio.open(scene.path(scene.items[0].assets["shadow"].href)) as data:
        assert data.tags()["SOFTWARE"] == "sattools"
        assert data.tags()["METHOD"] == "cast by the DSM under the sun of the image"


def test_the_priors_probability_comes_along_on_the_cells_of_the_surface(scene: Any) -> None:
    export(scene, ExportOptions())
    assert "probability" not in scene.products
    fine = Grid(GRID.crs, GRID.left, GRID.top, GRID.cell_size / 2, 2 * GRID.width, 2 * GRID.height)
    prior = np.where(np.arange(fine.width) < GRID.width, 0.25, 0.75) * np.ones((fine.height, 1))
    write_cog(scene.output("sure.tif"), prior.astype(np.float32), fine)
    scene.products["prior_probability"] = "sure.tif"
    export(scene, ExportOptions())
    probability, grid = read_raster(scene.path(scene.products["probability"]))
    assert grid == GRID
    assert probability[0, 20, 5] == pytest.approx(0.25)
    assert probability[0, 20, -5] == pytest.approx(0.75)


def test_the_priors_errors_take_the_place_of_the_fits_noise(scene: Any) -> None:
    export(scene, ExportOptions())
    noise = read_raster(scene.path(scene.products["dsm_std"]))[0]
    assert "dsm_error95" not in scene.products
    own = np.full(GRID.shape, 0.75, np.float32)
    own[3, 4] = np.nan
    for name, values in (("prior_dsm_std", own), ("prior_dsm_error95", 4 * own)):
        write_cog(scene.output(f"{name}.tif"), values, GRID)
        scene.products[name] = f"{name}.tif"
    export(scene, ExportOptions())
    std, error95 = (read_raster(scene.path(scene.products[name]))[0][0] for name in ("dsm_std", "dsm_error95"))
    assert std[20, 5] == 0.75
    assert error95[20, 5] == 3.0
    assert std[3, 4] == noise[0, 3, 4]
    assert np.isnan(error95[3, 4])


def test_a_plain_surface_is_exported_and_aligned_without_pytorch(scene: Any) -> None:
    reference = GRID.moved(1.5, 0.0)
    bumps = np.random.default_rng(0).normal(0, 2, (8, 12)).repeat(5, 0).repeat(5, 1).astype(np.float32)
    tensors, meta = load(scene.path("model"))
    tensors["height"] = torch.from_numpy(bumps)
    save(scene.path("model"), tensors, meta)
    write_cog(scene.output("reference.tif"), bumps, reference)
    code = (
        "import sys; sys.modules['torch'] = None\n"  # whoever imports it fails
        "from sattools.scene import Scene; from sattools.export.options import ExportOptions\n"
        "from sattools.export.stage import export; from sattools.align.options import AlignOptions\n"
        "from sattools.align.stage import align\n"
        "scene = Scene.from_json(sys.stdin.read()); export(scene, ExportOptions())\n"
        "print(align(scene, AlignOptions(to='reference.tif'))['shift']['east'], scene.products['model'])"
    )
    done = subprocess.run(
        [sys.executable, "-c", code], input=scene.to_json(), cwd=scene.root, text=True, capture_output=True, check=False
    )
    assert done.returncode == 0, done.stderr
    east, model = done.stdout.split()
    assert float(east) == pytest.approx(1.5, abs=0.1)
    there, about = load(scene.path(model))
    assert about["grid"]["left"] == pytest.approx(436001.5, abs=0.1)
    torch.testing.assert_close(there["height"], torch.from_numpy(bumps), atol=0.05, rtol=0)


def test_products_need_overwrite(scene: Any) -> None:
    export(scene, ExportOptions())
    with pytest.raises(OutputExistsError, match="--overwrite"):
        export(scene, ExportOptions(), overwrite=False)


def test_files_of_an_earlier_export_beside_the_new_surface_are_named(
    scene: Any, caplog: pytest.LogCaptureFixture
) -> None:
    """Contours and ground of another surface lie in the same folder, and only the document knows."""
    export(scene, ExportOptions(products=["dtm"], contours=2.0))
    (scene.root / "export/mine.tif").write_text("of the user's own")
    caplog.clear()
    left = "export/contours.gpkg, export/dtm.tif, export/dtm_validity.tif, export/ndsm.tif"
    notes = export(scene, ExportOptions())["notes"]
    assert notes == [f"{left}: left by an earlier export, not of this surface"]
    assert f"scene BLOCK: {notes[0]}" in caplog.messages
    assert export(scene, ExportOptions(products=["dtm"], contours=2.0))["notes"] == []


def test_files_of_an_earlier_export_of_the_same_surface_are_not_called_those_of_another(scene: Any) -> None:
    """Ground first, then points: both are of one `dsm.tif`."""
    scene.history.append({"command": "export", **export(scene, ExportOptions(products=["dtm"]))})
    scene.history.append({"command": "export", **export(scene, ExportOptions(products=["ply"]))})
    assert scene.history[-1]["notes"] == []
    tensors, about = load(scene.path("model"))
    tensors["height"] += 0.5
    save(scene.path("model"), tensors, about)
    left = "export/dtm.tif, export/dtm_validity.tif, export/ndsm.tif"
    assert export(scene, ExportOptions(products=["ply"]))["notes"] == [
        f"{left}: left by an earlier export, not of this surface"
    ]


def test_a_model_of_another_kind_is_refused(scene: Any) -> None:
    save(scene.root / "model", {"weights": torch.zeros(3)}, {"field": "other"})
    with pytest.raises(InputError, match="found no 'grid', expected grid, items, suns, shadow"):
        export(scene, ExportOptions())
    assert not (scene.root / "export").exists()


def test_a_slope_towards_the_light_is_as_bright_as_lamberts_law_says() -> None:
    column = np.arange(20.0)
    east_up = np.tile(column, (20, 1))  # rises eastwards by 45 degrees: its normal leans west
    inner = (slice(2, -2), slice(2, -2))
    assert hillshade(east_up, 1.0, 270.0, 45.0)[inner] == pytest.approx(1.0)
    assert hillshade(east_up, 1.0, 90.0, 45.0)[inner] == pytest.approx(0.0, abs=1e-12)
    assert hillshade(np.zeros((20, 20)), 1.0, 12.0, 30.0) == pytest.approx(0.5)
    south_up = np.tile(column[:, None], (1, 20))  # rises southwards: its normal leans north
    assert hillshade(south_up, 1.0, 0.0, 45.0)[inner] == pytest.approx(1.0)


@pytest.mark.drawn
@pytest.mark.parametrize("height", [0.0, np.nan])
def test_surfaces_and_differences_without_a_range_are_drawn(tmp_path: Path, height: float) -> None:
    heights = np.full(GRID.shape, height, np.float32)
    write_picture(heights, GRID, "level $1", tmp_path / "dsm.png")
    difference_picture(heights, GRID, "level $1", tmp_path / "difference.png")
    for name in ("dsm", "difference"):  # a picture with axes and a colour bar, not one of a pixel
        with Image.open(tmp_path / f"{name}.png") as shown:
            assert min(shown.size) > 300


def test_heights_above_a_geoid_are_computed_or_the_missing_grid_is_named() -> None:
    """At Jacksonville the EGM96 geoid lies 28 m below the ellipsoid."""
    height = np.full(GRID.shape, -20.0, np.float32)
    try:
        found, name = to_datum(height, GRID, "egm96")
    except SattoolsError as error:
        assert "expected us_nga_egm96_15.tif" in str(error)  # noqa: PT017
        return
    assert name == "EGM96 geoid"
    assert found == pytest.approx(8.5, abs=1.5)


def test_the_uncertainty_is_a_map_in_metres_on_the_grid_of_the_surface(scene: Any) -> None:
    export(scene, ExportOptions())
    std, grid = read_raster(scene.path(scene.products["dsm_std"]))
    assert grid == GRID
    assert std.shape == (1, 40, 60)
    assert (std == np.float32(0.3)).all()


def test_heights_above_a_geoid_are_in_a_compound_crs_and_the_other_maps_are_not(
    scene: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("sattools.export.surface_files.to_datum", lambda height, *_: (height + 28.0, "EGM96 geoid"))
    monkeypatch.setattr("sattools.export.stage.check_datum", lambda *_: None)
    export(scene, ExportOptions(vertical="egm96"))
    with rasterio.open(scene.path(scene.products["dsm"])) as data:
        assert [part.to_epsg() for part in CRS.from_wkt(data.crs.to_wkt()).sub_crs_list] == [32617, 5773]
        assert data.tags()["VERTICAL_DATUM"] == "EGM96 geoid"
        assert data.read(1)[0, 0] == 8.0
    with rasterio.open(scene.path(scene.products["dsm_std"])) as data:
        assert data.crs.to_epsg() == 32617
