"""The maps of a fitted surface, written block by block."""

from __future__ import annotations

import math
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sattools.errors import InputError
from sattools.export.blocks import Block, Surroundings
from sattools.export.context import Exported, band_names, follows_prior, radiance_scale, shadow_suns, view_href
from sattools.export.datum import datum_name, to_datum, vertical_crs
from sattools.export.hillshade import write_picture
from sattools.fit.described import Description
from sattools.fit.stored import CellMaps, StoredModel
from sattools.scene import Asset, Grid, Scene
from sattools.scene.cog import CogWriter, cogs
from sattools.scene.memory import give_back
from sattools.scene.raster import read_on
from sattools.scene.validity import FILLED, LEVELLED, MEANING, MEASURED

# what the model may hold per image
IMAGE_MAPS = {
    "s_net": "learned sun visibility, 1 = lit",
    "tau": "share of the light that transient objects leave",
    "beta": "learned uncertainty of the radiance",
}
DSM, STD, ALBEDO, PICTURE = "export/dsm.tif", "export/dsm_std.tif", "export/albedo.tif", "export/dsm.png"
VALIDITY, PROBABILITY = "export/validity.tif", "export/probability.tif"
WATER = "prior_water"  # product that says where the prior laid water level
ERROR95 = "export/dsm_error95.tif"
# what the prior says of its heights -> its product, and the file on the cells of the surface: a fit that starts from
# matching corrects its heights by less than a metre nearly everywhere
OF_PRIOR = {"prior_probability": PROBABILITY, "prior_dsm_std": STD, "prior_dsm_error95": ERROR95}
_PICTURE_CELLS = 1500  # along the longer edge of the picture
_SOFTWARE = {"SOFTWARE": "sattools"}
_ABOUT_PRIOR: dict[str, dict[str, Any]] = {
    PROBABILITY: {"units": "1", "descriptions": ["probability of less than 1 m of error"]},
    STD: {"units": "m", "descriptions": ["standard deviation of the height: 68 % of the errors are smaller"]},
    ERROR95: {"units": "m", "descriptions": ["95 % of the errors of the height are smaller"]},
}


class SurfaceFiles:
    """DSM, its standard deviation, validity, albedo, and per image the cast shadow and what the model holds.

    Used by ``with``, at the end of which the files are there and the scene names them.

    Args:
        scene: gets products and assets.
        stored: the model.
        vertical: datum of the heights.
        validity: whether it is known.

    Raises:
        SattoolsError: a file cannot be written, or the datum is not known here.
    """

    def __init__(self, scene: Scene, stored: StoredModel, vertical: str, validity: bool) -> None:
        model, grid = stored.about, stored.grid
        self.scene, self.grid, self.vertical, self.datum = scene, grid, vertical, datum_name(vertical)
        self._stack = ExitStack()
        self._step = max(1, math.ceil(max(grid.shape) / _PICTURE_CELLS))
        self._picture = np.full([math.ceil(n / self._step) for n in grid.shape], np.nan, np.float32)
        method = "curvature of the photometric loss; gross errors of matching are not in it"
        if model.field != "surface":
            method = "spread of the height at which vertical rays lose their light; gross errors are not in it"
        kept = {"HEIGHTS": words} if (words := heights_of_start(model)) else {}
        names, wavelengths = band_names(scene, model, "albedo", stored.bands)
        about: dict[str, dict[str, Any]] = {
            DSM: {
                "units": "m",
                "tags": {"VERTICAL_DATUM": self.datum, **kept, **_SOFTWARE},
                "descriptions": ["height"],
                "vertical": vertical_crs(vertical),
            },
            STD: {
                "units": "m",
                "tags": {"METHOD": method, **_SOFTWARE},
                "descriptions": ["standard deviation of the height"],
            },
            ALBEDO: {
                "bands": len(names),
                "units": "1",
                "tags": {"SCALE": radiance_scale(model), **_SOFTWARE, **wavelengths},
                "descriptions": names,
            },
        }
        if validity:
            tags = {"MEANING": MEANING, **_SOFTWARE}
            about[VALIDITY] = {"dtype": np.uint8, "nodata": None, "tags": tags, "descriptions": ["validity"]}
        said = OF_PRIOR.items() if follows_prior(scene) else ()
        self._prior = {href: scene.path(scene.products[name]) for name, href in said if name in scene.products}
        for product, href in OF_PRIOR.items():
            if href in self._prior:
                about[href] = _ABOUT_PRIOR[href] | {"tags": {"METHOD": f"of the prior, see {product}", **_SOFTWARE}}
        items = {item.id for item in scene.items}
        self._suns = [(name, sun) for name, sun in shadow_suns(model) if name in items]
        for name, _ in self._suns:
            tags = {"METHOD": "cast by the DSM under the sun of the image", **_SOFTWARE}
            shadow = {"dtype": np.uint8, "nodata": 255, "tags": tags, "descriptions": ["1 = cast shadow"]}
            about[view_href("shadow", name)] = shadow
        self._image_maps = {
            (kind, name): view_href(kind, name)
            for kind in stored.image_maps
            for name, known in zip(model.items, _known(stored, kind), strict=True)
            if name in items and known
        }
        for (kind, _), href in self._image_maps.items():
            about[href] = {"units": "1", "tags": dict(_SOFTWARE), "descriptions": [IMAGE_MAPS[kind]]}
        self._files = {href: CogWriter(scene.output(href), grid, **options) for href, options in about.items()}

    def __enter__(self) -> SurfaceFiles:
        self._stack.enter_context(cogs(self._files.values()))
        return self

    def write(
        self,
        block: Block,
        exported: Exported,
        maps: CellMaps,
        surface: Surroundings,
        validity: NDArray[np.uint8] | None,
        saturated: NDArray[np.bool_] | None = None,
    ) -> None:
        """Write a block.

        Args:
            block: where it lies.
            exported: where the model of its cells may be shown.
            maps: of that.
            surface: heights of the whole.
            validity: ``[h, w]``, how its heights came about.
            saturated: ``[h, w]``, where no image shows a radiance; None = nowhere.
        """
        heights, _ = to_datum(maps.height, block.grid, self.vertical)
        dsm = exported.shown(heights)
        self._put(DSM, dsm, block)
        # where an image's own offset was found wrong, the darkest ground comes out below none at all
        albedo = np.maximum(maps.albedo.transpose(2, 0, 1), 0)
        if saturated is not None:
            albedo = np.where(saturated, np.float32(np.nan), albedo)
        self._put(ALBEDO, exported.shown(albedo), block)
        if validity is not None:
            self._put(VALIDITY, validity, block)
        of_prior = {STD: maps.height_std}
        for href, path in self._prior.items():
            of_prior[href] = _one_band(path, block.grid)
        of_prior[STD] = np.where(np.isfinite(of_prior[STD]), of_prior[STD], maps.height_std)
        for href, values in of_prior.items():
            self._put(href, exported.shown(values), block)
        for name, sun in self._suns:
            lit = surface.lit(block, sun)
            self._put(view_href("shadow", name), np.where(exported.valid, lit < 0.5, 255).astype(np.uint8), block)
        for (kind, name), href in self._image_maps.items():
            self._put(href, exported.shown(maps.images[kind][exported.about.items.index(name)]), block)
        rows, cols = (range(-(-s.start // self._step), -(-s.stop // self._step)) for s in (block.rows, block.cols))
        first = rows.start * self._step - block.rows.start, cols.start * self._step - block.cols.start
        small = dsm[first[0] :: self._step, first[1] :: self._step]
        self._picture[rows.start : rows.stop, cols.start : cols.stop] = small

    def _put(self, href: str, values: np.ndarray, block: Block) -> None:
        self._files[href].write(values, block.rows, block.cols)

    def __exit__(self, *error: Any) -> None:
        self._stack.__exit__(*error)
        if error[0] is not None:
            return
        give_back()  # what was held of the maps, before a picture is drawn
        scene = self.scene
        grid = self.grid.resized(self.grid.cell_size * self._step)
        title = f"{scene.id}: DSM, {self.grid.cell_size:g} m"
        write_picture(self._picture, grid, title, scene.output(PICTURE), self.datum)
        scene.products.update(dsm=DSM, dsm_std=STD, albedo=ALBEDO, dsm_picture=PICTURE)
        if VALIDITY in self._files:
            scene.products["validity"] = VALIDITY
        for name, href in (("probability", PROBABILITY), ("dsm_error95", ERROR95)):
            if href in self._files:
                scene.products[name] = href
        assets = [("shadow", name, view_href("shadow", name)) for name, _ in self._suns]
        assets += [(kind, name, href) for (kind, name), href in self._image_maps.items()]
        items = {item.id: item for item in scene.items}
        for kind, name, href in assets:
            items[name].assets[kind] = Asset(href)


def heights_of_start(about: Description) -> str | None:
    """Where the heights of a field of rays are from, in words, if they are not its own."""
    if about.heights == "own":
        return None
    start = "surface fit" if about.heights == "surface" else "prior"
    return f"those of the {start} that the field started from: its own were not found to explain held-out rays better"


def with_water(scene: Scene, validity: NDArray[np.uint8], grid: Grid) -> NDArray[np.uint8]:
    """Validity ``[h, w]`` on a part of the ground, with water that the prior laid level.

    Two images may see it, but its height is an assumption. Priors of other programs and older versions do not say, and
    those that the fit has not used say nothing of its heights.

    Raises:
        InputError: the map cannot be read.
    """
    if WATER not in scene.products or not follows_prior(scene):
        return validity
    laid = _one_band(scene.path(scene.products[WATER]), grid) >= 0.5  # of a cell, at least
    known = (validity == MEASURED) | (validity == FILLED)
    return np.where(laid & known, LEVELLED, validity).astype(np.uint8)


def _one_band(path: Path, target: Grid) -> np.ndarray:
    """A raster with one band ``[h, w]`` on a part of the ground."""
    array = read_on(path, target)
    if len(array) != 1:
        raise InputError(f"{path}: found {len(array)} bands, expected one")
    return np.asarray(array[0])


def _known(stored: StoredModel, kind: str) -> NDArray[np.bool_]:
    """Whether a map of every image is known anywhere."""
    everywhere = slice(0, stored.grid.width)
    parts = (stored.maps(rows, everywhere).images[kind] for rows in stored.strips())
    return np.logical_or.reduce([np.isfinite(part).any(axis=(1, 2)) for part in parts])


__all__ = [
    "ALBEDO",
    "DSM",
    "ERROR95",
    "IMAGE_MAPS",
    "PICTURE",
    "PROBABILITY",
    "STD",
    "VALIDITY",
    "WATER",
    "SurfaceFiles",
    "heights_of_start",
    "with_water",
]
