"""Reading a scene's images with their cameras and suns."""

from __future__ import annotations

import logging
import math
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from sattools.camera.ground import crop_window, ground_sample_distance, middle_lon_lat
from sattools.camera.rpc import RPC
from sattools.errors import InputError, SceneError, counted
from sattools.processors import side_by_side
from sattools.radiometry.bands import chosen_bands
from sattools.radiometry.holes import without_holes
from sattools.radiometry.linear import eight_bits, linear_radiance, shared_bits
from sattools.radiometry.saturated import NOTED, Saturated, conversion_of
from sattools.scene import Asset, Grid, Item, Scene
from sattools.scene.pixels import ImagePart, image_part
from sattools.views.check import check_cells, check_extent, check_scene
from sattools.views.resample import View, line_of_sight, make_view

log = logging.getLogger(__name__)
BALANCE_PROPERTY = "sattools:radiometric_balance"
GROUND_SHARE = 0.3  # of the height range, below where images are laid over the grid: most of a scene is near the ground
AT_ONCE = 4  # images that are read or resampled at a time: each needs its memory
_FEWEST_PIXELS = 100  # so many are not alike by chance
_SPARE_CELLS = 40  # around what is looked at: windows of the matching reach over the border
_PIXELS_PER_CELL = 1.5  # that are kept where an image is read reduced: about what `prep` chooses a cell by


@dataclass(frozen=True)
class RadiometricBalance:
    """How an image becomes comparable with the others of a large area.

    Gain and offset per band, and the contrast and tone of all images; the property ``sattools:radiometric_balance`` of
    the images of a tile, which shows too little of it. A tone of 0 is not known.
    """

    gain: list[float]
    offset: list[float]
    contrast: float
    tone: float = 0.0


@dataclass(frozen=True)
class Source:
    """One image with its camera: radiance ``[C, h, w]`` float32 (NaN = invalid), sun (azimuth, elevation) or None.

    ``saturated``: what is known of pixels that are invalid because they are too bright.
    """

    id: str
    radiance: np.ndarray
    rpc: RPC
    sun: tuple[float, float] | None
    linear: bool = True
    balance: RadiometricBalance | None = None
    saturated: Saturated | None = None

    def complete(self) -> Source:
        """With saturated pixels as they are: no radiance to be explained, but structure to be matched.

        Single missing pixels get numbers from their neighbours where they are many; see `without_holes`.
        """
        radiance = self.saturated.within(self.radiance) if self.saturated else self.radiance
        return replace(self, radiance=without_holes(radiance))


def with_bands(sources: Sequence[Source], items: Sequence[Item], wanted: Sequence[str]) -> list[Source]:
    """Sources of these items with the ``wanted`` bands of their radiance alone; see `chosen_bands`."""
    if not wanted:
        return list(sources)
    found = []
    for source, item in zip(sources, items, strict=True):
        places = [number - 1 for number in chosen_bands(item, wanted, source.radiance.shape[0])]
        saturated = source.saturated.of_bands(places) if source.saturated else None
        found.append(replace(source, radiance=source.radiance[places], saturated=saturated))
    return found


@dataclass(frozen=True)
class Opened:
    """Items whose files are there and go with each other, before a pixel is read.

    Attributes:
        names: of the assets with the pixels.
        cameras: of the images.
        parts: where the pixels are.
        bands: of every image.
    """

    names: list[str]
    cameras: list[RPC]
    parts: list[ImagePart]
    bands: int


def open_images(scene: Scene, items: Sequence[Item]) -> Opened:
    """Find the radiance (asset `radiance`, else `image`) and the camera of every item; see `load_sources`."""
    for item in items:
        if "rpc" not in item.assets:
            raise SceneError(f"scene {scene.id}: item {item.id} has no asset 'rpc', expected a corrected camera")
        if not {"radiance", "image"} & item.assets.keys():
            raise SceneError(f"scene {scene.id}: item {item.id} has no asset 'image' or 'radiance'")
    cameras = [RPC.from_file(scene.path(item.assets["rpc"].href)) for item in items]
    names = ["radiance" if "radiance" in item.assets else "image" for item in items]
    parts = [image_part(scene, item, name) for item, name in zip(items, names, strict=True)]
    check_scene(scene, items, cameras, [part.shape for part in parts])
    counts = [part.bands for part in parts]
    usual = Counter(counts).most_common(1)[0][0] if counts else 0
    for part, count in zip(parts, counts, strict=True):
        if count != usual:
            raise SceneError(
                f"{part.path}: found {counted(count, 'bands')}, expected {usual} as most of the other images have"
            )
    return Opened(names, cameras, parts, usual)


def used_assets(assets: Mapping[str, Asset]) -> list[str]:
    """Names of the assets of an image whose files `load_sources` reads.

    Args:
        assets: of the item.
    """
    radiance = assets.get("radiance")
    pixels = ["radiance", *(["image"] if NOTED in radiance.extra else [])] if radiance else ["image"]
    return ["rpc", *(name for name in pixels if name in assets)]


def load_sources(scene: Scene, items: Sequence[Item], opened: Opened | None = None) -> list[Source]:
    """Read the radiance (asset `radiance`, else the normalised `image`) and the camera of every item.

    Only the window that shows the scene's grid is read, and where a cell has many pixels, their means; the camera is
    that of what was read.

    Args:
        scene: of the items.
        items: the images.
        opened: what `open_images` has found of them, if it has looked already.

    Raises:
        SceneError: an item without image or camera, or images with different numbers of bands.
        InputError: a file that cannot be read.
    """
    opened = opened or open_images(scene, items)
    names, cameras, parts = opened.names, opened.cameras, opened.parts
    around = _surroundings(scene, cameras)
    needed = [
        _needed(camera, part.shape, around, scene.height_range_m) for camera, part in zip(cameras, parts, strict=True)
    ]

    def pixels(k: int) -> tuple[np.ndarray, Saturated | None]:
        rows, cols, reduce = needed[k]
        radiance, conversion = parts[k].read((rows, cols), reduce), conversion_of(items[k])
        if conversion is None:
            return radiance, None
        try:
            return radiance, conversion.saturated(radiance, image_part(scene, items[k]).read((rows, cols), reduce))
        except InputError as error:
            log.warning("%s: its saturated pixels stay unknown: %s", items[k].id, error)
            return radiance, None

    sources = []
    read = side_by_side(pixels, range(len(parts)), AT_ONCE)
    for item, camera, name, (radiance, saturated), (rows, cols, reduce) in zip(
        items, cameras, names, read, needed, strict=True
    ):
        if name == "image":
            radiance = linear_radiance(radiance, shared_bits(item, scene.items))
        rpc = camera.cropped(cols.start, rows.start).reduced(reduce)
        if item.sun is None:
            log.warning("%s: sun unknown: no cast shadows for this image", item.id)
        # `normalise` says so where it left a tone-mapped image as it was
        toned = item.properties.get("sattools:tone") == "tone-mapped"
        linear = not toned and ("radiance" in item.assets or not eight_bits(item.properties))
        given = item.properties.get(BALANCE_PROPERTY)
        balance = RadiometricBalance(**given) if given else None
        sources.append(Source(item.id, radiance, rpc, item.sun, linear, balance, saturated))
    return sources


def warn_of_blank(sources: Sequence[Source]) -> list[str]:
    """Warn of images that show one number all over the area; what was said, for the history.

    `prep` refuses such images, so that their files have been replaced since.

    Args:
        sources: of the whole area; a part of it may look so.
    """
    notes = []
    for source in sources:
        shown = [band[np.isfinite(band)] for band in source.radiance]
        if all(len(numbers) >= _FEWEST_PIXELS and numbers.min() == numbers.max() for numbers in shown):
            notes.append(f"{source.id}: shows one number all over the area, in which nothing is seen: leave it out")
            log.warning("%s", notes[-1])
    return notes


def _surroundings(scene: Scene, cameras: Sequence[RPC]) -> Grid | None:
    """The scene's grid, wider by what points of the height range are displaced in any image.

    None = no grid yet, or a camera of another place, which is told where its pixels are looked for.
    """
    if scene.grid is None or scene.height_range_m is None:
        return None
    grid, z_range = scene.grid, scene.height_range_m
    slopes = [line_of_sight(rpc, grid, z_range[0], z_range)[0] for rpc in cameras]
    reach = max((abs(value) for slope in slopes for value in slope), default=0.0) * (z_range[1] - z_range[0])
    if not math.isfinite(reach):
        return None
    return grid.widened(_SPARE_CELLS + math.ceil(reach / grid.cell_size))


def _needed(
    rpc: RPC, shape: tuple[int, int], around: Grid | None, z_range: tuple[float, float] | None
) -> tuple[slice, slice, int]:
    """Rows and columns of an image that show a grid, and how many pixels along an axis may be read as one."""
    whole = slice(0, shape[0]), slice(0, shape[1]), 1
    if around is None or z_range is None:
        return whole
    col, row, width, height = crop_window(rpc, around.crs, around.bounds, z_range, shape, 0)
    if min(width, height) == 0:
        return whole
    lon, lat = middle_lon_lat(around)
    pixels = around.cell_size / ground_sample_distance(rpc, lon, lat, z_range[0])
    return slice(row, row + height), slice(col, col + width), max(1, int(pixels / _PIXELS_PER_CELL))


def views_on(sources: Sequence[Source], grid: Grid, z_ref: float, z_range: tuple[float, float]) -> list[View]:
    """All sources resampled to a grid; see `make_view`.

    Args:
        sources: the images.
        grid: ground grid.
        z_ref: reference height [m].
        z_range: lowest and highest height [m].

    Raises:
        SceneError: an image shows nothing of the grid, or the grid has next to no cells.
    """
    check_extent(grid)
    if sources:
        lon, lat = middle_lon_lat(grid)
        pixel = max(ground_sample_distance(s.rpc, lon, lat, z_ref) for s in sources)
        check_cells(grid, pixel, sources[0].radiance.shape[0], len(sources))

    def view_of(s: Source) -> View:
        return make_view(s.id, s.radiance, s.rpc, grid, z_ref, z_range, sun=s.sun)

    views = list(side_by_side(view_of, sources, AT_ONCE))
    for view in views:
        check_seen(view.id, view.mask)
    return views


def check_seen(item_id: str, mask: np.ndarray, remedy: str | None = None) -> None:
    """Raise SceneError if an image shows nothing of the grid.

    Args:
        item_id: the image's id.
        mask: of any shape; all-zero if it shows nothing.
        remedy: what the user can do; None = fit without it.
    """
    if not mask.any():
        remedy = remedy or f"`sattools fit --holdout {item_id}` goes on without it"
        raise SceneError(
            f"image {item_id}: found no valid pixel on the scene's grid, expected an image of this place ({remedy})"
        )


__all__ = [
    "BALANCE_PROPERTY",
    "GROUND_SHARE",
    "Opened",
    "RadiometricBalance",
    "Source",
    "check_seen",
    "load_sources",
    "open_images",
    "used_assets",
    "views_on",
    "warn_of_blank",
    "with_bands",
]
