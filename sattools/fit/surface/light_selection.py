"""Choosing how light is modelled: only what a scene needs.

The start surface is held fixed, and albedo, colours and light are fitted to the images as they show its cells, which
takes seconds. A richer model of the shadows is kept if it explains views that were held out better by more than one
standard error; transients are modelled where images hold things that the other dates do not show.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import avg_pool2d, max_pool2d

from sattools.fit.adam import Adam
from sattools.fit.losses import tone
from sattools.fit.options import FitOptions
from sattools.fit.surface.light import IlluminationModel
from sattools.fit.surface.scene import SurfaceScene
from sattools.render.visibility import Cast, sun_visibility
from sattools.views import View, shown_on

Shadow = Literal["none", "geometric", "learned"]
LADDER: tuple[Shadow, ...] = ("none", "geometric", "learned")
LEAST_VIEWS = 6  # fewer leave too little to learn from when some are held out
BLOCK_M = 16.0  # errors within a block count as one observation
STEPS, RATE = 150, 0.03
CELLS = 6000  # drawn for the comparison
PLAIN_M = 1.0  # range of heights over 5 x 5 cells up to which a cell is level
OUTLIER = 6.0  # robust standard deviations of a cell's own history
LEAST_STEP = 0.04  # tone-mapped difference below which nothing is an object
# of level, sunlit cells; cities without cars show half of it, as textures are seen beside their places
TRANSIENT_SHARE = 0.01


@dataclass
class Shown:
    """What the views show at the cells of a surface.

    Attributes:
        colour: ``[V, H, W, C]`` radiance; weight: ``[V, H, W]``, 1 where the view sees the cell.
        sunlit: ``[V, H, W]`` geometric visibility of the sun; nan where a view's sun is unknown.
    """

    colour: Tensor
    weight: Tensor
    sunlit: Tensor


def choose_light(
    surface: SurfaceScene, views: Sequence[View], cell_size: float, options: FitOptions, cast: Cast = sun_visibility
) -> tuple[FitOptions, list[str]]:
    """The options with ``auto`` of `shadow` and `transient` resolved, and why.

    Args:
        surface: start surface.
        views: the views.
        cell_size: edge of a cell [m].
        options: of the fit.
        cast: sun visibility of heights on cells under a sun.
    """
    if "auto" not in (options.shadow, options.transient):
        return options, []
    notes = []
    with torch.no_grad():
        shown = show(surface, views, cell_size, cast)
    if options.shadow == "auto":
        shadow, why = _choose_shadow(shown, views, cell_size, options)
        options = replace(options, shadow=shadow)
        notes.append(f"shadow {shadow}: {why}")
    if options.transient == "auto":
        share = transient_share(shown, surface.height)
        on = share > TRANSIENT_SHARE
        options = replace(options, transient="on" if on else "off")
        notes.append(
            f"transient {options.transient}: {100 * share:.2f} % of the level, sunlit cells differ from what the other "
            f"dates show ({100 * TRANSIENT_SHARE:g} % is the limit)"
        )
    return options, notes


def show(surface: SurfaceScene, views: Sequence[View], cell_size: float, cast: Cast = sun_visibility) -> Shown:
    """Resample the views to the cells of the surface; cells that the surface itself hides from a view do not count.

    Args:
        surface: start surface.
        views: the views.
        cell_size: edge of a cell [m].
        cast: sun visibility of heights on cells under a sun.
    """
    height = surface.height.detach()
    colours, weights, lights = [], [], []
    for view in views:
        picture, seen = shown_on(view, height.cpu().numpy(), cell_size)
        direction = np.array([*view.slope, 1.0]) / np.linalg.norm([*view.slope, 1.0])
        free = cast(height, cell_size, tuple(direction))
        colours.append(torch.from_numpy(picture))
        weights.append((torch.from_numpy(seen[..., 0]) * (free.cpu() > 0.95)).float())
        lit = cast(height, cell_size, view.sun).cpu() if view.sun else torch.full(height.shape, torch.nan)
        lights.append(lit)
    return Shown(torch.stack(colours), torch.stack(weights), torch.stack(lights))


def _choose_shadow(shown: Shown, views: Sequence[View], cell_size: float, options: FitOptions) -> tuple[Shadow, str]:
    """The richest model of sun visibility that predicts held-out views better than the plainer ones, and why.

    Args:
        shown: what the views show.
        views: the views.
        cell_size: edge of a cell [m].
        options: of the fit.
    """
    known = [j for j, view in enumerate(views) if view.sun is not None]
    if len(known) < LEAST_VIEWS:
        return "geometric", f"{len(known)} views with a known sun are too few to compare"
    held = known[1::4]
    random = np.random.default_rng(options.seed)
    rows, cols = shown.weight.shape[1:]
    cells = random.choice(rows * cols, min(CELLS, rows * cols), replace=False)
    y, x = cells // cols, cells % cols
    per_block = max(1, round(BLOCK_M / cell_size))
    blocks = torch.from_numpy((y // per_block) * (cols // per_block + 1) + x // per_block)
    west = torch.from_numpy((x // per_block) % 2 == 0)
    part = Shown(
        shown.colour.flatten(1, 2)[:, cells][:, None],
        shown.weight.flatten(1)[:, cells][:, None],
        shown.sunlit.flatten(1)[:, cells][:, None],
    )
    errors = {name: _held_out_errors(part, views, held, west, blocks, replace(options, shadow=name)) for name in LADDER}
    best, told = LADDER[0], []
    for name in LADDER[1:]:
        gain = errors[best] - errors[name]
        gain = gain[torch.isfinite(gain)]
        mean, error = float(gain.mean()), float(gain.std() / max(1, gain.numel()) ** 0.5)
        better = mean > error
        told.append(f"{name} {'beats' if better else 'does not beat'} {best} by {mean:.5f} +- {error:.5f}")
        if better:
            best = name
    return best, "; ".join(told) + " (tone-mapped error of held-out views)"


def _held_out_errors(
    part: Shown, views: Sequence[View], held: Sequence[int], west: Tensor, blocks: Tensor, options: FitOptions
) -> Tensor:
    """Mean absolute tone-mapped error per held-out view and block, ``[held * blocks]``, NaN where none is seen.

    A held-out view's own gain, offset and ambient light are fitted on one half of the blocks and scored on the other.
    """
    count, _, cells, bands = part.colour.shape
    torch_random = torch.Generator().manual_seed(options.seed)
    weight = part.weight[:, 0]
    train = torch.ones(count, dtype=torch.bool)
    train[list(held)] = False
    middle = (weight[train, :, None] * part.colour[train, 0]).sum(0) / weight[train].sum(0).clamp_min(1)[:, None]
    light = IlluminationModel.start(replace(options, transient="off"), (1, cells), count, torch.device("cpu"))
    albedo = middle.clone()
    colours = [torch.ones(count, bands), torch.zeros(count, bands), torch.full((count, bands), 0.3)]
    leaves = [albedo, *colours, *light.tensors.values()]
    for leaf in leaves:
        leaf.requires_grad_(True)
    gain, offset, ambient = colours

    def residual(j: int) -> Tensor:
        geometric = part.sunlit[j] if options.shadow != "none" else None
        s = light.visibility(j, views[j].sun, geometric)
        shaded = 1.0 if s is None else s[0, :, None] + (1 - s[0, :, None]) * ambient[j]
        return tone(gain[j] * albedo * shaded + offset[j]) - tone(part.colour[j, 0])

    def fit(parameters: Sequence[Tensor], which: Sequence[int], where: Tensor) -> None:
        adam = Adam(parameters, RATE, betas=(0.9, 0.99))
        for step in range(STEPS):
            adam.param_groups[0]["lr"] = RATE * (1 - step / STEPS)
            j = which[int(torch.randint(len(which), (1,), generator=torch_random))] if len(which) > 1 else which[0]
            adam.zero_grad(set_to_none=True)
            seen = weight[j] * where
            error = (residual(j).abs().mean(-1) * seen).sum() / seen.sum().clamp_min(1)
            cost = light.cost(j, views[j].sun, part.sunlit[j], step, options, 0.1) if len(which) > 1 else None
            (error if cost is None else error + 0.1 * cost).backward()
            adam.step()
            with torch.no_grad():
                ambient.clamp_(0.0, 1.0)

    everywhere = torch.ones(cells)
    for _ in range(3):
        fit(leaves, [j for j in range(count) if train[j]], everywhere)
    errors = torch.full((len(held), int(blocks.max()) + 1), torch.nan)
    for row, j in enumerate(held):
        for half in (west, ~west):
            with torch.no_grad():
                for values, start in zip(colours, (1.0, 0.0, 0.3), strict=True):
                    values[j] = start
            fit(colours, [j], half.float())
            with torch.no_grad():
                error = residual(j).abs().mean(-1)
                scored = (~half) & (weight[j] > 0)
                total = torch.zeros(errors.shape[1]).index_add_(0, blocks[scored], error[scored])
                number = torch.zeros(errors.shape[1]).index_add_(0, blocks[scored], torch.ones(int(scored.sum())))
                enough = number >= 5
                errors[row, enough] = (total / number)[enough]
    return errors.flatten()


@torch.no_grad()
def transient_share(shown: Shown, height: Tensor) -> float:
    """Share of the level, sunlit cells that one image shows unlike the cell's history in all the others.

    A cell's history is the median over the views that see it in the sun, each brought to the common colour by a robust
    line; an object must fill most of a square of 3 x 3 cells.
    """
    height = height.detach().cpu()
    span = max_pool2d(height[None], 5, 1, 2) + max_pool2d(-height[None], 5, 1, 2)
    level = span[0] < PLAIN_M
    lit = (shown.weight > 0) & (torch.nan_to_num(shown.sunlit, nan=1.0) > 0.95) & level
    gray = tone(shown.colour.mean(-1))
    gray = torch.where(lit, gray, torch.nan)
    common = gray.clone()
    for _ in range(2):  # bring every image to the median image
        middle = common.nanmedian(dim=0).values
        for j in range(len(gray)):
            both = torch.isfinite(gray[j]) & torch.isfinite(middle)
            if int(both.sum()) < 50:
                common[j] = torch.nan
                continue
            a, b = _line(gray[j][both], middle[both])
            common[j] = a * gray[j] + b
    middle = common.nanmedian(dim=0).values
    difference = common - middle
    # spread of the cell's own history: texture that is seen a little beside its place varies in every image
    spread = 1.4826 * difference.abs().nanmedian(dim=0).values
    enough = torch.isfinite(common).sum(0) >= 4
    known = torch.isfinite(difference) & enough
    odd = known & (difference.abs() > torch.maximum(OUTLIER * spread, torch.tensor(LEAST_STEP)))
    filled = avg_pool2d(odd.float(), 3, 1, 1) * 9
    objects = odd & (filled > 4.5)
    return float(objects.sum() / known.sum().clamp_min(1))


def _line(x: Tensor, y: Tensor) -> tuple[float, float]:
    """Slope and intercept of y over x by least squares, twice without the worst tenth."""
    keep = torch.ones_like(x, dtype=torch.bool)
    a, b = 1.0, 0.0
    for _ in range(3):
        u, v = x[keep], y[keep]
        centred = u - u.mean()
        a = float((centred * (v - v.mean())).sum() / centred.square().sum().clamp_min(1e-9))
        b = float(v.mean() - a * u.mean())
        error = (a * x + b - y).abs()
        keep = error <= torch.quantile(error[:: max(1, error.numel() // 100_000)], 0.9)
    return a, b


__all__ = ["Shown", "choose_light", "show", "transient_share"]
