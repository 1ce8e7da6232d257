"""Surfaces of two dates, read where they are wanted."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from sattools.compare.doubts import check_heights
from sattools.compare.truth import grid_on_ground, known_heights, warped_heights
from sattools.errors import InputError
from sattools.radiometry.bands import COMMON_NAMES
from sattools.scene import Grid, Scene
from sattools.scene.dependencies import check_current
from sattools.scene.location import is_remote, location
from sattools.scene.opening import opened
from sattools.scene.placement import has_grid
from sattools.scene.raster import raster_bands, raster_grid, read_around, read_raster
from sattools.scene.regrid import reproject_map
from sattools.scene.validity import MEASURED

LAYERS = {"height": "dsm", "std": "dsm_std", "albedo": "albedo", "confidence": "prior_confidence"}  # -> product


@dataclass(frozen=True)
class Surface:
    """One date.

    Attributes:
        name: of the scene or file.
        layers: files by name: ``height`` [m], ``std`` [m], ``albedo``, ``confidence`` of the matching, 0 to 1.
        validity: file that says where the height was measured; None = everywhere.
        grid: of the height.
        files: that are read.
    """

    name: str
    layers: Mapping[str, Path]
    validity: Path | None
    grid: Grid
    files: tuple[Path, ...]

    def bands(self, layer: str) -> int:
        """Number of a layer's bands; 0 where there is no such layer."""
        return raster_bands(self.layers[layer]) if layer in self.layers else 0

    def band_names(self, layer: str) -> list[str]:
        """What a layer's file calls its bands, STAC's common names or numbers; empty where it does not."""
        with opened(self.layers[layer]) as data:
            words = [str(text or "").split(" ")[-1].casefold() for text in data.descriptions]
        known = all(word in COMMON_NAMES or word.isdecimal() for word in words) and len(set(words)) == len(words)
        return ["nir" if word == "nir08" else word for word in words] if known else []

    def on(self, layer: str, where: Grid) -> np.ndarray:
        """A layer ``[B, h, w]`` float32, in its unit, on a grid; NaN where nothing was measured.

        Args:
            layer: one that is there.
            where: grid in any CRS.

        Raises:
            InputError: a file that cannot be read.
        """
        path = self.layers[layer]
        if layer == "height" and not has_grid(path):  # a raster: a scene's has been found on a grid
            return warped_heights(path, where, means=True)[None]
        found = read_around(path, where)
        if found is None:
            return np.full((self.bands(layer), *where.shape), np.nan, np.float32)
        array, grid = found
        if layer == "height":
            array = known_heights(array[:1])
            if self.validity is not None:
                array = np.where(read_raster(self.validity, grid)[0][:1] == MEASURED, array, np.float32(np.nan))
        return reproject_map(array.astype(np.float32), grid, where, means=True)

    @property
    def height(self) -> np.ndarray:
        """``[H, W]`` [m], all of it; NaN where nothing was measured."""
        return self.on("height", self.grid)[0]


def order_of_bands(old: Surface, new: Surface) -> list[int]:
    """Number, from 0, of the later albedo's band that is each of the earlier one's; empty where they differ.

    Bands without names, and those of which one date knows names and the other numbers, are taken in their order.

    Args:
        old: earlier date.
        new: later date.
    """
    count = old.bands("albedo")
    if count == 0 or count != new.bands("albedo"):
        return []
    before, after = old.band_names("albedo"), new.band_names("albedo")
    if set(before) == set(after) and before:
        return [after.index(name) for name in before]
    alike = [{word.isdecimal() for word in words} for words in (before, after)]
    return [] if before and after and alike[0] == alike[1] else list(range(count))


def check_surface(source: str) -> None:
    """What can be known of a surface by itself, so that of two wrong ones the first is told.

    Args:
        source: as of `read_surface`.

    Raises:
        InputError, SceneError: there is no such file, or it is neither a document nor heights.
    """
    path = location(source)
    if not is_remote(path) and not path.exists():
        raise InputError(f"{source}: no such file, expected a scene document or a raster of heights")
    if _is_raster(path):
        check_heights(path, one_band=True)
    else:
        Scene.from_file(path)


def _is_raster(path: Path) -> bool:
    return path.suffix.lower() != ".json" and not path.is_dir()


def read_surface(source: str, crs: str | None = None) -> Surface:
    """The exported surface of a scene document, or a raster of heights [m].

    Args:
        source: document or file.
        crs: projected CRS [m] of the grid of a raster whose own counts no metres on the ground; None = UTM.

    Raises:
        InputError: neither can be read, a raster has other numbers than heights, or maps are on different grids.
        SceneError: a scene without an exported DSM, or whose DSM is older than its fit.
    """
    path = location(source)
    if _is_raster(path):
        check_heights(path, one_band=True)
        return Surface(path.stem, {"height": path}, None, grid_on_ground(path, crs)[0], (path,))
    scene = Scene.from_file(path)
    if "dsm" not in scene.products:
        raise InputError(f"{path}: found no product 'dsm', expected a scene after `sattools export`")
    check_current(scene, "export")
    layers = {name: scene.path(scene.products[own]) for name, own in LAYERS.items() if own in scene.products}
    validity = scene.path(scene.products["validity"]) if "validity" in scene.products else None
    grid = raster_grid(layers["height"])
    for file in (layers.get("std"), layers.get("albedo"), validity):
        if file is not None and raster_grid(file) != grid:
            raise InputError(f"{file}: found another grid than the DSM's, expected one export")
    used = [*layers.values(), *([] if validity is None else [validity])]
    return Surface(scene.id, layers, validity, grid, (path, *used))


__all__ = ["Surface", "check_surface", "order_of_bands", "read_surface"]
