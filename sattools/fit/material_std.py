"""Standard deviations of the reflectance parameters."""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor

from sattools.fit.inversion import STEP, Samples, Solution, noise_of, predict
from sattools.fit.material import AMOUNT, SHAPE, Kind

SLOPE_STD = 0.06  # of the surface's slopes, metres per metre: about 3.5 degrees
TEXTURE_STD = 0.04  # of the amount: texture finer than the surface's own error in place is smeared
# errors of the geometry are alike in neighbouring cells, which the curvature takes for independent; one factor per
# shape parameter, set on simulated scenes (theta by itself: with 1.8 its deviations were wider than its errors)
MEMBER_FACTOR: dict[Kind, tuple[float, float, float]] = {"rpv": (1.8, 1.8, 1.8), "hapke": (1.8, 1.8, 1.1)}


@torch.no_grad()
def parameter_std(kind: Kind, s: Samples, amount: Tensor, found: Solution) -> dict[str, Tensor]:
    """Standard deviations of the amount ``[N, C]`` and of the three shape parameters ``[N]``, by name.

    From the Gauss-Newton curvature of `invert`: cells of one material, with their many slopes, speak together for its
    shape; a cell's amount has the noise of its own views, the share of the shape's error that it takes up, the error
    of its slope (`SLOPE_STD`), which all views under one sun share, and that of its texture's place (`TEXTURE_STD`).
    Materials that were told apart wrongly are not in it.
    """
    members = found.members
    sigma = noise_of(s)
    here = predict(kind, s, amount, members)
    residual = (s.seen - here) / sigma
    j_amount = (predict(kind, s, amount + STEP, members) - here) / STEP / sigma
    weight = s.weight[..., None]
    a = (weight * j_amount**2).sum(0) + 1e-3

    def answer(change: Tensor) -> Tensor:
        """How the amounts follow when the prediction changes."""
        return -(weight * j_amount * change / sigma).sum(0) / a

    seen = weight.sum(0).clamp_min(1)
    misfit = ((weight * residual**2).sum(0) / seen).mean(-1, keepdim=True).clamp(0.25, 25)
    variance = misfit / a
    for axis in (0, 1):
        normal = s.normal.clone()
        normal[:, axis] += SLOPE_STD * normal[:, 2]
        normal = normal / normal.norm(dim=-1, keepdim=True)
        variance = variance + answer(predict(kind, replace(s, normal=normal), amount, members) - here) ** 2
    factor = members.new_tensor(MEMBER_FACTOR[kind]).repeat(members.shape[0])
    covariance = found.covariance.to(members) * factor * factor[:, None]
    blocks = covariance.reshape(members.shape[0], 3, members.shape[0], 3)
    own = torch.einsum("nk,kplq,nl->npq", s.shares, blocks, s.shares)  # [N, 3, 3]
    follow = []
    for p in range(3):
        moved = members.clone()
        moved[:, p] += STEP
        follow.append(answer(predict(kind, s, amount, moved) - here) / STEP)
    j = torch.stack(follow, -1)  # [N, C, 3]
    variance = variance + torch.einsum("ncp,npq,ncq->nc", j, own, j)
    value, slope = AMOUNT[kind].bounded(amount), AMOUNT[kind].slope(amount)
    variance = variance + (TEXTURE_STD * value / slope) ** 2
    # beyond one unit of the unbounded form the range itself is the limit
    result = {AMOUNT[kind].name: variance.sqrt().clamp_max(1.5) * slope}
    for p, parameter in enumerate(SHAPE[kind]):
        std = own[:, p, p].sqrt().clamp_max(1.5)
        result[parameter.name] = std * parameter.slope(s.shares @ members[:, p])
    return result


__all__ = ["parameter_std"]
