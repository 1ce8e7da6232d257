"""Albedo and light of a fitted surface, in closed form on its own cells.

The descent that finds heights moves albedo, colours and light by small steps on cells that are wider than the images'
pixels. Once the heights stand, what is left is linear in the albedo, and in the colours: radiance = gain (v + (1 - v)
ambient) albedo + offset, see `SurfaceScene`. Both are solved for in turns, on the surface's own cells.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
import torch

from sattools.camera.cells import project_cells
from sattools.fit.model import FittedModel
from sattools.progress import Progress, subprogress
from sattools.render.visibility import Cast
from sattools.views import Source
from sattools.views.resample import read_at

Held = Literal["nothing", "scale", "all"]
ROUNDS = 12
SAMPLE = 4000  # cells that tell the images' colours; with 20,000 albedos are the same to 1 %
REWEIGHTINGS = 4
KNEE = 2.0  # robust standard deviations from which an image counts less: glare, seasons, what has moved
VISIBLE = 0.95  # share of a cell's line of sight that has to be free
WHITE = 0.98  # share of full scale from which a pixel may be clipped
CLIPPED_WEIGHT = 1e-3  # such a pixel counts where nothing else is seen
AMBIENT_SPREAD = 0.1  # standard deviation of an image's light in shade about the mean of all
LEAST_WIDTH = 0.5  # albedos are so far from the middle one, as share of it, or further
ALIKE = 25.0  # cells whose errors are one: of a wrong height, of a crown that lets light through
LEAST_CELLS = 50  # fewer say nothing about an image's colours
AMBIENT = (0.02, 1.0)
GAIN = (0.05, 20.0)
AT_ONCE = 65_536  # cells
ENOUGH = 50_000  # residuals that tell their spread


@dataclass(frozen=True)
class Seen:
    """What ``V`` images show at ``N`` cells.

    Attributes:
        radiance: ``[V, N, C]``.
        weight: ``[V, N]``; 0 = not seen.
        lit: ``[V, N]`` share of the sun's light that reaches a cell.
    """

    radiance: np.ndarray
    weight: np.ndarray
    lit: np.ndarray

    def at(self, cells: np.ndarray | slice) -> Seen:
        """The same at some of the cells."""
        return Seen(self.radiance[:, cells], self.weight[:, cells], self.lit[:, cells])


@dataclass(frozen=True)
class Usual:
    """What is usual in each band ``[C]``.

    Attributes:
        spread: how far radiances are from what albedo and light explain (robust standard deviation).
        albedo: the middle one.
        width: how far albedos are from it; 0 = unknown.
    """

    spread: np.ndarray
    albedo: np.ndarray
    width: np.ndarray


@dataclass(frozen=True)
class Colours:
    """Gain, offset and ambient ``[V, C]`` of images, see `SurfaceScene`."""

    gain: np.ndarray
    offset: np.ndarray
    ambient: np.ndarray

    def light(self, lit: np.ndarray, band: int) -> np.ndarray:
        """Radiance over albedo ``[V, N]`` of cells in a band, but for the offset; ``lit`` ``[V, N]``."""
        return np.asarray(self.gain[:, band, None] * (lit + (1 - lit) * self.ambient[:, band, None]))


def recoloured(
    model: FittedModel,
    sources: Sequence[Source],
    cast: Cast,
    full_scale: float | None,
    *,
    held: Held,
    seed: int,
    progress: Progress,
) -> FittedModel:
    """A surface without reflectance model, with the albedo and the colours that explain the images best.

    Args:
        model: the surface; what no image shows keeps its albedo.
        sources: the images, in the model's order.
        cast: visibility of heights on cells in a direction.
        full_scale: radiance at which pixels are clipped; None = they are not.
        held: what stays as it is: ``"nothing"`` but the first image's gain and offset, the ``"scale"`` (all gains and
            offsets, of calibrated images), or ``"all"`` colours.
        seed: of the cells that tell the colours.
        progress: told the share done and what is being done.
    """
    seen = _observe(model, sources, cast, full_scale, subprogress(progress, 0.0, 0.5))
    colours = Colours(*(getattr(model, name).double().numpy() for name in ("gain", "offset", "ambient")))
    start = model.albedo.reshape(-1, model.albedo.shape[-1]).numpy()
    some = sample(seen, start, seed)
    progress(0.5, "albedo: colours of the images")
    if held != "all":
        colours = solve_colours(some, colours, scale_held=held == "scale")
    known = usual(some[0], colours)
    albedo = start.copy()
    for first in range(0, len(albedo), AT_ONCE):
        progress(0.6 + 0.4 * first / len(albedo), "albedo: cells")
        part = slice(first, first + AT_ONCE)
        shown = np.max(seen.weight[:, part], axis=0) > 0
        albedo[part] = np.where(shown[:, None], solve_albedo(seen.at(part), colours, known), albedo[part])
    gain, offset, ambient = (
        torch.from_numpy(array).float() for array in (colours.gain, colours.offset, colours.ambient)
    )
    shaped = torch.from_numpy(albedo).reshape(model.albedo.shape)
    return replace(model, albedo=shaped, gain=gain, offset=offset, ambient=ambient)


def _observe(
    model: FittedModel, sources: Sequence[Source], cast: Cast, full_scale: float | None, progress: Progress
) -> Seen:
    """What the images show at a surface's cells, read at the pixels where these lie; hidden cells do not count.

    Args:
        model: the surface.
        sources: the images, in the model's order.
        cast: visibility of heights on cells in a direction.
        full_scale: radiance at which pixels are clipped; None = they are not.
        progress: told the share done and what is being done.
    """
    height, cell = model.height, model.grid.cell_size
    images, cells = len(sources), height.numel()
    radiance = np.empty((images, cells, model.albedo.shape[-1]), np.float32)
    weights, lit = (np.empty((images, cells), np.float32) for _ in range(2))
    for j, source in enumerate(sources):
        progress(j / images, f"albedo: image {j + 1}/{images}")
        east, north = (-float(shift) for shift in model.pose[j])
        col, row = project_cells(source.rpc, model.grid.moved(east, north), height.numpy())
        picture, mask = read_at(source.radiance, col, row)
        weight = mask * (cast(height, cell, model.slopes[j].unit()).numpy() > VISIBLE).astype(np.float32)
        if full_scale is not None:
            weight[picture.max(axis=-1) >= WHITE * full_scale] *= CLIPPED_WEIGHT
        radiance[j] = picture.reshape(cells, -1)
        weights[j], lit[j] = weight.ravel(), _lit(model, j, cast).ravel()
    return Seen(radiance, weights, lit)


def _lit(model: FittedModel, j: int, cast: Cast) -> np.ndarray:
    """Share of the sun's light ``[H, W]`` that reaches the cells when image j is taken, as the model has it."""
    sun = model.suns[j]
    if model.s_net is not None and sun is not None:
        share = model.s_net[j]
    elif model.shadow == "none" or sun is None:
        share = torch.ones_like(model.height)
    else:
        share = cast(model.height, model.grid.cell_size, sun)
    return np.asarray((share if model.tau is None else model.tau[j] * share).numpy(), np.float32)


def sample(seen: Seen, albedo: np.ndarray, seed: int) -> tuple[Seen, np.ndarray]:
    """Some of the cells that two images or more show (or one, where that is all), and their albedo ``[n, C]``."""
    count = (seen.weight > CLIPPED_WEIGHT).sum(axis=0)
    shown = np.flatnonzero(count >= min(2, int(count.max(initial=0))))
    if len(shown) > SAMPLE:
        shown = np.sort(np.random.default_rng(seed).choice(shown, SAMPLE, replace=False))
    return seen.at(shown), albedo[shown]


def solve_colours(some: tuple[Seen, np.ndarray], colours: Colours, *, scale_held: bool) -> Colours:
    """The colours of the images, in turns with the albedo of some cells, by least squares.

    The first image keeps its gain of 1 and its offset, or, if the scale is held, all do.

    Args:
        some: what the images show of some cells, and a first albedo.
        colours: to begin with.
        scale_held: solve for the light in shade alone.
    """
    seen, albedo = some
    found = Colours(colours.gain.copy(), colours.offset.copy(), colours.ambient.copy())
    told = [j for j in range(len(seen.weight)) if np.count_nonzero(seen.weight[j] > CLIPPED_WEIGHT) >= LEAST_CELLS]
    for band in range(albedo.shape[1]):
        rho = albedo[:, band].astype(np.float64)
        for _ in range(ROUNDS):
            mean = float(np.mean(found.ambient[:, band]))
            for j in told:
                _solve_image(seen, rho, j, band, found, mean, gauge=j == 0, scale_held=scale_held)
            rho = _solve_band(seen, found, band)
            if not scale_held:
                unit = found.gain[0, band]
                found.gain[:, band] = (found.gain[:, band] / unit).clip(*GAIN)
                rho = rho * unit
    return found


def _solve_image(
    seen: Seen, rho: np.ndarray, j: int, band: int, colours: Colours, mean: float, *, gauge: bool, scale_held: bool
) -> None:
    """Gain, offset and ambient of one image and band, given the albedo of its cells; changes `colours`."""
    lit = seen.lit[j].astype(np.float64)
    bright, shaded = rho * lit, rho * (1 - lit)
    value, weight = seen.radiance[j, :, band].astype(np.float64), seen.weight[j].astype(np.float64)
    gain, offset = colours.gain[j, band], colours.offset[j, band]
    in_sun = (seen.weight[j] > CLIPPED_WEIGHT) & (seen.lit[j] > 0)
    scale_held = scale_held or int(in_sun.sum()) < LEAST_CELLS  # shade alone does not tell the sun's light
    columns = [shaded] if scale_held else [shaded, bright] if gauge else [shaded, bright, np.ones_like(rho)]
    rest = value - (gain * bright if scale_held else 0.0) - (offset if scale_held or gauge else 0.0)
    design = np.stack(columns, axis=1)
    robust, pull = weight, 0.0
    for _ in range(2):
        weighted = design * robust[:, None]
        normal, right = weighted.T @ design, weighted.T @ rest
        normal[0, 0] += pull
        right[0] += pull * mean * gain
        solved = np.linalg.lstsq(normal, right, rcond=None)[0]
        error = rest - design @ solved
        spread = _spread(error, weight)
        robust, pull = weight * _trust(error, spread), ALIKE * (spread / (AMBIENT_SPREAD * gain)) ** 2
    if not scale_held:
        gain = colours.gain[j, band] = float(np.clip(solved[1], *GAIN))
    if not (scale_held or gauge):
        colours.offset[j, band] = solved[2]
    colours.ambient[j, band] = float(np.clip(solved[0] / gain, *AMBIENT))


def usual(seen: Seen, colours: Colours) -> Usual:
    """What is usual of some cells.

    Args:
        seen: what the images show of them.
        colours: of the images.
    """
    found = []
    for band in range(seen.radiance.shape[-1]):
        rho = _solve_band(seen, colours, band)
        spread = _spread(_residual(seen, colours, band, rho)[1], seen.weight)
        middle = float(np.median(rho)) if rho.size else 0.0
        width = max(LEAST_WIDTH * middle, float(np.abs(rho - middle).mean())) if rho.size else 0.0
        found.append((spread, middle, width))
    return Usual(*np.array(found).T)


def solve_albedo(seen: Seen, colours: Colours, known: Usual) -> np.ndarray:
    """Albedo ``[N, C]`` of cells, 0 or more: robust least squares over the images that show them.

    Deep shade shows hardly any light, so that noise and heights a little off would give any albedo: the middle one
    counts as an observation, too, within `Usual.width`. Clipped pixels count where there are no others.

    Args:
        seen: what the images show.
        colours: of the images.
        known: of all cells.
    """
    clipped = seen.weight.max(axis=0) <= CLIPPED_WEIGHT
    weight = np.where(clipped, seen.weight / CLIPPED_WEIGHT, seen.weight)
    bands = range(seen.radiance.shape[-1])
    found = [_solve_band(replace(seen, weight=weight), colours, band, known) for band in bands]
    return np.stack(found, axis=1).clip(0.0).astype(np.float32)


def _solve_band(seen: Seen, colours: Colours, band: int, known: Usual | None = None) -> np.ndarray:
    """Albedo ``[N]`` in one band; None = the spread is that of these cells, and no albedo is more usual than others."""
    light, value = _residual(seen, colours, band, 0.0)
    bright, square = light * value, light * light
    spread, middle, pull = None, 0.0, 1e-12
    if known is not None:
        spread, middle, width = (float(each[band]) for each in (known.spread, known.albedo, known.width))
        pull += (spread / width) ** 2 if width > 0 else 0.0
    robust = seen.weight
    for turn in range(REWEIGHTINGS):
        rho = ((robust * bright).sum(axis=0) + pull * middle) / ((robust * square).sum(axis=0) + pull)
        if turn < REWEIGHTINGS - 1:
            error = value - light * rho
            robust = seen.weight * _trust(error, _spread(error, seen.weight) if spread is None else spread)
    return np.asarray(rho)


def _residual(seen: Seen, colours: Colours, band: int, rho: np.ndarray | float) -> tuple[np.ndarray, np.ndarray]:
    """Light and radiance less offset and what the albedo explains of it, ``[V, N]`` each."""
    light = colours.light(seen.lit, band).astype(np.float32)
    offset = colours.offset[:, band, None].astype(np.float32)
    return light, seen.radiance[..., band] - offset - light * rho


def _spread(residual: np.ndarray, weight: np.ndarray) -> float:
    """Robust standard deviation of residuals where something was seen."""
    every = max(1, residual.size // ENOUGH)
    counted = np.abs(residual.ravel()[::every][weight.ravel()[::every] > 0])
    return 1.4826 * float(np.median(counted)) if counted.size else 1.0


def _trust(residual: np.ndarray, spread: float) -> np.ndarray:
    """Weights in (0, 1] that fall with the residual over the spread (Cauchy's)."""
    return np.asarray(1 / (1 + (residual / max(KNEE * spread, 1e-9)) ** 2))


__all__ = [
    "Colours",
    "Held",
    "Seen",
    "Usual",
    "recoloured",
    "sample",
    "solve_albedo",
    "solve_colours",
    "usual",
]
