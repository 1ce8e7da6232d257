"""What a surface hides from the views and from their suns, and how dark the views are where it casts a shadow."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from scipy.ndimage import grey_erosion, uniform_filter

from sattools.prior.frame import Frame

UNKNOWN = -1e9  # first hit of a ray, height of a shade, radiance of shadow when nothing is known: seen, lit, not dark
SURELY_SHADED_M = 2.0  # depth below the edge of a shadow at which a point surely lies in it
DARK_SHARE = 30  # per cent of the pixels in shadow that are darker than its level: some see things that stick out
FEWEST = 60  # cells that make a statistic
NOISE_SHARE = 20  # per cent of the windows in shadow that show noise and no texture
NOISE_FACTOR = 1.25  # contrast, in units of that noise, below which no structure is asked for


@dataclass(frozen=True)
class Hidden:
    """What a surface hides.

    Attributes:
        hits: ``[V, Hf, Wf]`` float32 height at which the ray through a frame position first meets it [m].
        shades: ``[V, H, W]`` float32 height below which a point over a cell lies in shadow [m].
        dark: ``[V]`` float32 radiance of things in shadow.
    """

    hits: np.ndarray
    shades: np.ndarray
    dark: np.ndarray

    def doubled(self) -> Hidden:
        """The same on cells of half the size."""
        hits, shades = (a.repeat(2, axis=1).repeat(2, axis=2) for a in (self.hits, self.shades))
        return Hidden(hits, shades, self.dark)


def nothing_hidden(frame: Frame) -> Hidden:
    """Everything is seen and lit."""
    hits = np.full(frame.images.shape, UNKNOWN, np.float32)
    shades = np.full((len(hits), *frame.shape), UNKNOWN, np.float32)
    return Hidden(hits, shades, np.full(len(hits), UNKNOWN, np.float32))


def disk(radius: float) -> np.ndarray:
    """Boolean footprint of all cells whose centre lies within the radius [cells]."""
    n = math.floor(radius)
    y, x = np.mgrid[-n : n + 1, -n : n + 1]
    return x * x + y * y <= radius * radius


def thinned(surface: np.ndarray, radius: float) -> np.ndarray:
    """The surface without its rims, as matching makes them too wide; radius in cells."""
    return grey_erosion(surface, footprint=disk(radius), mode="nearest")


def hide(frame: Frame, thin: np.ndarray, z_range: tuple[float, float], tolerance: float, hidden: Hidden) -> None:
    """Fill in what a (thinned) surface ``[H, W]`` hides and shades.

    A point just below a lit surface counts as lit: what the images show there is the surface.
    """
    from sattools.prior.kernels import first_hits, shade_heights

    wide = np.pad(thin, frame.margin, mode="edge")
    first_hits(wide, frame.slopes, frame.z_ref, z_range[1] + 1.0, z_range[0] - 1.0, hidden.hits)
    for sun, shade in zip(frame.suns, hidden.shades, strict=True):
        if sun is not None:
            shade_heights(thin, np.array(sun), frame.cell, float(thin.max()), shade)
            lit = shade < thin
            shade[lit] = np.minimum(shade[lit], thin[lit] - np.float32(tolerance))


def at_surface(frame: Frame, hits: np.ndarray, surface: np.ndarray, tolerance: float) -> tuple[np.ndarray, np.ndarray]:
    """What every view shows at the surface ``[H, W]``, and whether it sees it: ``[V, H, W]`` float32 and bool."""
    rows, cols = np.indices(frame.shape)
    value = np.empty((len(frame.images), *frame.shape), np.float32)
    seen = np.empty(value.shape, bool)
    last = np.array(frame.images.shape[1:]) - 1
    dz = surface - frame.z_ref
    for v, slope in enumerate(frame.slopes):
        r = np.clip(np.rint(rows + frame.margin + slope[0] * dz).astype(int), 0, last[0])
        c = np.clip(np.rint(cols + frame.margin + slope[1] * dz).astype(int), 0, last[1])
        value[v] = frame.images[v][r, c]
        seen[v] = (frame.masks[v][r, c] > 0) & (hits[v][r, c] <= surface + tolerance)
    return value, seen


def measure_dark(frame: Frame, surface: np.ndarray, tolerance: float, hidden: Hidden) -> None:
    """Measure the radiance of shadows in every view where the surface casts them; the median of the others where too
    few cells tell. Haze and skylight differ from date to date, so shadows do not match where lit ground does."""
    value, seen = at_surface(frame, hidden.hits, surface, tolerance)
    deep = seen & (surface < hidden.shades - SURELY_SHADED_M)
    found = [np.percentile(a[d], DARK_SHARE) if d.sum() > FEWEST else np.nan for a, d in zip(value, deep, strict=True)]
    usual = np.nanmedian(found) if np.isfinite(found).any() else UNKNOWN
    hidden.dark[:] = np.where(np.isnan(found), usual, found)


def dark_noise(frame: Frame, dark: np.ndarray, reach: float, least: float) -> float:
    """Contrast below which no structure is asked for in shadow: noise is all that most windows there show.

    Args:
        frame: the views.
        dark: ``[V]`` radiance of shadows.
        reach: distance of radiance from it that still counts as dark.
        least: smallest value returned.
    """
    found = []
    for image, mask, level in zip(frame.images, frame.masks, dark, strict=True):
        mean = uniform_filter(image, 3)
        spread = uniform_filter(image * image, 3) - mean * mean
        near = (mask > 0) & (np.abs(mean - level) < reach)
        if near.sum() > FEWEST:
            found.append(math.sqrt(max(float(np.percentile(spread[near], NOISE_SHARE)) * 9 / 8, 0.0)))
    return max(least, NOISE_FACTOR * float(np.median(found))) if found else least


__all__ = [
    "UNKNOWN",
    "Hidden",
    "at_surface",
    "dark_noise",
    "disk",
    "hide",
    "measure_dark",
    "nothing_hidden",
    "thinned",
]
