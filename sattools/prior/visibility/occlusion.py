"""Visibility of a surface from the views and from their suns, and how dark the views are where it casts a shadow."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from scipy.ndimage import minimum_filter1d

from sattools.prior.frame import Frame
from sattools.processors import side_by_side
from sattools.scene.regrid import split_cells

UNKNOWN = -1e9  # first hit of a ray, height of a shade, radiance of shadow when nothing is known: seen, lit, not dark
SURELY_SHADED_M = 2.0  # depth below the edge of a shadow at which a point surely lies in it
ASKED_BELOW_M = 20.0  # below the height range, as far as any point is asked whether it lies in shadow
DARK_SHARE = 30  # per cent of the pixels in shadow that are darker than its level: some see things that stick out
FEWEST = 60  # cells that make a statistic
NOISE_SHARE = 20  # per cent of the windows in shadow that show noise and no texture
NOISE_FACTOR = 1.25  # contrast, in units of that noise, below which no structure is asked for


@dataclass(frozen=True)
class Visibility:
    """Occlusion and shadow that a surface causes.

    Attributes:
        first_hit_height: ``[V, Hf, Wf]`` float32 height at which the ray through a frame position first meets it [m].
        shadow_height: ``[V, H, W]`` float32 height below which a point over a cell lies in shadow [m].
        dark: ``[V]`` float32 radiance of things in shadow.
    """

    first_hit_height: np.ndarray
    shadow_height: np.ndarray
    dark: np.ndarray

    def doubled(self) -> Visibility:
        """The same on cells of half the size."""
        first_hit_height, shadow_height = (
            split_cells(heights) for heights in (self.first_hit_height, self.shadow_height)
        )
        return Visibility(first_hit_height, shadow_height, self.dark)


def all_visible(frame: Frame) -> Visibility:
    """Everything is seen and lit."""
    first_hit_height = np.full(frame.images.shape, UNKNOWN, np.float32)
    shadow_height = np.full((len(first_hit_height), *frame.shape), UNKNOWN, np.float32)
    return Visibility(first_hit_height, shadow_height, np.full(len(first_hit_height), UNKNOWN, np.float32))


def disk(radius: float) -> np.ndarray:
    """Boolean footprint of all cells whose centre lies within the radius [cells]."""
    n = math.floor(radius)
    y, x = np.mgrid[-n : n + 1, -n : n + 1]
    return x * x + y * y <= radius * radius


def erode(surface: np.ndarray, radius: float) -> np.ndarray:
    """The surface eroded by a disk, as matching makes its rims too wide; radius in cells.

    A disk is a stack of lines. (SciPy's erosion by a footprint keeps a list of the disk's cells for every place near a
    border that it may have: 2.6 GB for 50 m.)
    """
    footprint, rows = disk(radius), surface.shape[0]
    reach = len(footprint) // 2
    wide = np.pad(surface, ((reach, reach), (0, 0)), mode="edge")
    eroded = np.full_like(surface, np.inf)
    for off in range(reach + 1):
        both = np.minimum(wide[reach - off :][:rows], wide[reach + off :][:rows])
        length = int(footprint[reach + off].sum())
        np.minimum(eroded, minimum_filter1d(both, length, axis=1, mode="nearest"), out=eroded)
    return eroded


def compute_visibility(
    frame: Frame, eroded: np.ndarray, z_range: tuple[float, float], tolerance: float, dark: np.ndarray
) -> Visibility:
    """Occlusion and shadow that an eroded surface causes.

    A point just below a lit surface counts as lit: what the images show there is the surface.

    Args:
        frame: the views.
        eroded: ``[H, W]`` float32 heights [m].
        z_range: lowest and highest height [m].
        tolerance: depth below the visible surface that still counts as seen [m].
        dark: ``[V]`` float32 radiance of shadows.
    """
    from sattools.prior.visibility.kernels import first_hit_heights, shadow_heights

    new = all_visible(frame)
    wide = np.pad(eroded, frame.margin, mode="edge")
    first_hit_heights(wide, frame.parallax, frame.z_ref, z_range[1] + 1.0, z_range[0] - 1.0, new.first_hit_height)
    top, bottom = float(eroded.max()), z_range[0] - ASKED_BELOW_M
    for sun, shadow in zip(frame.suns, new.shadow_height, strict=True):
        if sun is not None:
            shadow_heights(eroded, np.array(sun), frame.cell, top, bottom, shadow)
            lit = shadow < eroded
            shadow[lit] = np.minimum(shadow[lit], eroded[lit] - np.float32(tolerance))
    return replace(new, dark=dark)


def at_surface(
    frame: Frame, first_hit_height: np.ndarray, surface: np.ndarray, tolerance: float
) -> tuple[np.ndarray, np.ndarray]:
    """What every view shows at the surface ``[H, W]``, and whether it sees it: ``[V, H, W]`` float32 and bool.

    Args:
        frame: the views.
        first_hit_height: ``[V, Hf, Wf]`` heights at which rays first meet the surface [m].
        surface: ``[H, W]`` heights [m].
        tolerance: depth below the visible surface that still counts as seen [m].
    """
    from sattools.prior.visibility.kernels import look_at

    value = np.empty((len(frame.images), *frame.shape), np.float32)
    seen = np.empty(value.shape, bool)
    look_at(
        frame.images, frame.masks, frame.parallax, frame.z_ref, frame.margin, first_hit_height, surface,
        tolerance, value, seen,
    )  # fmt: skip
    return value, seen


def within_images(frame: Frame, surface: np.ndarray, tolerance: float) -> np.ndarray:
    """Whether every view would see the surface if nothing hid it, ``[V, H, W]`` bool.

    Args:
        frame: the views.
        surface: ``[H, W]`` heights [m].
        tolerance: see `at_surface`.
    """
    everything_seen = np.broadcast_to(np.float32(UNKNOWN), frame.images.shape)
    return at_surface(frame, everything_seen, surface, tolerance)[1]


def mostly_shaded(frame: Frame, visibility: Visibility, surface: np.ndarray, tolerance: float) -> np.ndarray:
    """Whether most of the views that see the surface see it in shadow, ``[H, W]`` bool.

    Args:
        frame: the views.
        visibility: what is occluded and shaded.
        surface: ``[H, W]`` float32 heights [m].
        tolerance: depth below the visible surface that still counts as seen [m].
    """
    _, seen = at_surface(frame, visibility.first_hit_height, surface, tolerance)
    shaded = seen & (surface < visibility.shadow_height)
    return np.asarray(2 * shaded.sum(axis=0) > seen.sum(axis=0))


def measure_dark(frame: Frame, surface: np.ndarray, tolerance: float, visibility: Visibility) -> np.ndarray:
    """Radiance of shadows in every view where the surface casts them.

    Where too few cells tell, it is the median of the other views.

    Haze and skylight differ from date to date, so shadows do not match where lit ground does.

    Args:
        frame: the views.
        surface: ``[H, W]`` float32 heights [m].
        tolerance: depth below the visible surface that still counts as seen [m].
        visibility: of the surface.

    Returns:
        ``[V]`` float32 radiance.
    """
    value, seen = at_surface(frame, visibility.first_hit_height, surface, tolerance)
    deep = seen & (surface < visibility.shadow_height - SURELY_SHADED_M)
    levels = [np.percentile(a[d], DARK_SHARE) if d.sum() > FEWEST else np.nan for a, d in zip(value, deep, strict=True)]
    typical = np.nanmedian(levels) if np.isfinite(levels).any() else UNKNOWN
    return np.where(np.isnan(levels), typical, levels).astype(np.float32)


def dark_noise(frame: Frame, dark: np.ndarray, reach: float, least: float) -> float:
    """Contrast below which no structure is asked for in shadow: noise is all that most windows there show.

    Args:
        frame: the views.
        dark: ``[V]`` radiance of shadows.
        reach: distance of radiance from it that still counts as dark.
        least: smallest value returned.
    """
    import cv2

    def noise(view: int) -> float:
        image = frame.images[view]
        mean = cv2.blur(image, (3, 3), borderType=cv2.BORDER_REFLECT)
        near = (frame.masks[view] > 0) & (np.abs(mean - dark[view]) < reach)
        if near.sum() <= FEWEST:
            return math.nan
        spread = cv2.blur(image * image, (3, 3), borderType=cv2.BORDER_REFLECT) - mean * mean
        return math.sqrt(max(float(np.percentile(spread[near], NOISE_SHARE)) * 9 / 8, 0.0))

    noises = [found for found in side_by_side(noise, range(len(frame.images)), 4) if not math.isnan(found)]
    return max(least, NOISE_FACTOR * float(np.median(noises))) if noises else least


__all__ = [
    "UNKNOWN",
    "Visibility",
    "all_visible",
    "at_surface",
    "compute_visibility",
    "dark_noise",
    "disk",
    "erode",
    "measure_dark",
    "mostly_shaded",
    "within_images",
]
