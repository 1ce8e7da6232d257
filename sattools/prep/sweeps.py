"""What coarse looks at the ground tell once cameras are right: the range of heights, and clouds."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import compress

import numpy as np
from shapely.geometry import Polygon

from sattools.camera import RPC
from sattools.camera.adjust import Adjustment
from sattools.camera.heights import estimate_height_range
from sattools.camera.tracks import Tracks
from sattools.errors import InputError
from sattools.prep.clouds import find_clouds
from sattools.prep.gate import much_coarser
from sattools.prep.images import SourceImage
from sattools.prep.large import GrayImages
from sattools.prep.layout import (
    Bounds,
    common_bounds,
    data_edge,
    ground_polygon,
    pixels_on_ground,
    with_surroundings,
)
from sattools.progress import Progress
from sattools.scene.blocks import Blocks

ENOUGH = 4  # images with known cameras, without which the others are looked at, too
HIDDEN = 0.95  # share of what an image shows of the area, from which on clouds leave nothing of use


def height_range(
    given: tuple[float | None, float | None],
    result: Adjustment,
    whole: GrayImages,
    crs: str,
    asked: Bounds | None,
    progress: Progress,
) -> tuple[float, float]:
    """Lowest and highest height of the surface [m]: the user's, or what the images tell.

    Images much coarser than the others do not show the roofs of towers, nor do those of unknown cameras where they are,
    and they outvote those that do.

    Args:
        given: heights that the user gave.
        result: the cameras.
        whole: the images.
        crs: projected ground CRS [m].
        asked: the area asked for (west, south, east, north) [m].
        progress: told the share done and what is being done.

    Raises:
        InputError: no ground that two images show.
    """
    low, high = given
    if low is None or high is None:
        heights = result.heights()
        cameras = whole.cameras(result.rpcs)
        middle = float(np.median(heights))
        bounds = with_surroundings(asked) if asked else common_bounds(_polygons(whole, cameras, middle, crs))
        if bounds is None:
            raise InputError("images: found no ground that two of them show, expected images that overlap")
        good = ~much_coarser(*pixels_on_ground(cameras, [gray.shape[:2] for gray in whole.grays], middle))
        sure = good & [not view.weak for view in result.views]
        good = sure if sure.sum() >= ENOUGH else good
        grays, cameras = list(compress(whole.grays, good)), list(compress(cameras, good))
        estimate = estimate_height_range(heights, grays, cameras, crs, bounds, progress=progress)
        low, high = (estimate[0] if low is None else low), (estimate[1] if high is None else high)
    return round(float(low), 2), round(float(high), 2)


def mask_clouds(
    sources: Sequence[SourceImage],
    result: Adjustment,
    whole: GrayImages,
    crs: str,
    asked: Bounds | None,
    heights: tuple[float, float],
) -> list[str]:
    """Find clouds, tell them, and give them to the images; returns the ids of those that show next to nothing else.

    Args:
        sources: the images; get their clouds.
        result: the cameras and tie points.
        whole: the images as they are looked at.
        crs: projected ground CRS [m].
        asked: the area asked for (west, south, east, north) [m]; None = wherever two images show the ground.
        heights: lowest and highest of the surface [m].
    """
    cameras = whole.cameras(result.rpcs)
    if asked is not None:
        bounds: Bounds | None = with_surroundings(asked)
    else:
        bounds = common_bounds(_polygons(whole, cameras, 0.5 * (heights[0] + heights[1]), crs), share=0.0)
    if bounds is None:
        return []
    factor = np.array(whole.factors, float)[result.tracks.view, None]
    tracks = Tracks(result.tracks.point, result.tracks.view, (result.tracks.pixel + 0.5) / factor - 0.5)
    hidden = []
    clouds = find_clouds(whole.grays, cameras, tracks, crs, bounds, heights)
    for source, found, times in zip(sources, clouds, whole.factors, strict=True):
        if found is None:
            continue
        source.clouds = Blocks(found.places, found.step * times, source.window[:2])
        if found.share < HIDDEN:
            source.warn(
                f"clouds or glare hide {max(1, round(100 * found.share))} % of what it shows of the area, masked "
                "(`--clouds keep` leaves them)"
            )
        else:
            hidden.append(source.id)
    return hidden


def _polygons(whole: GrayImages, cameras: Sequence[RPC], height: float, crs: str) -> list[Polygon]:
    """Where the images have data, on the ground."""
    both = zip(cameras, whole.grays, strict=True)
    return [ground_polygon(r, (0, 0, g.shape[1], g.shape[0]), height, crs, data_edge(g)) for r, g in both]


__all__ = ["height_range", "mask_clouds"]
