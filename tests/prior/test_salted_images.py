"""Images of which many single pixels are missing are matched nearly as well as whole ones."""

from pathlib import Path
from typing import Any

import numpy as np
import rasterio

from sattools.prior import PriorOptions
from sattools.prior.stage import prior
from sattools.radiometry.holes import without_holes
from sattools.scene.raster import read_raster
from sattools.views import load_sources


def salt(path: Path, share: float, seed: int) -> None:
    """The image in float32, of which a share of the pixels is NaN in one of its bands."""
    with rasterio.open(path) as data:
        values, profile, tags = data.read().astype(np.float32), data.profile, data.tags(ns="RPC")
    band = seed % len(values)
    values[band, np.random.default_rng(seed).random(values.shape[1:]) < share] = np.nan
    path.unlink()
    with rasterio.open(path, "w", **(profile | {"dtype": "float32"})) as data:
        data.write(values)
        data.update_tags(ns="RPC", **tags)


def salted(scene: Any, share: float) -> Any:
    for number, item in enumerate(scene.items):
        salt(scene.path(item.assets["image"].href), share, number)
    return scene


def matched(scene: Any) -> Any:
    found = prior(scene, PriorOptions())
    return found["prior"]["seen_by_two"], read_raster(scene.path(scene.products["prior_dsm"]))[0][0]


def test_what_is_seen_and_its_heights_do_not_depend_on_single_missing_pixels(make_town: Any) -> None:
    seen, height = matched(make_town())
    seen_salted, height_salted = matched(salted(make_town("SALTED"), 0.05))
    assert abs(seen_salted - seen) < 0.02  # it was 0.10 less
    assert np.abs(height_salted - height).mean() < 0.15  # m; 0.04 m; it was 0.66 m


def test_matching_alone_fills_them_and_few_it_leaves_alone(make_town: Any) -> None:
    scene = salted(make_town(), 0.05)
    for source in load_sources(scene, scene.items):
        missing = ~np.isfinite(source.radiance).all(axis=0)
        assert 0.04 < missing.mean() < 0.06  # a fit has no radiance to explain there
        assert np.isfinite(source.complete().radiance).all()
    scene = salted(make_town("FEW"), 0.003)
    for source in load_sources(scene, scene.items):
        assert source.complete().radiance is source.radiance


def test_a_pixel_without_one_band_gets_that_band_from_its_neighbours_and_clouds_nothing() -> None:
    row, column = np.mgrid[:60, :80].astype(np.float32)
    whole = np.stack([10 + row, 200 - column])
    image = whole.copy()
    image[1, ::4, ::4] = np.nan
    image[:, 20:40, 20:30] = np.nan  # larger than what is single
    filled = without_holes(image)
    np.testing.assert_array_equal(filled[0, ::4, ::4][:5], whole[0, ::4, ::4][:5])
    assert np.abs(filled - whole)[1, 4:16:4, 4:-4:4].max() < 1e-3  # the mean of a slope's neighbours is its own
    assert np.isnan(filled[:, 20:40, 20:30]).all()
    known = np.isfinite(image)
    np.testing.assert_array_equal(filled[known], image[known])
