"""True orthophotos of a simulated town: everything that an image sees, in the ground's own colours, in its place."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import rasterio
import torch
from scipy.ndimage import binary_dilation
from skimage.registration import phase_cross_correlation
from towns import copied

from sattools.camera.ground import grid_direction
from sattools.errors import SceneError
from sattools.export.options import ExportOptions
from sattools.export.products import ortho
from sattools.export.products.maps import Maps
from sattools.export.products.ortho import Balance, balance_of, with_usual_shadows, without_haze, write_ortho
from sattools.export.products.seen import Shown
from sattools.export.stage import export
from sattools.fit.model import FittedModel
from sattools.progress import silent
from sattools.scene import Scene
from sattools.scene.raster import read_raster, write_cog
from sattools.scene.validity import MEASURED

COARSE = 2  # the model's cells over the images' pixels


@pytest.fixture(scope="module")
def exported(town_source: Any, tmp_path_factory: pytest.TempPathFactory) -> Scene:
    """The town with a model that is the truth in cells of 1 m; the images have pixels of 0.5 m."""
    scene = copied(town_source, tmp_path_factory.mktemp("ortho") / "TOWN")
    model_of(scene).save(scene.root / "model.safetensors")
    scene.products["model"] = "model.safetensors"
    export(scene, ExportOptions(products=["ortho"]))
    return scene


def model_of(scene: Scene) -> FittedModel:
    height, grid = read_raster(scene.path(scene.products["truth_dsm"]))
    albedo, _ = read_raster(scene.path(scene.products["truth_albedo"]))
    coarse = grid.resized(grid.cell_size * COARSE)
    means = [
        layers.reshape(-1, coarse.height, COARSE, coarse.width, COARSE).mean(axis=(2, 4)) for layers in (height, albedo)
    ]
    views, bands = len(scene.items), len(albedo)
    lon, lat = -81.66, 30.35
    suns = [tuple(float(v) for v in grid_direction(*item.sun, grid.crs, lon, lat)) for item in scene.items]
    colours = torch.ones(views, bands)
    return FittedModel(
        grid=coarse,
        items=[item.id for item in scene.items],
        suns=suns,
        height=torch.from_numpy(means[0][0]).float(),
        height_std=torch.full(coarse.shape, 0.3),
        albedo=torch.from_numpy(means[1].transpose(1, 2, 0).copy()).float(),
        gain=colours,
        offset=0 * colours,
        ambient=0.3 * colours,
        pose=torch.zeros(views, 2),
    )


def photo_of(scene: Scene) -> tuple[np.ndarray, np.ndarray, Any]:
    photo, grid = read_raster(scene.path(scene.products["ortho"]))
    source, same = read_raster(scene.path(scene.products["ortho_source"]))
    assert grid == same
    return photo, source[0], grid


def fine(array: np.ndarray) -> np.ndarray:
    return np.repeat(np.repeat(array, COARSE, axis=-2), COARSE, axis=-1)


def test_it_has_the_images_own_resolution_and_bands(exported: Scene) -> None:
    photo, source, grid = photo_of(exported)
    assert grid.cell_size == 0.5
    assert photo.shape == (3, 128, 128)
    assert set(np.unique(source)) <= set(range(7))
    notes = exported.products
    assert (notes["ortho"], notes["ortho_source"]) == ("export/ortho.tif", "export/ortho_source.tif")


def test_numbers_of_images_have_no_scale(exported: Scene) -> None:
    tags = []
    for name in ("ortho", "ortho_source"):
        with rasterio.open(exported.path(exported.products[name])) as data:
            tags.append(data.tags())
    assert "SCALE" in tags[0]
    assert "SCALE" not in tags[1]
    assert tags[0]["IMAGE_1"] == tags[1]["IMAGE_1"]


def test_what_two_images_see_is_filled(exported: Scene) -> None:
    photo, source, _ = photo_of(exported)
    validity, _ = read_raster(exported.path(exported.products["validity"]))
    measured = fine(validity[0]) == MEASURED
    shown = np.isfinite(photo).all(axis=0)
    assert (shown & measured).sum() >= 0.99 * measured.sum()
    assert np.array_equal(shown, source > 0)


def test_its_colours_are_those_of_the_ground_also_where_the_main_image_does_not_look(exported: Scene) -> None:
    """RMS of the albedo 0.070 in the mean over the bands, of a spread of 0.124: thin lines and the smallest roofs."""
    photo, source, _ = photo_of(exported)
    truth, _ = read_raster(exported.path(exported.products["truth_albedo"]))
    error = np.sqrt(np.nanmean((photo - truth) ** 2, axis=(1, 2)))
    assert error.mean() < 0.65 * truth.std(axis=(1, 2)).mean()
    main = np.bincount(source[source > 0]).argmax()
    others = (source != main) & (source > 0)
    assert 0.02 < others.mean() < 0.5
    # typical, not mean: the town's walls and trees are not in the model's cells to the half metre
    elsewhere = np.nanmedian(np.abs(photo - truth)[:, others])
    assert elsewhere < 0.06


def test_it_lines_up_with_the_surface(exported: Scene) -> None:
    photo, _, _ = photo_of(exported)
    truth, _ = read_raster(exported.path(exported.products["truth_albedo"]))
    band = np.nan_to_num(photo[1], nan=float(np.nanmean(photo[1])))
    shift, _, _ = phase_cross_correlation(truth[1], band, upsample_factor=20)
    assert np.abs(shift).max() <= 0.5


def test_no_seam_runs_where_one_image_passes_into_another(exported: Scene) -> None:
    """Along seams neighbours differ no more than the ground itself does there, within noise."""
    photo, source, _ = photo_of(exported)
    truth, _ = read_raster(exported.path(exported.products["truth_albedo"]))
    edge = np.zeros(source.shape, bool)
    edge[:, 1:] = (source[:, 1:] != source[:, :-1]) & (source[:, 1:] > 0) & (source[:, :-1] > 0)
    height, _ = read_raster(exported.path(exported.products["dsm"]))
    steps = np.abs(np.diff(fine(height[0]), axis=1, prepend=np.nan)) > 1.0
    edge &= ~binary_dilation(steps, iterations=2)
    assert edge.sum() > 50
    across = np.diff(photo[1], axis=1, prepend=np.nan)[edge]
    ground = np.diff(truth[1], axis=1, prepend=np.nan)[edge]
    assert abs(np.nanmedian(across - ground)) < 0.01
    assert np.nanmedian(np.abs(across)) < np.nanmedian(np.abs(ground)) + 0.02


def parts(scene: Scene) -> Maps:
    return Maps.of({name: scene.path(scene.products[name]) for name in ("dsm", "albedo")})


def test_blocks_leave_no_trace(exported: Scene, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    whole, _, _ = photo_of(exported)
    job = ortho._Job.of(exported, model_of(exported), parts(exported), "ellipsoid")
    balances = job.balances()
    monkeypatch.setattr(ortho._Job, "balances", lambda self: balances)
    monkeypatch.setattr(ortho, "PIXELS", 128)  # blocks of 64 cells: one; and of fewer:
    blocks = Maps.blocks
    monkeypatch.setattr(Maps, "blocks", lambda self, size=0: blocks(self, 32))
    files = tmp_path / "a.tif", tmp_path / "b.tif"
    write_ortho(exported, model_of(exported), parts(exported), files, "ellipsoid", silent)
    pieces, _ = read_raster(files[0])
    # weights near the border of a block know nothing of shadows' edges beyond it
    assert np.nanmean(np.abs(pieces - whole)) < 0.002
    assert np.isfinite(pieces).mean() == np.isfinite(whole).mean()


def test_heights_above_a_geoid_give_the_same_photo(
    exported: Scene, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    height, grid = read_raster(exported.path(exported.products["dsm"]))
    write_cog(tmp_path / "dsm.tif", height + 28.0, grid, vertical="EPSG:5773")
    maps = Maps.of({"dsm": tmp_path / "dsm.tif", "albedo": exported.path(exported.products["albedo"])})
    monkeypatch.setattr(ortho, "to_datum", lambda heights, *_: (heights + 28.0, "EGM96 geoid"))
    files = tmp_path / "a.tif", tmp_path / "b.tif"
    write_ortho(exported, model_of(exported), maps, files, "egm96", silent)
    assert read_raster(files[0])[0] == pytest.approx(photo_of(exported)[0], abs=1e-4, nan_ok=True)


def test_a_band_without_any_albedo_counts_as_albedo_itself() -> None:
    rng = np.random.default_rng(0)
    albedo = np.stack([rng.uniform(0.1, 0.5, 1000), np.zeros(1000)])  # water in red and in infrared
    radiance = np.stack([2 * albedo[0] + 0.01, np.full(1000, 0.02)])
    found = balance_of(np.concatenate([radiance, albedo, np.ones((1, 1000))]), 2)
    assert found.gain == pytest.approx([2.0, 1.0])
    assert found.offset == pytest.approx([0.01, 0.0])


def test_images_that_differ_in_gain_and_haze_are_balanced_and_their_shadows_lifted() -> None:
    albedo = np.random.default_rng(0).uniform(0.05, 0.5, (1, 2000))
    lit = np.r_[np.ones(1000), np.zeros(1000)]
    radiance = np.where(lit == 1, 0.8, 0.2) * albedo + 0.05
    found = balance_of(np.concatenate([radiance, albedo, lit[None]]), 1)
    assert (found.gain[0], found.offset[0], found.shade[0]) == pytest.approx((0.8, 0.05, 0.25))
    shown = Shown(radiance.reshape(1, 40, 50), np.ones((40, 50)), lit.reshape(40, 50))
    assert found.albedo(shown).ravel() == pytest.approx(albedo.ravel(), abs=0.4)
    assert np.median(np.abs(found.albedo(shown).ravel() - albedo.ravel())) < 1e-6


def test_no_image_has_more_haze_than_its_darkest_pixels_and_no_ground_is_darker_than_black() -> None:
    rng = np.random.default_rng(1)
    albedo = np.r_[rng.normal(0.3, 0.01, 1000), np.full(1000, 0.3)][None]  # ground of one brightness tells no line
    lit = np.r_[np.ones(1000), np.zeros(1000)]
    radiance = np.where(lit == 1, 0.25, 0.08) + rng.normal(0, 0.01, 2000)[None]
    found = balance_of(np.concatenate([radiance, albedo, lit[None]]), 1)
    assert found.offset[0] == pytest.approx(np.percentile(radiance, 0.05))  # not 0.25, as a line through the lit has it
    assert found.gain[0] == pytest.approx((0.25 - found.offset[0]) / 0.3, rel=0.02)
    darker = Shown(np.full((1, 1, 1), -0.5), np.ones((1, 1)), np.ones((1, 1)))
    assert found.albedo(darker).tolist() == [[[0.0]]]


def test_its_bands_are_those_that_were_fitted_in_their_order(exported: Scene, tmp_path: Path) -> None:
    photo, _, _ = photo_of(exported)
    albedo, grid = read_raster(exported.path(exported.products["albedo"]))
    write_cog(tmp_path / "albedo.tif", albedo[[2, 0]], grid)
    maps = Maps.of({"dsm": exported.path(exported.products["dsm"]), "albedo": tmp_path / "albedo.tif"})
    files = tmp_path / "a.tif", tmp_path / "b.tif"
    write_ortho(exported, replace(model_of(exported), bands=["3", "1"]), maps, files, "ellipsoid", silent)
    found, _ = read_raster(files[0])
    # haze is looked for in all bands together, so what is dark differs a little
    assert np.nanmedian(np.abs(found - photo[[2, 0]])) < 0.002
    assert np.nanmedian(np.abs(found - photo[[0, 2]])) > 0.006  # red and blue of a town are not far apart


def test_haze_is_not_lifted_together_with_the_shadows() -> None:
    """The albedo of the fit has the first image's haze in it, 0.04 in blue: without that, dark ground was 0.08 too blue
    in shadow."""
    random = np.random.default_rng(0)
    haze = np.array([0.02, 0.04])[:, None]
    ground = random.uniform(0.02, 0.5, (2, 4000))
    lit = np.r_[np.ones(2000), np.zeros(2000)]
    radiance = ground * np.where(lit == 1, 1.0, 0.2) + haze
    samples = np.concatenate([radiance, ground + haze, lit[None]])
    found = without_haze([balance_of(samples, 2)], [samples])[0]
    assert found.haze == pytest.approx([0.02, 0.04], abs=0.006)
    assert found.shade == pytest.approx([0.2, 0.2], abs=0.02)
    shown = Shown(radiance.reshape(2, 40, 100), np.ones((40, 100)), lit.reshape(40, 100))
    off = np.abs(found.albedo(shown).reshape(2, -1) - ground - haze)
    assert np.median(off[:, lit == 0]) < 0.02  # 0.05 with ``balance_of`` alone
    kept = off[:, (lit == 0) & (ground < 0.1).all(axis=0)]
    assert np.median(kept) < 0.025


def test_bright_ground_without_anything_dark_is_not_all_haze() -> None:
    """A desert: its darkest shadows are as dark as its usual ones, so that half of these is taken at most."""
    albedo = np.random.default_rng(0).uniform(0.39, 0.41, (2, 2000))
    lit = np.r_[np.ones(1000), np.zeros(1000)]
    samples = np.concatenate([np.where(lit == 1, 1.0, 0.3) * albedo, albedo, lit[None]])
    found = without_haze([balance_of(samples, 2)], [samples])[0]
    assert found.haze == pytest.approx([0.06, 0.06], abs=0.001)
    shown = Shown(samples[:2].reshape(2, 40, 50), np.ones((40, 50)), lit.reshape(40, 50))
    assert np.median(np.abs(found.albedo(shown).ravel() - albedo.ravel())) < 0.01


def test_grey_images_have_no_colour_to_lose_to_haze() -> None:
    albedo = np.random.default_rng(0).uniform(0.02, 0.5, (1, 2000))
    lit = np.r_[np.ones(1000), np.zeros(1000)]
    samples = np.concatenate([np.where(lit == 1, 1.0, 0.3) * albedo + 0.03, albedo + 0.03, lit[None]])
    plain = balance_of(samples, 1)
    assert without_haze([plain], [samples])[0] is plain


def test_single_pixels_are_not_from_another_image(exported: Scene) -> None:
    """Pixels whose neighbours are nearly all from other images."""
    _, source, _ = photo_of(exported)
    around = np.stack([np.roll(source, move, axis) for axis in (0, 1) for move in (-1, 1)])
    lone = ((around != source).sum(axis=0) >= 3)[1:-1, 1:-1]
    assert lone.mean() < 0.006  # 0.004; 0.008 without smoothed weights


def test_what_would_be_too_bright_in_shadow_lies_in_the_sun() -> None:
    one = np.ones(1)
    balance = Balance(one, 0 * one, 0.2 * one, 0.6 * one, 0 * one)
    shown = Shown(np.array([[[0.1, 0.3]]]), np.ones((1, 2)), np.zeros((1, 2)))
    assert balance.albedo(shown)[0, 0].tolist() == pytest.approx([0.5, 0.3])


def test_shadows_of_an_image_without_any_are_as_those_of_the_others() -> None:
    one = np.ones(1)
    known, unknown = (
        Balance(one, 0 * one, 0.2 * one, one, 0 * one),
        Balance(2 * one, 0 * one, np.nan * one, one, 0 * one),
    )
    assert [b.shade[0] for b in with_usual_shadows([known, unknown])] == [0.2, 0.2]
    assert [b.shade[0] for b in with_usual_shadows([unknown])] == [1.0]


def test_without_images_there_is_no_photo(exported: Scene, make_town: Callable[[str], Scene], tmp_path: Path) -> None:
    scene = make_town("BARE")
    for item in scene.items:
        del item.assets["rpc"]
    with pytest.raises(SceneError, match="found no image with a camera"):
        write_ortho(scene, model_of(scene), parts(exported), (tmp_path / "a", tmp_path / "b"), "ellipsoid", silent)
    assert list(tmp_path.glob("*a*")) == []


def test_a_view_that_was_shifted_in_the_fit_is_shifted_in_the_photo(exported: Scene, tmp_path: Path) -> None:
    model = model_of(exported)
    moved = replace(model, pose=torch.tensor([[1.0, 0.0]] * len(model.items)))
    files = tmp_path / "a.tif", tmp_path / "b.tif"
    write_ortho(exported, moved, parts(exported), files, "ellipsoid", silent)
    shifted = np.nan_to_num(read_raster(files[0])[0][1])
    shift, _, _ = phase_cross_correlation(np.nan_to_num(photo_of(exported)[0][1]), shifted, upsample_factor=20)
    # rays that lie 1 m further east show what lies 1 m further west: two pixels of the photo eastwards
    assert shift[1] == pytest.approx(-2.0, abs=0.5)
