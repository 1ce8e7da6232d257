"""Where images lie before anything is known of the ground's heights but the cameras' ranges, or what the user says."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from shapely.geometry import Polygon

from sattools.camera import RPC
from sattools.camera.ground import crop_window
from sattools.errors import InputError, some_of
from sattools.prep.images import SourceImage
from sattools.prep.layout import Bounds, ground_polygon, groups, outline, with_surroundings
from sattools.prep.outputs import MARGIN_PX
from sattools.scene.globe import near_longitude
from sattools.scene.members import HEIGHT_LIMITS_M

Given = tuple[float | None, float | None]  # lowest, highest height of the surface that the user gave [m]

_LEAST_WINDOW_PX = 64  # along an axis: less of an image ties it to no other
_BIAS_MARGIN_PX = 150  # raw cameras may be off by that much; the corrected ones need far less
_LEAST_HALF_M = 600.0  # of the search for tie points, whatever the cameras' ranges
_STEPS = 24  # of the cameras' ranges at which images are looked for together

_CHOICE = " (of images of several places, `--bounds` or `--aoi` take those that show an area)"


@dataclass(frozen=True)
class SearchHeights:
    """Where tie points are looked for: this far below and above a height [m]."""

    middle: float
    half: float


def search_heights(sources: Sequence[SourceImage], given: Given) -> SearchHeights:
    """Heights of the cameras' ranges, which mountains may be far from the middle of, and those given by the user.

    Args:
        sources: the images.
        given: heights that the user gave.
    """
    middle = float(np.median([s.rpc.alt_offset for s in sources]))
    ends = [end for s in sources for end in _within_earth(s.rpc)] + [height for height in given if height is not None]
    return SearchHeights(middle, max(_LEAST_HALF_M, *(abs(end - middle) for end in ends)))


def ground_heights(rpc: RPC, given: Given) -> tuple[float, float]:
    """Lowest and highest height [m] at which the ground may lie: the camera's range, but for what the user gave.

    Args:
        rpc: the camera.
        given: heights that the user gave.
    """
    low, high = (ours if user is None else user for ours, user in zip(_within_earth(rpc), given, strict=True))
    if low >= high:  # one was given, beyond the other end of the range
        return (low, low + _LEAST_HALF_M) if given[0] is not None else (high - _LEAST_HALF_M, high)
    return low, high


def _within_earth(rpc: RPC) -> tuple[float, float]:
    low, high = rpc.altitude_range
    return max(low, HEIGHT_LIMITS_M[0]), min(high, HEIGHT_LIMITS_M[1])


def check_places(sources: Sequence[SourceImage], crs: str, given: Given = (None, None)) -> None:
    """Raise InputError when images do not lie together, naming the one whose RPC is of another place.

    Small images that look at high mountains from several sides are far apart at the middle of their cameras' ranges:
    that they overlap at any of the heights is enough.

    Args:
        sources: the images.
        crs: projected ground CRS [m].
        given: heights that the user gave.
    """
    polygons = _polygons(sources, crs, [s.rpc.alt_offset for s in sources])
    for source, polygon in zip(sources, polygons, strict=True):
        if polygon.is_empty:
            raise InputError(
                f"{source.path}: found an RPC that does not reach the image's pixels or the ground around the other "
                f"images, expected the RPC of this image (from {source.metadata.rpc_source})"
            )
    places = groups(polygons)
    if len(places) == 1 or _meet_elsewhere(sources, crs, given):
        return
    if len(places[0]) == 1 or len(places[0]) == len(places[1]):
        raise InputError(
            f"{sources[places[1][0]].path}: found no overlap with {sources[places[0][0]].path}, "
            f"expected images of one place{_CHOICE if len(sources) > 2 else ''}"
        )
    stray = places[1][0]
    lon, lat = np.nanmean(outline(sources[stray].rpc, sources[stray].window, sources[stray].rpc.alt_offset), axis=0)
    distance = polygons[stray].distance(polygons[places[0][0]]) / 1000.0
    raise InputError(
        f"{sources[stray].path}: found its RPC at {lat:.4f} N {lon:.4f} E, {distance:.1f} km from the other images, "
        f"expected images that overlap (RPC from {sources[stray].metadata.rpc_source})"
        f"{_CHOICE if len(places) > 2 or len(places[1]) > 1 else ''}"
    )


def _polygons(sources: Sequence[SourceImage], crs: str, heights: Sequence[float]) -> list[Polygon]:
    return [ground_polygon(s.rpc, s.window, height, crs) for s, height in zip(sources, heights, strict=True)]


def _meet_elsewhere(sources: Sequence[SourceImage], crs: str, given: Given) -> bool:
    """Whether all images overlap, directly or through others, at any height at which the ground may lie."""
    ranges = [ground_heights(s.rpc, given) for s in sources]
    lowest, highest = min(low for low, _ in ranges), max(high for _, high in ranges)
    for height in np.linspace(lowest, highest, _STEPS + 1):
        polygons = _polygons(sources, crs, [float(height)] * len(sources))
        if not any(polygon.is_empty for polygon in polygons) and len(groups(polygons)) == 1:
            return True
    return False


def middle_of(sources: Sequence[SourceImage]) -> tuple[float, float]:
    """Longitude and latitude in the middle of the images. Raises InputError where no camera reaches its pixels."""
    centres = [s.rpc.localization((s.size[1] - 1) / 2, (s.size[0] - 1) / 2, s.rpc.alt_offset) for s in sources]
    known = [place for place in centres if np.isfinite(place).all()]
    if not known:
        raise InputError(f"{sources[0].path}: found RPCs that do not reach the images' pixels, expected their own RPCs")
    # one camera may count longitudes from -180 degrees where another one, on the same ground, counts up to 180 or 360
    lons = [near_longitude(lon, known[0][0]) for lon, _ in known]
    return float(np.median(lons)), float(np.median([lat for _, lat in known]))


def cropped_to_area(
    sources: list[SourceImage], crs: str, asked: Bounds, given: Given, notes: list[str]
) -> list[SourceImage]:
    """Sources with windows that surely hold the area; those that do not see it are left out.

    Args:
        sources: the images.
        crs: projected ground CRS [m].
        asked: the area (west, south, east, north) [m].
        given: heights that the user gave.
        notes: gets those left out.

    Raises: InputError where fewer than two are left.
    """
    kept, left = [], []
    for s in sources:
        window = _window_of(s, crs, asked, given)
        if window is None:
            left.append(s.id)
            continue
        s.window = window
        kept.append(s)
    if len(kept) < 2:
        w, south, e, n = asked
        raise InputError(
            f"area {w:.1f} {south:.1f} {e:.1f} {n:.1f} ({crs}): found {len(kept)} of {len(sources)} images that show "
            "it, expected an area inside the images"
        )
    if left:
        notes.append(f"{some_of(left)}: {'does' if len(left) == 1 else 'do'} not show the area, left out")
    return kept


def _window_of(s: SourceImage, crs: str, asked: Bounds, given: Given) -> tuple[int, int, int, int] | None:
    """The window of an image that surely holds an area, None where it shows next to nothing of it."""
    window = crop_window(s.rpc, crs, asked, ground_heights(s.rpc, given), s.size, _BIAS_MARGIN_PX)
    return None if window[2] < _LEAST_WINDOW_PX or window[3] < _LEAST_WINDOW_PX else window


def show(sources: Sequence[SourceImage], crs: str, asked: Bounds, given: Given) -> bool:
    """Whether two images or more show an area; arguments as of `cropped_to_area`."""
    return sum(_window_of(s, crs, asked, given) is not None for s in sources) >= 2


def sizes_read(sources: list[SourceImage], crs: str, asked: Bounds | None, given: Given) -> list[tuple[int, int]]:
    """Rows and columns that are read of images: all, or of an area the windows, or what is kept around it if larger.

    Args:
        sources: the images, with windows.
        crs: projected ground CRS [m].
        asked: the area (west, south, east, north) [m]; None = all that they show.
        given: heights that the user gave.
    """
    windows = [s.window for s in sources]
    if asked is None:
        return [(rows, columns) for _, _, columns, rows in windows]
    around = with_surroundings(asked)
    kept = [crop_window(s.rpc, crs, around, ground_heights(s.rpc, given), s.size, MARGIN_PX) for s in sources]
    return [(max(a[3], b[3]), max(a[2], b[2])) for a, b in zip(windows, kept, strict=True)]


__all__ = [
    "SearchHeights",
    "check_places",
    "cropped_to_area",
    "ground_heights",
    "middle_of",
    "search_heights",
    "show",
    "sizes_read",
]
