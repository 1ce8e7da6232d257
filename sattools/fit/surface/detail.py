"""A fitted surface on the cells of the prior: its correction of the prior, with the prior's detail.

Images of 0.3 to 0.5 m say on cells of 1 m what the prior's heights, matched on cells of half the size, have wrong; and
a fit on the finer cells would take four times as long to say the same. What 1 m cells cannot hold is where walls are.
"""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor

from sattools.fit.depth_prior import DepthPrior
from sattools.fit.model import FittedModel
from sattools.scene import Grid
from sattools.scene.regrid import sample_map


def with_detail(model: FittedModel, prior: DepthPrior) -> FittedModel:
    """The model on the prior's cells: prior + correction, the other maps interpolated.

    Args:
        model: a surface without reflectance model, on coarser cells with the same upper left corner.
        prior: what it was fitted from.

    Returns:
        The model on the prior's grid; where the prior has no height, the fit's own is interpolated.
    """
    correction = model.height - prior.on(model.grid).height
    fine = prior.height + _on(correction.nan_to_num(0.0), model.grid, prior.grid)
    height = torch.where(fine.isfinite(), fine, _on(model.height, model.grid, prior.grid))
    return replace(
        model,
        grid=prior.grid,
        height=height,
        height_std=_on(model.height_std, model.grid, prior.grid),
        albedo=_on(model.albedo, model.grid, prior.grid),
        s_net=_each_on(model.s_net, model.grid, prior.grid),
        tau=_each_on(model.tau, model.grid, prior.grid),
    )


def _on(array: Tensor, source: Grid, target: Grid) -> Tensor:
    """A map ``[H, W]`` or ``[H, W, C]`` on another grid, bilinear."""
    return torch.from_numpy(sample_map(array.numpy(), source, target))


def _each_on(maps: Tensor | None, source: Grid, target: Grid) -> Tensor | None:
    """Maps ``[V, H, W]`` on another grid."""
    return None if maps is None else torch.stack([_on(one, source, target) for one in maps])


__all__ = ["with_detail"]
