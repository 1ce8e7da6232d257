"""Reflectance parameters from what the views show of a known surface: least squares with the amounts eliminated.

Every cell has its own amount per band, the end-members' shapes are common to all cells. For given shapes the amounts
are found one by one, so a Gauss-Newton step of the few shape numbers needs only the small reduced system (variable
projection; Golub & Pereyra 1973). The same system gives the covariance of all parameters.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from sattools.fit.material import AMOUNT, SHAPE, Kind, radiance_factor

STEP = 1e-3  # of the finite differences in the unbounded form
GAP_SHARE = 0.02  # error of the model and the geometry, as share of the signal
LIKENESS = 1.0  # spread of the log amount of one material: wide, but it lets the shading of its slopes speak
ROBUST = 2.5  # residual, in standard deviations, from which a view of a cell counts less


@dataclass
class Samples:
    """Cells as seen by the views.

    Attributes:
        normal: ``[N, 3]``; shares: ``[N, K]``.
        seen: ``[V, N, C]`` pi L / E; weight: ``[V, N]``, 0 = not seen or in shade.
        suns, views: unit vectors ``[3]``, one per view.
    """

    normal: Tensor
    shares: Tensor
    seen: Tensor
    weight: Tensor
    suns: Sequence[Tensor]
    views: Sequence[Tensor]

    def subset(self, index: Tensor) -> Samples:
        """Some of the cells."""
        return Samples(
            self.normal[index], self.shares[index], self.seen[:, index], self.weight[:, index], self.suns, self.views
        )


def shape_of(kind: Kind, shares: Tensor, members: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Shape parameters ``[...]`` of cells from shares ``[..., K]`` and the members' unbounded values ``[K, 3]``."""
    a, b, c = (p.bounded(shares @ members[:, k]) for k, p in enumerate(SHAPE[kind]))
    return a, b, c


def start_members(kind: Kind, count: int, like: Tensor) -> Tensor:
    """Unbounded values ``[count, 3]`` of usual shapes."""
    usual = [p.raw(like.new_tensor(p.usual)) for p in SHAPE[kind]]
    return torch.stack(usual).repeat(count, 1)


def predict(kind: Kind, s: Samples, amount: Tensor, members: Tensor) -> Tensor:
    """``[V, N, C]`` from unbounded amounts ``[N, C]``."""
    value, shape = AMOUNT[kind].bounded(amount), shape_of(kind, s.shares, members)
    pairs = zip(s.suns, s.views, strict=True)
    return torch.stack([radiance_factor(kind, s.normal, sun, view, value, shape) for sun, view in pairs])


def with_slope(kind: Kind, s: Samples, amount: Tensor, members: Tensor) -> tuple[Tensor, Tensor]:
    """`predict` and its derivative with the amounts: as further bands, which share all that depends on directions."""
    here, moved = predict(kind, s, torch.cat([amount, amount + STEP], -1), members).chunk(2, -1)
    return here, (moved - here) / STEP


def noise_of(s: Samples) -> Tensor:
    """Standard deviation ``[V, N, C]`` taken for what a view shows of a cell."""
    return GAP_SHARE * s.seen.clamp_min(0) + 0.002


@torch.no_grad()
def solve_amounts(
    kind: Kind,
    s: Samples,
    members: Tensor,
    amount: Tensor | None = None,
    rounds: int = 4,
    centre: Tensor | None = None,
) -> tuple[Tensor, Tensor]:
    """Unbounded amounts ``[N, C]`` that fit best, and their curvature ``[N, C]`` sum (J / sigma)^2."""
    limits = AMOUNT[kind]
    if amount is None:
        amount = limits.raw(torch.full_like(s.seen[0], limits.usual))
    sigma = noise_of(s)
    for _ in range(rounds):
        here, slope = with_slope(kind, s, amount, members)
        residual = (s.seen - here) / sigma
        weight = s.weight[..., None] / (1 + (residual / ROBUST) ** 2)
        j = slope / sigma
        curvature = (weight * j * j).sum(0)
        # a weak pull to the usual keeps cells that no view sees
        tie = torch.full_like(amount, 1e-3) if centre is None else tie_of(centre)
        aim = limits.raw(amount.new_tensor(limits.usual)) if centre is None else centre
        step = ((weight * j * residual).sum(0) + tie * (aim - amount)) / (curvature + tie)
        amount = (amount + step.clamp(-1.5, 1.5)).clamp(-9, 9)
    return amount, curvature


def material_mean(shares: Tensor, amount: Tensor, counted: Tensor | None = None) -> Tensor:
    """Mean amount of the materials of every cell ``[N, C]``, unbounded; only the cells ``counted`` ``[N, 1]`` count."""
    mass = shares if counted is None else shares * counted
    return shares @ (mass.T @ amount / (mass.sum(0)[:, None] + 1e-6))


def tie_of(centre: Tensor) -> Tensor:
    """Precision of the unbounded amounts about their material's mean: `LIKENESS` in logarithms of the amount.

    In the unbounded form bright materials would vary more than dark ones of the same texture, and be pulled down.
    """
    return ((1 - torch.sigmoid(centre)) / LIKENESS) ** 2


@dataclass
class Solution:
    """Unbounded amounts ``[N, C]``, members ``[K, 3]``, covariance of the members ``[3K, 3K]`` (row-major)."""

    amount: Tensor
    members: Tensor
    covariance: Tensor


@torch.no_grad()
def invert(
    kind: Kind, s: Samples, members: Tensor, rounds: int = 12, independent: float = 0.2, free: bool = True
) -> Solution:
    """Fit amounts and members to samples.

    Args:
        kind: model.
        s: the samples; some thousand cells are enough for the members.
        members: start values.
        rounds: Gauss-Newton steps.
        independent: share of the cells taken for independent of each other; it sets how far the priors of the shapes
            yield.
        free: fit the members; else only the amounts.
    """
    count = members.numel()
    usual = start_members(kind, members.shape[0], members)
    width = members.new_tensor([p.width for p in SHAPE[kind]]).expand_as(members).reshape(-1)
    amount, _ = solve_amounts(kind, s, members, rounds=6)
    damping = 1.0
    covariance = torch.zeros(count, count, dtype=members.dtype)
    cost = float("inf")
    best = (amount, members)
    for _ in range(rounds if free else 0):
        sigma = noise_of(s)
        here, slope = with_slope(kind, s, amount, members)
        residual = (s.seen - here) / sigma
        weight = s.weight[..., None] / (1 + (residual / ROBUST) ** 2)
        centre = material_mean(s.shares, amount)
        now = float((weight * residual**2).sum()) * independent
        now += float((tie_of(centre) * (amount - centre) ** 2).sum()) * independent
        now += float((((members - usual).reshape(-1) / width) ** 2).sum())
        if now < cost:
            damping, cost, best = max(damping / 4, 1e-6), now, (amount, members)
        else:
            damping *= 10
        j_amount = slope / sigma  # [V, N, C]
        # a change of one shape parameter of all members together: members differ by their shares
        columns = []
        for p in range(members.shape[1]):
            moved = members.clone()
            moved[:, p] += STEP
            columns.append((predict(kind, s, amount, moved) - here) / STEP / sigma)
        j_shape = torch.stack(columns, -1)  # [V, N, C, 3]
        a = (weight * j_amount**2).sum(0) + tie_of(centre)  # [N, C]
        cross = (weight[..., None] * j_amount[..., None] * j_shape).sum(0)  # [N, C, 3]
        full = torch.einsum("vncp,vncq->npq", weight[..., None] * j_shape, j_shape)
        reduced = full - torch.einsum("ncp,ncq->npq", cross / a[..., None], cross)
        g_shape = torch.einsum("vncp,vnc->np", j_shape, weight * residual)
        g_amount = (weight * j_amount * residual).sum(0) + tie_of(centre) * (centre - amount)
        g = g_shape - torch.einsum("ncp,nc->np", cross, g_amount / a)
        hessian = torch.einsum("nk,nl,npq->kplq", s.shares, s.shares, reduced).reshape(count, count) * independent
        gradient = torch.einsum("nk,np->kp", s.shares, g).reshape(count) * independent
        hessian = hessian + torch.diag(1 / width**2)
        gradient = gradient + (usual - members).reshape(-1) / width**2
        covariance = torch.linalg.inv(hessian)
        step = torch.linalg.solve(hessian + damping * torch.diag(hessian.diagonal()), gradient)
        members = (members + step.reshape(members.shape).clamp(-0.7, 0.7)).clamp(-6, 6)
        amount, _ = solve_amounts(kind, s, members, amount, 1, centre)
    amount, members = best if free else (amount, members)
    return Solution(amount, members, covariance)


__all__ = ["Samples", "Solution", "invert", "material_mean", "predict", "shape_of", "solve_amounts", "start_members"]
