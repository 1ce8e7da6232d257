"""Maps, held-out views and relighting of a fitted reflectance model."""

import tomllib
from dataclasses import replace
from pathlib import Path
from shutil import copytree
from typing import Any

import numpy as np
import pytest
import torch
from click.testing import CliRunner

from sattools.cli import main
from sattools.compare.images import compare_views
from sattools.compare.metrics import image_errors
from sattools.errors import SceneError
from sattools.export.context import Exported
from sattools.export.material import material_maps, write_material
from sattools.export.novel import Shown, render_item, write_relit
from sattools.export.options import ExportOptions
from sattools.export.parts import WholeModel
from sattools.export.stage import export
from sattools.fit.model import FittedModel
from sattools.fit.options import FitOptions
from sattools.fit.stage import fit
from sattools.scene import Scene
from sattools.scene.raster import read_image, read_raster
from sattools.simulate import SimulateOptions, simulate


@pytest.fixture(scope="module")
def fitted(tmp_path_factory: pytest.TempPathFactory) -> Scene:
    options = SimulateOptions(terrain="natural", id="HILL", size=96.0, views=9, units=2, seed=5, off_nadir=30.0)
    scene = simulate(options, tmp_path_factory.mktemp("hill") / "HILL")
    fit(scene, FitOptions(brdf="hapke", resolution=2.0, epochs=[8]))
    export(scene, ExportOptions(view=["HILL_001", "HILL_005"], sun=(250.0, 35.0), undetermined="prior"))
    return scene


def product(scene: Scene, name: str) -> np.ndarray:
    return read_raster(scene.path(scene.products[name]))[0]


def test_every_parameter_has_a_map_and_its_uncertainty_in_the_right_units(fitted: Any) -> None:
    shapes = {name: product(fitted, name).shape[0] for name in ("w", "b", "c", "theta", "normal", "reflectance")}
    assert shapes == {"w": 3, "b": 1, "c": 1, "theta": 1, "normal": 3, "reflectance": 3}
    for name in ("w", "b", "c", "theta"):
        assert product(fitted, name).shape == product(fitted, f"{name}_std").shape
        assert (product(fitted, f"{name}_std") > 0).all()
    assert np.allclose(np.linalg.norm(product(fitted, "normal"), axis=0), 1, atol=1e-5)
    assert 0.2 < product(fitted, "theta").min() < product(fitted, "theta").max() < 50
    import rasterio

    with rasterio.open(fitted.path(fitted.products["theta"])) as data:
        assert data.units == ("degrees",)
        assert "of the cells, see identifiable.tif" in data.tags()["DETERMINED"]
    with rasterio.open(fitted.path(fitted.products["reflectance"])) as data:
        assert "15 degrees from the vertical" in data.tags()["GEOMETRY"]
        assert data.tags()["SCALE"].startswith("absolute")


def test_what_the_images_did_not_determine_is_no_data_unless_asked_for(fitted: Scene, tmp_path: Path) -> None:
    import rasterio

    names = ("b", "c", "theta")
    kept = {name: product(fitted, name)[0] for name in ("w", *names)}
    copytree(fitted.root, tmp_path / "copy")
    model = FittedModel.load(fitted.path(fitted.products["model"]))
    # b is known in the west alone, c nowhere, theta everywhere, whatever the images said
    share = torch.zeros(*model.grid.shape, 3)
    share[:, : model.grid.width // 2, 0], share[..., 2] = 0.9, 0.6
    other = Scene.from_json(fitted.to_json())
    other.root = tmp_path / "copy"
    model.extra["identifiable"].copy_(share)
    exported = Exported(other, model, np.ones(model.grid.shape, bool))
    maps = material_maps(model.surface(), model.extra)
    write_material(exported, maps)
    found = {name: product(other, name)[0] for name in ("w", *names)}
    assert np.isnan(found["c"]).all()
    assert np.isfinite(found["theta"]).all()
    west = np.arange(model.grid.width) < model.grid.width // 2
    assert (np.isfinite(found["b"]) == west).all()
    np.testing.assert_array_equal(found["b"][:, west], kept["b"][:, west])
    np.testing.assert_array_equal(found["w"], kept["w"])  # the amplitude is always there
    with rasterio.open(other.path(other.products["b"])) as data:
        assert "no data elsewhere" in data.tags()["DETERMINED"]
    write_material(exported, maps, undetermined=True)
    np.testing.assert_array_equal(product(other, "c")[0], kept["c"])
    assert ExportOptions().undetermined == "nodata"


def test_a_held_out_view_comes_out_in_its_own_geometry_without_any_gain(fitted: Any) -> None:
    item = next(i for i in fitted.items if i.id == "HILL_001")
    assert item.role == "test"
    rendered = read_image(fitted.path(item.assets["rendered"].href))
    image = read_image(fitted.path(item.assets["image"].href)) / 4095
    assert rendered.shape == image.shape
    known = np.isfinite(rendered).all(0)
    assert 0.3 < known.mean() < 0.95  # the image shows surroundings that the model does not have
    assert np.corrcoef(rendered[:, known].ravel(), image[:, known].ravel())[0, 1] > 0.9
    figures = compare_views(fitted)
    assert set(figures["views"]) == {"HILL_001", "HILL_005"}
    assert figures["psnr"] == figures["views"]["HILL_001"]["psnr"] > 30


def test_a_view_shows_no_ground_that_the_images_do_not_reach(fitted: Any) -> None:
    model = FittedModel.load(fitted.path(fitted.products["model"]))
    reached = np.zeros(model.grid.shape, bool)
    reached[:, : model.grid.width // 2] = True
    whole = WholeModel(model, model.surface())
    everything = np.stack(render_item(fitted, "HILL_005", whole, None).bands)
    shown = render_item(fitted, "HILL_005", replace(whole, valid=reached), None)
    half, height = np.stack(shown.bands), shown.height
    known, kept = np.isfinite(everything).all(0), np.isfinite(half).all(0)
    assert 0.4 < kept.sum() / known.sum() < 0.6  # the western half, but for the parallax of its border
    assert not (kept & ~known).any()
    np.testing.assert_array_equal(half[:, kept], everything[:, kept])
    assert np.isnan(height[known & ~kept]).all()


def test_relighting_moves_the_shade_to_the_other_side(fitted: Any) -> None:
    relit = product(fitted, "relit")
    normal = product(fitted, "normal")
    west, east = normal[0] < -0.2, normal[0] > 0.2
    # sun in the west-south-west: slopes that fall to the west are the bright ones
    assert relit[:, west].mean() > 1.3 * relit[:, east].mean()
    assert "relit" in next(i for i in fitted.items if i.id == "HILL_001").assets


def test_an_unknown_view_is_refused_before_anything_is_written(fitted: Any) -> None:
    with pytest.raises(SceneError, match=r"NO_SUCH.*, expected --view with one of HILL_001, HILL_002"):
        export(fitted, ExportOptions(view=["NO_SUCH"]))


def test_a_scene_of_unknown_scale_gets_its_held_out_views_scored_on_the_other_half(make_town: Any) -> None:
    scene = make_town("TOWN")
    scene.items[0].properties["sattools:role"] = "test"
    fit(scene, FitOptions(resolution=2.0, coarsest=4.0, epochs=[4], prior_weight=0.0))
    export(scene, ExportOptions(view=[scene.items[0].id], sun=(250.0, 30.0)))
    assets = scene.items[0].assets
    rendered = read_image(scene.path(assets["rendered"].href))
    scored = np.isfinite(read_image(scene.path(assets["rendered_scored"].href))[0])
    known = np.isfinite(rendered).all(0)
    # the western half set the gain and offset; it is shown, and not scored
    assert np.flatnonzero(scored.any(0)).min() > 0.35 * rendered.shape[2]
    assert np.flatnonzero(known.any(0)).min() < 0.2 * rendered.shape[2]
    assert not (scored & ~known).any()
    assert 0.4 < scored.sum() / known.sum() < 0.6
    import rasterio

    with rasterio.open(scene.path(assets["rendered_scored"].href)) as data:
        assert data.descriptions == ("scored",)
    with rasterio.open(scene.path(assets["rendered"].href)) as data:
        assert data.tags()["GAIN"].startswith("from the western half of the image, of unknown scale")
    # gain and offset are those of the image's own light: pixels that both suns reach entirely, a tenth of them, are
    # the same
    relit = read_image(scene.path(assets["relit"].href))
    assert (np.abs(relit - rendered)[:, known] < 1e-5).mean() > 0.05
    figures = compare_views(scene)["views"]
    assert figures.keys() == {scene.items[0].id}
    image = read_image(scene.path(assets["image"].href)) / 2047
    east = image_errors(np.where(scored, rendered, np.nan), image)
    assert figures[scene.items[0].id]["psnr"] == pytest.approx(east["psnr"], abs=1e-6)
    assert abs(image_errors(rendered, image)["psnr"] - east["psnr"]) > 1e-3


def test_the_sun_takes_two_numbers_on_the_command_line() -> None:
    shown = CliRunner().invoke(main, ["export", "--sun", "135", "40", "--view", "A", "--view", "B", "--print-config"])
    values = tomllib.loads(shown.output)["export"]
    assert (values["sun"], values["view"]) == ([135.0, 40.0], ["A", "B"])
    assert CliRunner().invoke(main, ["export", "--sun", "135"]).exit_code == 2


def test_the_scene_under_another_sun_has_the_numbers_that_the_images_have(fitted: Scene, tmp_path: Path) -> None:
    model = FittedModel.load(fitted.path(fitted.products["model"]))
    relit = {}
    for kind in ("reflectance_factor", "toa_reflectance"):
        scene = replace(Scene.from_json(fitted.to_json()), root=tmp_path / kind)
        whole = WholeModel(replace(model, radiance=kind), model.surface())
        write_relit(Shown(scene, whole), (250.0, 30.0))
        relit[kind] = product(scene, "relit")
    # pi L over the sun's light on level ground, half of that across its beam
    np.testing.assert_allclose(relit["toa_reflectance"], 2 * relit["reflectance_factor"], rtol=1e-5)


def test_no_ground_under_another_sun_is_darker_than_none(fitted: Scene, tmp_path: Path) -> None:
    own = FittedModel.load(fitted.path(fitted.products["model"]))
    scene = replace(Scene.from_json(fitted.to_json()), root=tmp_path)
    dark = replace(own, brdf="lambert", albedo=torch.full_like(own.albedo, -0.1))
    write_relit(Shown(scene, WholeModel(dark, dark.surface())), (250.0, 30.0))
    assert (product(scene, "relit") == 0).all()
