"""All eight bands of a multispectral image, from the digital numbers to maps with the bands' names."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import rasterio

from sattools.export.options import ExportOptions
from sattools.export.stage import export
from sattools.fit.options import FitOptions
from sattools.fit.stage import fit
from sattools.radiometry.bands import named_bands
from sattools.radiometry.options import NormaliseOptions
from sattools.radiometry.stage import normalise
from sattools.scene import Scene
from sattools.scene.raster import read_image, read_raster
from sattools.scene.sensor_files import write_sensor_image

QUICK = FitOptions(resolution=2.0, coarsest=2.0, epochs=[4], prior_weight=0.0)


def eight_bands(scene: Scene) -> Scene:
    """The scene with WorldView-3 images whose bands are multiples of its own red one."""
    for item in scene.items:
        path = scene.path(item.assets["image"].href)
        with rasterio.open(path) as data:
            tags = data.tags(ns="RPC")
        red = read_image(path)[0]
        numbers = np.stack([np.clip(red * (0.3 + 0.1 * k), 1, 2046) for k in range(8)]).astype(np.uint16)
        write_sensor_image(path, numbers, tags)
        item.properties |= {"platform": "WorldView-3", "sattools:bands": 8, "sattools:dtype": "uint16"}
    return scene


def test_a_fit_of_eight_bands_has_eight_albedos_with_their_names(make_hamlet: Callable[[], Scene]) -> None:
    scene = eight_bands(make_hamlet())
    normalise(scene, NormaliseOptions(bands=list(range(1, 9))))
    fit(scene, QUICK)
    export(scene, ExportOptions())
    albedo, _ = read_raster(scene.path(scene.products["albedo"]))
    with rasterio.open(scene.path(scene.products["albedo"])) as data:
        assert data.descriptions[:2] == ("albedo coastal", "albedo blue")
        assert data.descriptions[6:] == ("albedo nir08", "albedo nir09")
        assert data.tags()["WAVELENGTHS_UM"] == "0.425 0.48 0.545 0.605 0.66 0.725 0.8325 0.95"
    # the last band was made 10/3 of the first
    ratio = np.nanmedian(albedo[7] / albedo[0])
    assert abs(ratio - 1.0 / 0.3) < 0.35  # few epochs, and a mean colour that pulls


def test_three_bands_of_eight_are_red_green_and_blue(make_hamlet: Callable[[], Scene]) -> None:
    scene = eight_bands(make_hamlet())
    normalise(scene, NormaliseOptions())
    bands = scene.items[0].assets["radiance"].extra["eo:bands"]
    assert [band["common_name"] for band in bands] == ["red", "green", "blue"]


def test_bands_that_files_name_are_named_in_maps_without_normalise(make_hamlet: Callable[[], Scene]) -> None:
    scene = make_hamlet()
    for item in scene.items:
        item.assets["image"].extra.update(named_bands(None, ["blue", "green", "red"]))
    fit(scene, replace(QUICK, bands=["red", "blue"]))
    export(scene, ExportOptions())
    with rasterio.open(scene.path(scene.products["albedo"])) as data:
        assert data.descriptions == ("albedo red", "albedo blue")


def test_bands_without_names_keep_their_numbers_in_the_images(make_hamlet: Callable[[], Scene]) -> None:
    scene = make_hamlet()
    fit(scene, replace(QUICK, bands=["3", "1"]))
    export(scene, ExportOptions())
    with rasterio.open(scene.path(scene.products["albedo"])) as data:
        assert data.descriptions == ("albedo 3", "albedo 1")


def test_red_green_and_blue_of_eight_are_those_that_the_files_name(make_hamlet: Callable[[], Scene]) -> None:
    scene = eight_bands(make_hamlet())
    names = ["coastal", "blue", "nir", "green", "yellow", "red", "rededge", "nir08"]  # another sensor's
    for item in scene.items:
        item.properties["platform"] = None
        item.assets["image"].extra.update(named_bands(None, names))
    normalise(scene, NormaliseOptions())
    assert [b["name"] for b in scene.items[0].assets["radiance"].extra["eo:bands"]] == ["red", "green", "blue"]
    with rasterio.open(scene.path(scene.items[0].assets["image"].href)) as numbers:
        wanted = numbers.read([6, 4, 2]) / 2047
    np.testing.assert_allclose(read_image(scene.path("radiance/HAMLET_001.tif")), wanted, rtol=1e-5)


def test_pictures_under_another_sun_name_their_bands_and_their_scale(make_hamlet: Callable[[], Scene]) -> None:
    scene = make_hamlet()
    for item in scene.items:
        item.assets["image"].extra.update(named_bands(None, ["blue", "green", "red"]))
    fit(scene, QUICK)
    export(scene, ExportOptions(view=["HAMLET_002"], sun=(200.0, 40.0)))
    words = ("radiance blue", "radiance green", "radiance red")
    with rasterio.open(scene.path(scene.products["relit"])) as relit:
        assert (relit.descriptions, relit.tags()["SCALE"][:9]) == (words, "relative:")
    for name in ("relit", "rendered"):
        with rasterio.open(scene.path(scene.items[1].assets[name].href)) as data:
            assert data.descriptions == words
