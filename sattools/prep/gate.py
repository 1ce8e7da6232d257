"""Do images, cameras and metadata go together? What is surely wrong stops; what may be meant is a warning.

Every check compares two things that were found independently of each other, as one file by itself is seldom absurd.
"""

from __future__ import annotations

import hashlib
from collections import Counter
from collections.abc import Sequence
from datetime import UTC, datetime, timedelta
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from sattools.errors import InputError, counted
from sattools.prep.camera_gate import check_camera
from sattools.prep.images import SourceImage
from sattools.prep.numbers import LARGEST_NUMBER, check_brightness, too_large
from sattools.prep.times import FIRST_YEAR
from sattools.radiometry.bands import named_bands
from sattools.scene.grid import Grid, finer_pixel
from sattools.scene.location import RemotePath
from sattools.scene.members import FINEST, HEIGHT_LIMITS_M, LEAST_CELLS, MAX_CELLS
from sattools.scene.sidecars import sidecars

Array = NDArray[np.float64]

_FEW_LEVELS = 8
_LEFT_OUT = 0.05  # of the tie points below or above the heights given: more than false ones
_COARSER = 3.0  # times as wide as fine pixels, by more than how obliquely they look; twice as wide is no harm
_ENOUGH_FINE = 4  # images, which see more without coarse ones; three leave more in doubt than those blur


def check_sources(sources: Sequence[SourceImage]) -> None:
    """Pixels and dates: what each image says, and whether all say the same. Raises InputError; adds warnings."""
    for source in sources:
        _check_bands(source)
        _check_time(source)
        check_camera(source)
    counts = Counter(s.bands for s in sources)
    if len(counts) > 1:
        usual = counts.most_common(1)[0][0]
        odd = next(s for s in sources if s.bands != usual)
        hint = " (multispectral images of panchromatic ones go into a folder of their own, `--colours FOLDER`)"
        raise InputError(
            f"{odd.path}: found {counted(odd.bands, 'bands')}, expected {usual} as most of the other images have"
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
    if time.year < FIRST_YEAR:
        raise InputError(f"{source.path}: found the date {time:%Y-%m-%d}, expected one since {FIRST_YEAR}")
    if time > datetime.now(UTC) + timedelta(days=2):
        source.warn(f"taken on {time:%Y-%m-%d}, which is still to come: is the date right?")


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
    "check_heights",
    "check_metadata",
    "check_pixel_sizes",
    "check_pixels",
    "check_sources",
    "much_coarser",
]
