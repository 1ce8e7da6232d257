"""Reflectance parameters from what the views show of a known surface: least squares with the amplitudes eliminated.

Every cell has its own amplitude per band, the endmembers' shapes are common to all cells. For given shapes the
amplitudes are found one by one, so a Gauss-Newton step of the few shape numbers needs only the small reduced system
(variable projection; Golub & Pereyra 1973). The same system gives the covariance of all parameters.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import torch
from torch import Tensor

from sattools.fit.materials.parameters import AMPLITUDE, SHAPE, Kind, diffuse, radiance_factor
from sattools.reflectance.hapke_bands import hapke_slopes

STEP = 1e-3  # of the finite differences in the unbounded form
GAP_SHARE = 0.02  # error of the model and the geometry, as share of the signal
LIKENESS = 1.0  # spread of the log amplitude of one material: wide, but it lets the shading of its slopes speak
FAINT = 1e-3  # of a plain material in a cell's shape: it decides only where there is hardly anything else
ROBUST = 2.5  # residual, in standard deviations, from which a view of a cell counts less


@dataclass
class Samples:
    """Cells as seen by the views.

    Attributes:
        normal: ``[N, 3]``; shares: ``[N, K]``.
        seen: ``[V, N, C]`` pi L / E; weight: ``[V, N]``, 0 = not seen or in shade.
        suns, views: unit vectors ``[3]``, one per view.
        sky: ``[N, C]`` gain of the sky's light, see `sattools.fit.materials.sky`, or None = no sky.
        share: ``[C]`` of the sky.
        shown: ``[V, N]`` 1 = the view has a value there, in shade as well; or None = not told.
        plain: ``[K]`` 1 = the material reflects as Lambert's law has it, else 0; or None = none does.
    """

    normal: Tensor
    abundances: Tensor
    seen: Tensor
    weight: Tensor
    suns: Sequence[Tensor]
    views: Sequence[Tensor]
    sky: Tensor | None = None
    share: Tensor = field(default_factory=lambda: torch.zeros(0))
    shown: Tensor | None = None
    plain: Tensor | None = None

    @property
    def plain_share(self) -> Tensor | None:
        """Share ``[N]`` of every cell that reflects as Lambert's law has it, or None."""
        return None if self.plain is None else self.abundances @ self.plain

    @property
    def shape_shares(self) -> Tensor:
        """Shares ``[N, K]`` of the endmembers in the shape of every cell, see `shape_shares`."""
        return shape_shares(self.abundances, self.plain)

    def subset(self, index: Tensor) -> Samples:
        """Some of the cells."""
        return replace(
            self,
            normal=self.normal[index],
            abundances=self.abundances[index],
            seen=self.seen[:, index],
            weight=self.weight[:, index],
            sky=None if self.sky is None else self.sky[index],
            shown=None if self.shown is None else self.shown[:, index],
        )


def shape_shares(abundances: Tensor, plain: Tensor | None) -> Tensor:
    """Shares ``[..., K]`` of the endmembers in the shape of a cell: its abundances, but of what has a shape alone.

    Where ground of Lambert's law and other ground meet, all that is not Lambert's has the other ground's shape.

    Args:
        abundances: ``[..., K]`` in [0, 1].
        plain: ``[K]`` 1 = the endmember reflects as Lambert's law has it and has no shape, else 0; or None = none does.
    """
    if plain is None:
        return abundances
    shares = abundances * (1 - (1 - FAINT) * plain)
    return shares / shares.sum(-1, keepdim=True)


def shape_of(kind: Kind, shares: Tensor, endmembers: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Shape parameters ``[...]`` of cells, within their ranges.

    Args:
        kind: reflectance model.
        shares: ``[..., K]`` of the endmembers in each cell, in [0, 1], see `shape_shares`.
        endmembers: ``[K, 3]`` unbounded shape parameters.
    """
    a, b, c = (p.bounded(shares @ endmembers[:, k]) for k, p in enumerate(SHAPE[kind]))
    return a, b, c


def start_endmembers(kind: Kind, count: int, like: Tensor) -> Tensor:
    """Unbounded values ``[count, 3]`` of the prior's mean shapes.

    Args:
        kind: reflectance model.
        count: number of endmembers.
        like: tensor of the same type and device.
    """
    prior_mean = [p.raw(like.new_tensor(p.prior_mean)) for p in SHAPE[kind]]
    return torch.stack(prior_mean).repeat(count, 1)


def predict(kind: Kind, s: Samples, amplitude: Tensor, endmembers: Tensor) -> Tensor:
    """``[V, N, C]`` from unbounded amplitudes ``[N, C]``.

    Args:
        kind: reflectance model.
        s: the samples.
        amplitude: ``[N, C]`` unbounded.
        endmembers: ``[K, 3]`` unbounded shape parameters.
    """
    value, shape = AMPLITUDE[kind].bounded(amplitude), shape_of(kind, s.shape_shares, endmembers)
    pairs = zip(s.suns, s.views, strict=True)
    plain = s.plain_share
    direct = torch.stack([radiance_factor(kind, s.normal, sun, view, value, shape, plain=plain) for sun, view in pairs])
    if s.sky is None:
        return direct
    more = value.shape[-1] // s.sky.shape[-1]  # `with_slope` asks for several values of every band
    return direct + s.share.repeat(more) * s.sky.repeat(1, more) * diffuse(kind, value)


def with_slope(kind: Kind, s: Samples, amplitude: Tensor, endmembers: Tensor) -> tuple[Tensor, Tensor]:
    """`predict` and its derivative with the unbounded amplitudes, both ``[V, N, C]``.

    Args:
        kind: reflectance model.
        s: the samples.
        amplitude: ``[N, C]`` unbounded.
        endmembers: ``[K, 3]`` unbounded shape parameters.
    """
    if _compiled(kind, s):
        value, slopes = _slopes(kind, s, amplitude, endmembers, shapes=False)
        return value, slopes[..., 0]
    # as further bands, which share what depends on directions
    here, moved = predict(kind, s, torch.cat([amplitude, amplitude + STEP], -1), endmembers).chunk(2, -1)
    return here, (moved - here) / STEP


def with_slopes(kind: Kind, s: Samples, amplitude: Tensor, endmembers: Tensor) -> tuple[Tensor, Tensor]:
    """`predict` ``[V, N, C]`` and its derivatives ``[V, N, C, 4]`` with the amplitudes and the three shapes.

    All unbounded; a shape changes in all endmembers together: cells differ by their shares.

    Args:
        kind: reflectance model.
        s: the samples.
        amplitude: ``[N, C]`` unbounded.
        endmembers: ``[K, 3]`` unbounded shape parameters.
    """
    if _compiled(kind, s):
        return _slopes(kind, s, amplitude, endmembers, shapes=True)
    return differences(kind, s, amplitude, endmembers)


def differences(kind: Kind, s: Samples, amplitude: Tensor, endmembers: Tensor) -> tuple[Tensor, Tensor]:
    """`with_slopes` by finite differences, for any model and device: the twin of the compiled one.

    Args:
        kind: reflectance model.
        s: the samples.
        amplitude: ``[N, C]`` unbounded.
        endmembers: ``[K, 3]`` unbounded shape parameters.
    """
    here, moved = predict(kind, s, torch.cat([amplitude, amplitude + STEP], -1), endmembers).chunk(2, -1)
    columns = [(moved - here) / STEP]
    for p in range(endmembers.shape[1]):
        other = endmembers.clone()
        other[:, p] += STEP
        columns.append((predict(kind, s, amplitude, other) - here) / STEP)
    return here, torch.stack(columns, -1)


def _compiled(kind: Kind, s: Samples) -> bool:
    """Whether derivatives come with the values."""
    return kind == "hapke" and s.normal.device.type == "cpu"


def _slopes(kind: Kind, s: Samples, amplitude: Tensor, endmembers: Tensor, shapes: bool) -> tuple[Tensor, Tensor]:
    """`with_slopes` by the compiled model; without ``shapes`` with the amplitudes alone ``[V, N, C, 1]``."""
    limits = AMPLITUDE[kind]
    value, shape = limits.bounded(amplitude), shape_of(kind, s.shape_shares, endmembers)
    pairs = zip(s.suns, s.views, strict=True)
    found = [hapke_slopes(s.normal, sun, view, value, shape, shapes=shapes) for sun, view in pairs]
    here, slopes = (torch.stack(parts) for parts in zip(*found, strict=True))
    slopes[..., 0] *= limits.slope(amplitude)
    if shapes:
        for k, p in enumerate(SHAPE[kind]):
            slopes[..., 1 + k] *= p.slope(s.shape_shares @ endmembers[:, k])[:, None]
    if s.sky is None and s.plain is None:
        return here, slopes
    glow = diffuse(kind, value)
    rising = (diffuse(kind, limits.bounded(amplitude + STEP)) - glow) / STEP
    if (share := s.plain_share) is not None:
        cosines = torch.stack([s.normal @ sun for sun in s.suns]).clamp_min(0)[..., None]
        slopes *= (1 - share)[:, None, None]
        slopes[..., 0] += share[:, None] * cosines * rising
        here += share[:, None] * (cosines * glow - here)
    if s.sky is not None:
        here += s.share * s.sky * glow
        slopes[..., 0] += s.share * s.sky * rising
    return here, slopes


def noise_of(s: Samples) -> Tensor:
    """Standard deviation ``[V, N, C]`` taken for what a view shows of a cell."""
    return GAP_SHARE * s.seen.clamp_min(0) + 0.002


@torch.no_grad()
def solve_amplitudes(
    kind: Kind,
    s: Samples,
    endmembers: Tensor,
    amplitude: Tensor | None = None,
    *,
    rounds: int,
    centre: Tensor | None = None,
) -> tuple[Tensor, Tensor]:
    """Unbounded amplitudes ``[N, C]`` that fit best, and their curvature ``[N, C]`` sum (J / sigma)^2.

    Args:
        kind: reflectance model.
        s: the samples.
        endmembers: ``[K, 3]`` unbounded shape parameters.
        amplitude: ``[N, C]`` unbounded, where to begin; None = the prior's mean.
        rounds: number of Newton steps.
        centre: ``[N, C]`` unbounded mean of each cell's material, or None.
    """
    limits = AMPLITUDE[kind]
    if amplitude is None:
        amplitude = limits.raw(torch.full_like(s.seen[0], limits.prior_mean))
    sigma = noise_of(s)
    for _ in range(rounds):
        here, slope = with_slope(kind, s, amplitude, endmembers)
        residual = (s.seen - here) / sigma
        weight = s.weight[..., None] / (1 + (residual / ROBUST) ** 2)
        j = slope / sigma
        curvature = (weight * j * j).sum(0)
        # a weak pull to the prior's mean keeps cells that no view sees
        precision = torch.full_like(amplitude, 1e-3) if centre is None else _amplitude_precision(centre)
        aim = limits.raw(amplitude.new_tensor(limits.prior_mean)) if centre is None else centre
        step = ((weight * j * residual).sum(0) + precision * (aim - amplitude)) / (curvature + precision)
        amplitude = (amplitude + step.clamp(-1.5, 1.5)).clamp(-9, 9)
    return amplitude, curvature


def material_mean(abundances: Tensor, amplitude: Tensor, counted: Tensor | None = None) -> Tensor:
    """Mean unbounded amplitude of the materials of every cell ``[N, C]``; of the cells ``counted`` ``[N, 1]`` alone.

    Args:
        abundances: ``[N, K]`` in [0, 1].
        amplitude: ``[N, C]`` unbounded.
        counted: ``[N, 1]`` weights of the cells, or None = all 1.
    """
    mass = abundances if counted is None else abundances * counted
    return abundances @ (mass.T @ amplitude / (mass.sum(0)[:, None] + 1e-6))


def _amplitude_precision(centre: Tensor) -> Tensor:
    """Precision of the unbounded amplitudes about their material's mean: `LIKENESS` in logarithms of the amplitude.

    In the unbounded form bright materials would vary more than dark ones of the same texture, and be pulled down.
    """
    return ((1 - torch.sigmoid(centre)) / LIKENESS) ** 2


@dataclass
class Solution:
    """Unbounded amplitudes ``[N, C]``, endmembers ``[K, 3]`` and their covariance ``[3K, 3K]`` (row-major)."""

    amplitude: Tensor
    endmembers: Tensor
    covariance: Tensor


@dataclass
class _System:
    """Normal equations of the endmembers (row-major), the amplitudes eliminated, and the present cost."""

    hessian: Tensor
    gradient: Tensor
    cost: float
    centre: Tensor


def _system(kind: Kind, s: Samples, amplitude: Tensor, endmembers: Tensor, independent: float) -> _System:
    """See `_System`; without the endmembers' prior."""
    count = endmembers.numel()
    sigma = noise_of(s)
    here, slopes = with_slopes(kind, s, amplitude, endmembers)
    residual = (s.seen - here) / sigma
    weight = s.weight[..., None] / (1 + (residual / ROBUST) ** 2)
    centre = material_mean(s.abundances, amplitude)
    cost = float((weight * residual**2).sum()) * independent
    cost += float((_amplitude_precision(centre) * (amplitude - centre) ** 2).sum()) * independent
    slopes = slopes / sigma[..., None]
    j_amplitude, j_shape = slopes[..., 0], slopes[..., 1:]  # [V, N, C], [V, N, C, 3]
    a = (weight * j_amplitude**2).sum(0) + _amplitude_precision(centre)  # [N, C]
    cross = (weight[..., None] * j_amplitude[..., None] * j_shape).sum(0)  # [N, C, 3]
    full = torch.einsum("vncp,vncq->npq", weight[..., None] * j_shape, j_shape)
    reduced = full - torch.einsum("ncp,ncq->npq", cross / a[..., None], cross)
    g_shape = torch.einsum("vncp,vnc->np", j_shape, weight * residual)
    g_amplitude = (weight * j_amplitude * residual).sum(0) + _amplitude_precision(centre) * (centre - amplitude)
    g = g_shape - torch.einsum("ncp,nc->np", cross, g_amplitude / a)
    shares = s.shape_shares
    hessian = torch.einsum("nk,nl,npq->kplq", shares, shares, reduced).reshape(count, count) * independent
    gradient = torch.einsum("nk,np->kp", shares, g).reshape(count) * independent
    return _System(hessian, gradient, cost, centre)


@torch.no_grad()
def invert(kind: Kind, s: Samples, endmembers: Tensor, rounds: int = 12, independent: float = 0.2) -> Solution:
    """Fit amplitudes and endmembers to samples.

    Args:
        kind: model.
        s: the samples; some thousand cells are enough for the endmembers.
        endmembers: start values.
        rounds: Gauss-Newton steps.
        independent: share of the cells taken for independent of each other; it sets how far the priors of the shapes
            yield.
    """
    count = endmembers.numel()
    prior_mean = start_endmembers(kind, endmembers.shape[0], endmembers)
    prior_sigma = endmembers.new_tensor([p.prior_sigma for p in SHAPE[kind]]).expand_as(endmembers).reshape(-1)
    amplitude, _ = solve_amplitudes(kind, s, endmembers, rounds=6)
    damping = 1.0
    covariance = torch.zeros(count, count, dtype=endmembers.dtype)
    cost = float("inf")
    best = (amplitude, endmembers)
    for _ in range(rounds):
        system = _system(kind, s, amplitude, endmembers, independent)
        away = (prior_mean - endmembers).reshape(-1)
        now = system.cost + float(((away / prior_sigma) ** 2).sum())
        if now < cost:
            damping, cost, best = max(damping / 4, 1e-6), now, (amplitude, endmembers)
        else:
            damping *= 10
        hessian = system.hessian + torch.diag(1 / prior_sigma**2)
        gradient = system.gradient + away / prior_sigma**2
        covariance = torch.linalg.inv(hessian)
        step = torch.linalg.solve(hessian + damping * torch.diag(hessian.diagonal()), gradient)
        endmembers = (endmembers + step.reshape(endmembers.shape).clamp(-0.7, 0.7)).clamp(-6, 6)
        amplitude, _ = solve_amplitudes(kind, s, endmembers, amplitude, rounds=1, centre=system.centre)
    return Solution(*best, covariance)


__all__ = [
    "ROBUST",
    "Samples",
    "Solution",
    "differences",
    "invert",
    "material_mean",
    "noise_of",
    "predict",
    "shape_of",
    "shape_shares",
    "solve_amplitudes",
    "start_endmembers",
    "with_slope",
    "with_slopes",
]
