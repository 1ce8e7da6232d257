"""`fit --field neural` from images to products, and every field on scenes that are hard."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import rasterio
import torch
from towns import copied

from sattools import api
from sattools.compare import compare_dsm, read_reference
from sattools.errors import SceneError
from sattools.export.options import ExportOptions
from sattools.export.stage import export
from sattools.fit.depth_prior import DepthPrior
from sattools.fit.model import FittedModel
from sattools.fit.options import FitOptions
from sattools.fit.presets import resolve
from sattools.fit.rays.start import restored_field
from sattools.fit.stage import fit
from sattools.prior.files import read_prior
from sattools.scene import Scene
from sattools.simulate import SimulateOptions, simulate

TINY = {"field": "neural", "rays": 64, "steps": 12, "resolution": 2.0}


def tiny(**more: Any) -> FitOptions:
    return resolve("fast", {**TINY, **more})


def fitted(scene: Scene) -> FittedModel:
    return FittedModel.load(scene.path("fit/model.safetensors"))


@pytest.fixture(scope="module")
def trained(matched_hamlet_source: Scene, tmp_path_factory: pytest.TempPathFactory) -> Scene:
    """The small scene with a field that was trained for a few steps; tests must leave its files alone."""
    scene = copied(matched_hamlet_source, tmp_path_factory.mktemp("trained") / "HAMLET")
    fit(scene, tiny())
    return scene


def test_the_field_brings_its_own_values_and_what_is_given_wins() -> None:
    options = resolve("fast", {"field": "neural", "rays": 7})
    assert (options.rays, options.samples, options.guided, options.steps) == (7, 16, 16, 1500)
    assert resolve("fast", {}).guided == 0


def test_it_begins_at_the_priors_error_and_exports_what_it_holds(trained: Scene, tmp_path: Path) -> None:
    scene = copied(trained, tmp_path / "HAMLET")
    model = fitted(scene)
    assert model.field == "neural"
    truth = read_reference(str(scene.path(scene.products["truth_dsm"])))
    prior = DepthPrior.from_arrays(*read_prior(scene)).on(model.grid)
    error, start = (compare_dsm(h.numpy(), truth, model.grid).figures["mae"] for h in (model.height, prior.height))
    # twelve steps change next to nothing: what is left is how a volume is read off
    assert error < start + 0.05
    item = scene.items[0].id
    export(scene, ExportOptions(view=[item], sun=(180.0, 45.0)))
    for name in ("dsm", "albedo"):
        with rasterio.open(scene.path(scene.products[name])) as data:
            values = data.read(masked=True)
        assert values.count() > 0.5 * values.size
        assert np.isfinite(values.compressed()).all(), name
    with rasterio.open(scene.path(scene.items[0].assets["rendered"].href)) as shown:
        picture = shown.read()
    with rasterio.open(scene.path(scene.items[0].assets["image"].href)) as image:
        pixels = image.read().astype(np.float32)
    known = np.isfinite(picture).all(axis=0)
    # cells of 2 m under pixels of 0.5 m, untrained
    assert np.corrcoef(picture[:, known].ravel(), pixels[:, known].ravel())[0, 1] > 0.4


def test_a_model_gives_its_field_back(trained: Scene) -> None:
    model = fitted(trained)
    field = restored_field(model)
    for name, tensor in field.named_tensors().items():
        assert torch.equal(tensor, model.extra[f"field.{name}"])


def test_interrupted_it_goes_on_bit_for_bit(
    trained: Scene, make_matched_hamlet: Callable[..., Scene], monkeypatch: pytest.MonkeyPatch
) -> None:
    from sattools.fit.rays import job as rays_job

    monkeypatch.setattr(rays_job, "SAVE_EVERY_S", 0.0)
    monkeypatch.setattr(rays_job, "TELL_EVERY_S", 0.0)
    broken, options = make_matched_hamlet("BROKEN"), tiny()

    def stop(fraction: float, message: str) -> None:
        if message.startswith("step 7/"):
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        fit(broken, options, stop)
    fit(broken, replace(options, resume=True))
    one, other = fitted(trained), fitted(broken)
    assert torch.equal(one.height, other.height)
    assert set(one.extra) == set(other.extra)
    assert all(torch.equal(one.extra[name], other.extra[name]) for name in one.extra)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"start": "noise", "guided": 0}, "--field neural: found --start noise"),
        ({"prior_weight": 0.0, "guided": 0}, "found no prior"),
        ({"shadow": "learned"}, "a neural field has no head for it"),
        ({"brdf": "hapke"}, "a neural field has no head for it"),
        ({"shadow": "auto"}, "expected --field surface"),
    ],
)
def test_what_cannot_work_is_refused(make_matched_hamlet: Callable[..., Scene], options: Any, message: str) -> None:
    with pytest.raises(SceneError, match=message):
        fit(make_matched_hamlet(), tiny(**options))


# ---- scenes that are hard, for every field ------------------------------------------------------------------


def grazing_sun(scene: Scene) -> None:
    for item in scene.items:
        item.properties["view:sun_elevation"] = 4.0


def saturation(scene: Scene) -> None:
    """Two fifths of all pixels are as bright as the sensor can say."""
    change_pixels(scene, lambda pixels: np.where(pixels > np.quantile(pixels, 0.6), 2047, pixels))


def partial_overlap(scene: Scene) -> None:
    """Three images show the west alone, three the east alone."""

    def half(pixels: np.ndarray, number: int) -> np.ndarray:
        kept = pixels.copy()
        middle = pixels.shape[2] // 2
        kept[:, :, slice(None, middle) if number % 2 else slice(middle, None)] = 0
        return kept

    change_pixels(scene, half, nodata=0)


def two_views(scene: Scene) -> None:
    del scene.items[2:]


def change_pixels(scene: Scene, change: Callable[..., np.ndarray], nodata: int | None = None) -> None:
    for number, item in enumerate(scene.items):
        path = scene.path(item.assets["image"].href)
        with rasterio.open(path) as image:
            pixels, profile, tags = image.read(), image.profile, image.tags()
        changed = change(pixels, number) if nodata is not None else change(pixels)
        profile.update(driver="GTiff", nodata=nodata)
        with rasterio.open(path, "w", **profile) as image:
            image.write(changed.astype(profile["dtype"]))
            image.update_tags(**tags)


FIELDS: dict[str, FitOptions] = {
    "surface": FitOptions(resolution=2.0, epochs=[4]),
    "voxel": FitOptions(field="voxel", resolution=2.0, rays=64, samples=12, steps=12),
    # one begins as the prior, the other as the surface that a fit finds
    "mlp": resolve("eonerf", {"width": 16, "rays": 64, "steps": 12, "resolution": 2.0, "start": "prior"}),
    "neural": tiny(),
}


def opposition(scene: Scene) -> None:
    """The sun stands behind the sensor in every image."""
    for item in scene.items:
        item.properties["view:sun_azimuth"] = item.properties["view:azimuth"]
        item.properties["view:sun_elevation"] = 90.0 - item.properties["view:off_nadir"]


RELIEF = {"terrain": "natural", "gsd": 1.0, "off_nadir": 20.0}


def check_every_field(scene: Scene) -> None:
    scene = api.match(scene)  # once for all of them
    for name, options in FIELDS.items():
        fit(scene, options)
        model = fitted(scene)
        assert model.field == name
        low, high = scene.require_height_range()
        assert low - 5 <= float(model.height.min()) <= float(model.height.max()) <= high + 5, name
        for tensor in (model.height_std, model.albedo, model.gain, *model.extra.values()):
            assert torch.isfinite(tensor).all(), name


@pytest.mark.parametrize("hard", [grazing_sun, opposition, saturation, partial_overlap, two_views])
def test_every_field_gives_finite_maps_of_a_hard_scene(make_hamlet: Callable[..., Scene], hard: Any) -> None:
    scene = make_hamlet()
    hard(scene)
    check_every_field(scene)


@pytest.mark.parametrize(
    "where",
    [
        {**RELIEF, "lat": 78.2, "lon": 15.6, "sun_elevation": 25.0},
        {"lat": -17.0, "lon": 180.0},
        {**RELIEF, "slope": 55.0},
    ],
    ids=["Svalbard", "date line", "steep"],
)
def test_every_field_gives_finite_maps_of_a_hard_place(tmp_path: Path, where: dict[str, Any]) -> None:
    given = {"id": "HARD", "size": 32.0, "views": 3, "dates": 2, **where}
    check_every_field(simulate(SimulateOptions(**given), tmp_path / "HARD"))
