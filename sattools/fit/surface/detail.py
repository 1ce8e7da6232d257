"""A fitted surface on the cells of the prior: its correction of the prior, with the prior's detail.

Images of 0.3 to 0.5 m say on cells of 1 m what the prior's heights, matched on cells of half the size, have wrong; and
a fit on the finer cells would take four times as long to say the same. What 1 m cells cannot hold is where walls are:
a cell of the fit with a wall in it has one height for both sides.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch
from scipy.ndimage import maximum_filter, minimum_filter
from torch import Tensor
from torch.nn.functional import max_pool2d, pad

from sattools.fit.depth_prior import DepthPrior
from sattools.fit.model import FittedModel
from sattools.fit.surface.trainer import WALL_SLOPE
from sattools.scene import Grid
from sattools.scene.regrid import resize_map, sample_map


def with_detail(model: FittedModel, prior: DepthPrior) -> FittedModel:
    """The model on the prior's cells: interpolated, but near walls the prior with the fit's correction.

    In cells with a wall, whose rays do not count in the fit either, there is no correction.

    Args:
        model: a surface without reflectance model, on coarser cells with the same upper left corner.
        prior: what it was fitted from.

    Returns:
        The model on the prior's grid; where the prior has no height, the fit's own is interpolated.
    """
    wall = _with_wall(prior.height.numpy(), prior.grid, model.grid)
    correction = model.height - prior.on(model.grid).height
    correction[wall] = 0.0
    detailed = prior.height + _on(correction.nan_to_num(0.0), model.grid, prior.grid)
    # where no wall is near, what the prior has beyond the fit's cells is noise, most of all on rough ground; at the
    # border, coarse cells cannot be interpolated
    near = _on(max_pool2d(pad(wall.float(), (1, 1, 1, 1), value=1.0)[None], 3, 1)[0], model.grid, prior.grid)
    plain = _on(model.height, model.grid, prior.grid)
    height = torch.where(detailed.isfinite(), plain + near * (detailed - plain), plain)
    return replace(
        model,
        grid=prior.grid,
        height=height,
        height_std=_on(model.height_std, model.grid, prior.grid),
        albedo=_on(model.albedo, model.grid, prior.grid),
        s_net=_each_on(model.s_net, model.grid, prior.grid),
        tau=_each_on(model.tau, model.grid, prior.grid),
    )


def _with_wall(height: np.ndarray, source: Grid, target: Grid) -> Tensor:
    """Cells of a coarser grid, ``[h, w]`` bool, that hold a cell ``[H, W]`` of the source beside a wall [m]."""
    low, high = (np.where(np.isfinite(height), height, far).astype(np.float32) for far in (np.inf, -np.inf))
    span = maximum_filter(high, 3, mode="nearest") - minimum_filter(low, 3, mode="nearest")
    wall = span > WALL_SLOPE * 2 * source.cell_size  # -inf where all is unknown
    return torch.from_numpy(resize_map(wall.astype(np.float32), source, target) > 0)


def _on(array: Tensor, source: Grid, target: Grid) -> Tensor:
    """A map ``[H, W]`` or ``[H, W, C]`` on another grid, bilinear."""
    return torch.from_numpy(sample_map(array.numpy(), source, target))


def _each_on(maps: Tensor | None, source: Grid, target: Grid) -> Tensor | None:
    """Maps ``[V, H, W]`` on another grid."""
    return None if maps is None else torch.stack([_on(one, source, target) for one in maps])


__all__ = ["with_detail"]
