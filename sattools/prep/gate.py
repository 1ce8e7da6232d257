"""Do images, cameras and metadata go together? What is surely wrong stops; what may be meant is a warning.

Every check compares two things that were found independently of each other, as one file by itself is seldom absurd.
"""

from __future__ import annotations

import contextlib
import hashlib
import math
from collections import Counter
from collections.abc import Sequence
from datetime import UTC, datetime, timedelta
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from sattools.camera import RPC
from sattools.camera.adjust import Adjustment
from sattools.camera.ground import foreshortening, ground_sample_distance, view_direction
from sattools.camera.sun import sun_position
from sattools.errors import InputError
from sattools.prep.cameras import SAME_PX
from sattools.prep.images import SourceImage
from sattools.prep.numbers import LARGEST_NUMBER, check_brightness, too_large
from sattools.radiometry.bands import named_bands
from sattools.scene.grid import Grid, finer_pixel
from sattools.scene.location import RemotePath
from sattools.scene.members import FINEST, HEIGHT_LIMITS_M, LEAST_CELLS, MAX_CELLS
from sattools.scene.sidecars import sidecars

Array = NDArray[np.float64]

_SUN_TOLERANCE_DEG = 5.0  # between metadata and time with place: more than refraction, rounding and a minute's drift
_SUN_FAR_DEG = 12.0  # an hour of local instead of universal time
_CAMERA_TOLERANCE_PX = 40.0  # vendors' cameras are good to some metres; the worst of the contest is off by 36 px
_CAMERA_SHARE = 0.2  # of an image's shorter side
_VIEW_TOLERANCE_DEG = 2.0
_PIXEL_M = (0.005, 2000.0)
_FOOT_M = 0.3048
_LEAST_STRETCH = 0.02  # of pixels on the ground beyond what heights in metres explain: line rates make up to 0.01
_LEAST_UP = 0.17  # sine of ten degrees: no satellite looks flatter
_FIRST_YEAR = 1960  # before the first photographs from orbit
_FEW_LEVELS = 8
_LEFT_OUT = 0.05  # of the tie points below or above the heights given: more than false ones
_COARSER = 3.0  # times as wide as fine pixels, by more than how obliquely they look; twice as wide is no harm
_ENOUGH_FINE = 4  # images, which see more without coarse ones; three leave more in doubt than those blur


def check_sources(sources: Sequence[SourceImage]) -> None:
    """Pixels and dates: what each image says, and whether all say the same. Raises InputError; adds warnings."""
    for source in sources:
        _check_bands(source)
        _check_time(source)
        _check_camera(source)
    counts = Counter(s.bands for s in sources)
    if len(counts) > 1:
        usual = counts.most_common(1)[0][0]
        odd = next(s for s in sources if s.bands != usual)
        hint = " (multispectral images of panchromatic ones go into a folder of their own, `--colours FOLDER`)"
        raise InputError(
            f"{odd.path}: found {odd.bands} bands, expected {usual} as most of the other images have"
            f"{hint if 1 in counts else ''}"
        )
    _check_names(sources)
    types = Counter(s.dtype for s in sources)
    if len(types) > 1:
        usual_type = types.most_common(1)[0][0]
        for source in sources:
            if source.dtype != usual_type:
                source.warn(f"its pixels are {source.dtype}, those of most others {usual_type}: one quantity in all?")


def _check_names(sources: Sequence[SourceImage]) -> None:
    """Bands of one order, where files name them: red of one image is not fitted to blue of another.

    Sensors whose infrared differs by a few tens of nanometres may be mixed, as those without names are.
    """
    orders: dict[tuple[str, ...], SourceImage] = {}
    for source in sources:
        if named := named_bands(source.metadata.platform, source.descriptions):
            names = (str(band["common_name"]) for band in named["eo:bands"])
            orders.setdefault(tuple("nir" if name == "nir08" else name for name in names), source)
    if len(orders) > 1:
        (usual, first), (order, odd) = list(orders.items())[:2]
        raise InputError(
            f"{odd.path}: found the bands {', '.join(order)}, expected {', '.join(usual)} as {first.path} has "
            "(gdal_translate -b writes them in another order)"
        )


def _check_bands(source: SourceImage) -> None:
    for number, meaning in enumerate(source.meanings, 1):
        if meaning == "palette":
            raise InputError(
                f"{source.path}: found a palette (numbers of colours) in band {number}, expected brightness "
                "(gdal_translate -expand rgb writes it)"
            )
        if meaning == "alpha":
            if source.mask_like:
                keep = " ".join(f"-b {b}" for b in range(1, source.bands + 1) if b != number)
                raise InputError(
                    f"{source.path}: found a transparency mask in band {number}, expected spectral bands only "
                    f"(gdal_translate {keep} -mask {number} makes a mask of it, which is read)"
                )
            source.warn(f"band {number} is marked as transparency and taken for a spectral band")


def _check_time(source: SourceImage) -> None:
    time = source.metadata.time
    if time is None:
        return
    if time.year < _FIRST_YEAR:
        raise InputError(f"{source.path}: found the date {time:%Y-%m-%d}, expected one since {_FIRST_YEAR}")
    if time > datetime.now(UTC) + timedelta(days=2):
        source.warn(f"taken on {time:%Y-%m-%d}, which is still to come: is the date right?")


def _check_camera(source: SourceImage) -> None:
    """The camera against another one that the image brings along."""
    rpc, (height, width) = source.rpc, source.size
    lon, lat = rpc.localization((width - 1) / 2, (height - 1) / 2, rpc.alt_offset)
    if not (math.isfinite(lon) and math.isfinite(lat)):
        return  # told where footprints are compared
    with np.errstate(all="ignore"):
        size = ground_sample_distance(rpc, lon, lat, rpc.alt_offset)
        up = float(view_direction(rpc, lon, lat, rpc.alt_offset)[2])
    if not (_PIXEL_M[0] <= size <= _PIXEL_M[1] and up >= _LEAST_UP):
        seen = f"pixels of {size:.3g} m seen {math.degrees(math.asin(min(1.0, up))):.0f} degrees above the horizon"
        raise InputError(
            f"{source.path}: found a camera with {seen if math.isfinite(size + up) else 'no image of the ground'}, "
            f"expected the RPC of a satellite image (from {source.metadata.rpc_source})"
        )
    other = source.tags_rpc
    if other is None or other is rpc:
        return
    col, row = other.projection(lon, lat, rpc.alt_offset)
    away = math.hypot(col - (width - 1) / 2, row - (height - 1) / 2)
    with np.errstate(all="ignore"):
        a, b = view_direction(rpc, lon, lat, rpc.alt_offset), view_direction(other, lon, lat, rpc.alt_offset)
    turned = math.degrees(math.acos(max(-1.0, min(1.0, float(a @ b)))))
    if not away <= _limit_px(source.size) or turned > _VIEW_TOLERANCE_DEG:
        what = f"{away:.0f} px and {turned:.1f} degrees" if math.isfinite(away) else "altogether"
        source.warn(f"its own RPC tags differ from {source.metadata.rpc_source} by {what}: metadata of another image?")
    elif away > SAME_PX:
        whose = source.metadata.rpc_source
        beside = "in a file beside it" if whose == str(source.path) else f"of {whose}"
        source.warn(f"its own RPC tags differ by {away:.1f} px from the camera {beside}, which is taken")


def _limit_px(size: tuple[int, int]) -> float:
    return min(_CAMERA_TOLERANCE_PX, max(10.0, _CAMERA_SHARE * min(size)))


def mirrored(rpc: RPC, lon: float, lat: float) -> bool:
    """The camera sees the ground from below, or its longitude and latitude are exchanged.

    Args:
        rpc: the camera.
        lon: longitude [degrees].
        lat: latitude [degrees].
    """
    jac = rpc.jacobian(lon, lat, rpc.alt_offset)[:, :2]
    return bool(np.linalg.det(jac) > 0)


def check_metadata(sources: Sequence[SourceImage], folder: Path | None) -> list[str]:
    """Notes on a folder of metadata that has none of some images: their cameras and suns are from elsewhere then."""
    if folder is None:
        return []
    without = [s for s in sources if not sidecars(s.path, [folder])]
    if len(without) == len(sources):
        like = f"expected names such as {sources[0].path.stem}.json, .xml, .IMD or _RPC.TXT"
        return [f"{folder}: found no metadata file named like one of the images, {like}"]
    local = [s for s in without if not isinstance(s.path, RemotePath)]
    nowhere = [s for s in local if not sidecars(s.path, [s.path.parent])]
    if not nowhere:
        return []
    names = ", ".join(s.id for s in nowhere[:3]) + (", ..." if len(nowhere) > 3 else "")
    return [f"{folder}: found no metadata file of {len(nowhere)} of {len(sources)} images ({names})"]


def check_places_and_suns(sources: Sequence[SourceImage]) -> list[str]:
    """Suns of the metadata against those of time and place; notes on all images together.

    Raises: InputError where the sun is below the horizon, or cameras and suns both say that the place is wrong.
    """
    off: list[tuple[SourceImage, float]] = []
    compared, flipped = 0, 0
    for source in sources:
        height, width = source.size
        lon, lat = source.rpc.localization((width - 1) / 2, (height - 1) / 2, source.rpc.alt_offset)
        if not (math.isfinite(lon) and -90 <= lat <= 90):
            continue
        flipped += mirrored(source.rpc, lon, lat)
        sun, time = source.metadata.sun, source.metadata.time
        if sun is not None and sun[1] <= 0:
            raise InputError(
                f"{source.path}: found a sun {sun[1]:g} degrees above the horizon in its metadata, expected an image "
                "taken by day"
            )
        if sun is None or time is None:
            continue
        compared += 1
        apart = _apart(sun, sun_position(time, lon, lat, source.rpc.alt_offset))
        if apart > _SUN_TOLERANCE_DEG:
            off.append((source, apart))
    notes = []
    mirror = 2 * flipped > len(sources)
    if off and mirror and 2 * len(off) > compared:
        raise InputError(
            f"{off[0][0].path}: found mirrored cameras and suns {off[0][1]:.0f} degrees from where time and place put "
            "them, expected longitudes and latitudes that are not exchanged"
        )
    if mirror:
        notes.append("the cameras see the ground mirrored: are longitude and latitude exchanged?")
    if compared > 1 and len(off) == compared and min(apart for _, apart in off) > _SUN_FAR_DEG:
        least = min(apart for _, apart in off)
        notes.append(
            f"the suns of all images stand {least:.0f} degrees or more from where time and place put them: is the "
            "place right (sign of the latitude), and are the times UTC?"
        )
        return notes
    for source, apart in off:
        source.warn(f"its sun stands {apart:.0f} degrees from where time and place put it: is the metadata its own?")
    return notes


def check_height_unit(sources: Sequence[SourceImage]) -> list[str]:
    """A note where all cameras count heights in feet: their lines of sight look steeper than their pixels do."""
    found = []
    for source in sources:
        height, width = source.size
        lon, lat = source.rpc.localization((width - 1) / 2, (height - 1) / 2, source.rpc.alt_offset)
        if math.isfinite(lon) and math.isfinite(lat):
            with np.errstate(all="ignore"), contextlib.suppress(np.linalg.LinAlgError):
                found.append(foreshortening(source.rpc, lon, lat, source.rpc.alt_offset))
    tangents, stretches = np.array(found or [(0.0, 1.0)]).T

    def off(unit: float) -> float:
        return float(np.sqrt(np.mean((stretches - np.hypot(1.0, tangents / unit)) ** 2)))

    if off(1.0) > _LEAST_STRETCH and off(_FOOT_M) < 0.25 * off(1.0):
        by_heights, by_pixels = (np.degrees(np.arctan(tangents.max() / unit)) for unit in (1.0, _FOOT_M))
        return [
            f"the cameras look down {by_heights:.0f} degrees off the vertical by their heights, {by_pixels:.0f} by "
            "their pixels' shapes: are the heights of the RPCs feet?"
        ]
    return []


def _apart(a: tuple[float, float], b: tuple[float, float]) -> float:
    """Angle in degrees between two directions (azimuth, elevation)."""
    (az_a, el_a), (az_b, el_b) = (tuple(map(math.radians, angles)) for angles in (a, b))
    cosine = math.sin(el_a) * math.sin(el_b) + math.cos(el_a) * math.cos(el_b) * math.cos(az_a - az_b)
    return math.degrees(math.acos(max(-1.0, min(1.0, cosine))))


def check_pixels(sources: Sequence[SourceImage], grays: Sequence[NDArray[np.float32]]) -> None:
    """Raise InputError where two images are one and the same, or their DN are absurd; warns of few grey levels."""
    seen: dict[str, SourceImage] = {}
    for source, gray in zip(sources, grays, strict=True):
        digest = hashlib.sha256(repr(gray.shape).encode() + gray.tobytes()).hexdigest()
        other = seen.setdefault(digest, source)
        if other is not source:
            raise InputError(f"{source.path}: found the same pixels as in {other.path}, expected another image")
        known = gray[np.isfinite(gray)]
        if np.abs(known).max() > LARGEST_NUMBER:
            raise too_large(source.path, float(np.abs(known).max()))
        check_brightness(source.path, known)
        some = known[:: max(1, known.size // 100_000)]
        levels = np.unique(some).size
        if levels < _FEW_LEVELS:
            source.warn(f"it has {levels} grey levels only")


def check_corrections(result: Adjustment, sources: Sequence[SourceImage]) -> list[str]:
    """Warn of cameras that were off by more than vendors' are; notes on all of them."""
    notes = []
    lengths = [math.hypot(*view.asked_px) for view in result.views]
    if len(lengths) == 2:  # each of them has got half of what they are apart
        lengths = [sum(lengths), 0.0]
    for view, source, length in zip(result.views, sources, lengths, strict=True):
        if not view.weak and length > _limit_px((source.window[3], source.window[2])):
            whose = "; whose camera it is cannot be told from so few" if len(sources) < 4 else ""
            notes.append(
                f"{source.id}: its camera and those of the others are {length:.0f} px apart{whose}: the RPC of this "
                "image and of this part of it?"
            )
    return notes


def check_cells(grid: Grid, pixel_m: float) -> None:
    """Raise InputError for cells that are no choice between speed and detail any more."""
    if min(grid.shape) < LEAST_CELLS:
        raise InputError(
            f"cell size: found {grid.cell_size:g} m, {grid.width} x {grid.height} cells for the whole area, expected "
            f"at least {LEAST_CELLS} along each side"
        )
    if grid.width * grid.height > MAX_CELLS:
        raise InputError(
            f"area: found {grid.width} x {grid.height} cells of {grid.cell_size:g} m, expected at most {MAX_CELLS:.0e}"
        )
    if grid.cell_size < FINEST * pixel_m:
        raise InputError(
            f"cell size: found {grid.cell_size:g} m for pixels of {pixel_m:.2g} m, expected at least "
            f"{FINEST * pixel_m:.2g} m"
        )


def much_coarser(sizes: Sequence[float], ups: Sequence[float]) -> NDArray[np.bool_]:
    """Which images ``[V]`` are so coarse that they blur what the others show; none where the others are too few.

    Args:
        sizes: edges of the images' pixels on the ground [m].
        ups: upward parts of the unit vectors towards their cameras; the pixels of one sensor are wider, and longer
            still, the more obliquely it looks.
    """
    from_above = np.array(sizes) * np.abs(ups) ** 1.5
    coarse = from_above > _COARSER * finer_pixel(from_above.tolist())
    return coarse if (~coarse).sum() >= _ENOUGH_FINE else np.zeros(len(sizes), bool)


def check_pixel_sizes(sizes: Sequence[float], ups: Sequence[float]) -> list[str]:
    """A note where some images are `much_coarser` than the others.

    Args:
        sizes: edges of the images' pixels on the ground [m].
        ups: upward parts of the unit vectors towards their cameras.
    """
    coarse, known = much_coarser(sizes, ups), np.array(sizes)
    if not coarse.any():
        return []
    return [
        f"{coarse.sum()} of {len(sizes)} images have pixels of {np.median(known[coarse]):.2g} m, the others of "
        f"{np.median(known[~coarse]):.2g} m: the coarse ones count little in the matching, and may be left out"
    ]


def check_heights(low: float, high: float, tie_heights: Array, given: bool) -> list[str]:
    """Raise InputError for heights that are not of the Earth or not of this place; notes where they may be meant.

    Args:
        low: lowest [m].
        high: highest [m].
        tie_heights: ``[n]`` heights of the tie points [m].
        given: whether the user gave them.
    """
    if not low < high:
        raise InputError(f"heights: found lowest {low:g} m and highest {high:g} m, expected lowest < highest")
    if low < HEIGHT_LIMITS_M[0] or high > HEIGHT_LIMITS_M[1]:
        raise InputError(
            f"heights: found {low:g} to {high:g} m, expected some of the Earth, {HEIGHT_LIMITS_M[0]:g} to "
            f"{HEIGHT_LIMITS_M[1]:g} m"
        )
    if not given or not tie_heights.size:
        return []
    within = float(((tie_heights >= low) & (tie_heights <= high)).mean())
    bulk = np.percentile(tie_heights, [5, 95])
    where = f"{100 * within:.0f} % of the tie points, which lie from {bulk[0]:.0f} to {bulk[1]:.0f} m"
    if within < 0.02:
        raise InputError(
            f"heights: found {low:g} to {high:g} m with {where}, expected metres above the WGS84 ellipsoid"
        )
    if within < 0.5:
        return [f"heights {low:g} to {high:g} m hold {where}: are they metres above the WGS84 ellipsoid?"]
    ends = np.percentile(tie_heights, [1, 99])
    return [
        f"heights {low:g} to {high:g} m leave out {100 * share:.0f} % of the tie points, which lie {side} them "
        f"(all from {ends[0]:.0f} to {ends[1]:.0f} m): the surface there will be wrong"
        for side, share in (("below", float((tie_heights < low).mean())), ("above", float((tie_heights > high).mean())))
        if share > _LEFT_OUT
    ]


__all__ = [
    "check_cells",
    "check_corrections",
    "check_height_unit",
    "check_heights",
    "check_metadata",
    "check_pixel_sizes",
    "check_pixels",
    "check_places_and_suns",
    "check_sources",
    "mirrored",
]
