"""`fit --bands`: some bands of the images, by number or name, for every field, and all eight of a sensor."""

from collections.abc import Callable

import numpy as np
import pytest
import rasterio

from sattools.compare.images import compare_views
from sattools.errors import SceneError
from sattools.export.options import ExportOptions
from sattools.export.stage import export
from sattools.fit.model import FittedModel
from sattools.fit.presets import resolve
from sattools.fit.stage import fit
from sattools.radiometry.bands import chosen_bands
from sattools.scene import Asset, Item, Scene
from sattools.views import load_sources

QUICK = {
    "surface": {"epochs": [1]},
    "neural": {"field": "neural", "rays": 64, "steps": 6, "resolution": 2.0},
    "mlp": {"field": "mlp", "width": 16, "rays": 32, "steps": 3, "samples": 4, "guided": 4, "resolution": 4.0},
    "voxel": {"field": "voxel", "rays": 32, "steps": 3, "samples": 8, "resolution": 4.0},
}
# rows: eight bands as mixtures of red, green, blue
MIXED = np.array([[k, 7 - k, 3.0] for k in range(8)]) / 10


def in_eight_bands(scene: Scene) -> Scene:
    """The scene as an eight-band sensor would see it."""
    for item in scene.items:
        path = scene.path(item.assets["image"].href)
        with rasterio.open(path) as data:
            image, profile, tags, rpcs = data.read(), data.profile, data.tags(), data.rpcs
        path.unlink()
        profile.update(count=8, photometric="minisblack", interleave="pixel")
        with rasterio.open(path, "w", **profile) as out:
            out.write(np.tensordot(MIXED, image.astype(np.float64), 1).astype(image.dtype))
            out.update_tags(**tags)
            if rpcs:
                out.rpcs = rpcs
        item.properties |= {"platform": "WorldView-3", "sattools:bands": 8}
    return scene


def test_bands_are_known_by_number_and_name() -> None:
    item = Item("A", None, None, {"platform": "WorldView-3"})
    item.assets["image"] = Asset("a.tif")
    assert chosen_bands(item, [], 8) == list(range(1, 9))
    assert chosen_bands(item, ["5", "nir08", "c"], 8) == [5, 7, 1]
    # what the radiance says of itself wins
    item.assets["radiance"] = Asset("b.tif", extra={"eo:bands": [{"name": "R", "common_name": "red"}, {"name": "N"}]})
    assert chosen_bands(item, ["n", "RED"], 2) == [2, 1]
    for wanted, told in ((["swir"], "'swir'"), (["0"], "'0'"), (["3"], "up to 2"), (["1", "red"], "once")):
        with pytest.raises(SceneError, match=told):
            chosen_bands(item, wanted, 2)
    item.properties["sattools:bands"] = 8
    with pytest.raises(SceneError, match=r"A has \(R, N\); `sattools normalise --bands` has taken 2 of its 8$"):
        chosen_bands(item, ["coastal"], 2)


@pytest.mark.parametrize("name", list(QUICK))
def test_a_field_of_two_bands_shows_those_and_is_compared_with_them(
    make_matched_hamlet: Callable[..., Scene], name: str
) -> None:
    scene = make_matched_hamlet()
    fit(scene, resolve("fast", {**QUICK[name], "bands": ["3", "1"]}))
    model = FittedModel.load(scene.path("fit/model.safetensors"))
    assert model.bands == ["3", "1"]
    assert model.albedo.shape[-1] == 2
    item = scene.items[0]
    export(scene, ExportOptions(view=[item.id]))
    with rasterio.open(scene.path(item.assets["rendered"].href)) as data:
        shown = data.read()
    assert shown.shape[0] == 2
    (source,) = load_sources(scene, [item])
    known = np.isfinite(shown).all(axis=0)
    # the order is the asked one: swapped, differences of bands would have the other sign
    differences = [(bands[a] - bands[b])[known] for bands, a, b in ((shown, 0, 1), (source.radiance, 2, 0))]
    assert np.corrcoef(*differences)[0, 1] > 0.2
    again = Scene.from_json(scene.to_json())
    again.root = scene.root
    assert np.isfinite(compare_views(again)["psnr"])


def test_all_eight_bands_are_fitted(make_hamlet: Callable[..., Scene]) -> None:
    scene = in_eight_bands(make_hamlet())
    fit(scene, resolve("fast", QUICK["surface"]))
    model = FittedModel.load(scene.path("fit/model.safetensors"))
    assert model.albedo.shape[-1] == 8
    albedo = model.albedo.numpy().reshape(-1, 8)
    # eight mixtures of three colours: gain, offset and noise aside, no more than three directions
    spread = np.linalg.svd(albedo - albedo.mean(axis=0), compute_uv=False)
    assert spread[3] < 0.1 * spread[0]
    fit(scene, resolve("fast", {**QUICK["surface"], "bands": ["nir08", "B"]}))
    two = FittedModel.load(scene.path("fit/model.safetensors")).albedo.numpy().reshape(-1, 2)
    for found, band in zip(two.T, (6, 1), strict=True):
        assert np.corrcoef(found, albedo[:, band])[0, 1] > 0.9


def test_a_band_that_is_not_there_is_told(make_hamlet: Callable[..., Scene]) -> None:
    with pytest.raises(SceneError, match="--bands: found 'nir'"):
        fit(make_hamlet(), resolve("fast", {**QUICK["surface"], "bands": ["nir"]}))
