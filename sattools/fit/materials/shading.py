"""What of a cell's brightness is its material's, and what is an error of the surface's slope.

Under one sun a cell that leans more than the surface has it looks like one that is darker than its material. A fit that
knows of no errors of slopes gives all of that to the amplitude, and most where the sun grazes. Here both may move, each
as far as it usually does, and what all views of the cell show stays what it is.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from sattools.fit.materials.inversion import ROBUST, Samples, material_mean, noise_of, predict, with_slope
from sattools.fit.materials.parameters import Kind
from sattools.fit.materials.uncertainty import SLOPE_STD

TEXTURE = 0.2  # spread of the log amplitude within a material; from 0.1 to 0.2 it hardly matters
ALIKE = 0.9  # correlation of that between bands; 0.91 to 0.98 on scenes of several kinds
# mean residual of a cell, in standard deviations, from which the views are believed and not the descent, which undoes
# the blur of the images but never looks again at what its loss has taken for an outlier
MISFIT = 5.0
LEAST_COUNT = 1e-4  # of a cell in shade in its material's mean: that of one all in shade is its own
ROUNDS = 2
STEP = 0.01  # of the finite differences [m per m]
STEEPEST = 1.0  # change of a slope [m per m]
CHUNK = 1 << 16  # cells at a time


def tilted(normal: Tensor, slope: Tensor) -> Tensor:
    """Unit normals ``[N, 3]`` that lean further by ``slope`` ``[N, 2]`` (to east and north, metres per metre).

    Args:
        normal: ``[N, 3]`` unit vectors that point up.
        slope: how far the surface falls more, per metre.
    """
    moved = torch.cat([normal[:, :2] + slope * normal[:, 2:], normal[:, 2:]], -1)
    return moved / moved.norm(dim=-1, keepdim=True)


@dataclass
class _Derivatives:
    """What the views should show ``[V, N, C]``, and how that changes with amplitudes and slopes ``[V, N, C, 2]``."""

    here: Tensor
    amplitude: Tensor
    slope: Tensor


def _derivatives(kind: Kind, s: Samples, amplitude: Tensor, endmembers: Tensor) -> _Derivatives:
    here, by_amplitude = with_slope(kind, s, amplitude, endmembers)
    by_slope = []
    for axis in (0, 1):
        step = s.normal.new_zeros(s.normal.shape[0], 2)
        step[:, axis] = STEP
        leaning = replace(s, normal=tilted(s.normal, step))
        by_slope.append((predict(kind, leaning, amplitude, endmembers) - here) / STEP)
    return _Derivatives(here, by_amplitude, torch.stack(by_slope, -1))


@torch.no_grad()
def told_apart(
    kind: Kind, s: Samples, amplitude: Tensor, endmembers: Tensor, slopes: bool = True
) -> tuple[Tensor, Tensor]:
    """Unbounded amplitudes ``[N, C]`` and normals ``[N, 3]`` for what the views show, the likeliest together.

    Log amplitudes spread by `TEXTURE` about their material's mean, alike in all bands by `ALIKE`; slopes err by
    `SLOPE_STD`. A cell that no view shows in the sun has its material's mean, and its normal; where nothing of that
    material is in the sun, the mean of what the descent has left there.

    Args:
        kind: reflectance model.
        s: the samples, with the surface's normals.
        amplitude: ``[N, C]`` unbounded, as gradient descent has left them.
        endmembers: ``[K, 3]`` unbounded shape parameters.
        slopes: let the normals move; else only the cells change that no view shows in the sun.
    """
    told = (s.weight > 0).any(0)[:, None]
    mean = material_mean(s.abundances, amplitude, told.to(amplitude).clamp_min(LEAST_COUNT))
    found, normal = torch.where(told, amplitude, mean), s.normal.clone()
    if not slopes or not told.any():
        return found, normal
    cells = torch.nonzero(told[:, 0])[:, 0]
    for part in cells.split(CHUNK):
        found[part], normal[part] = _solve(kind, s.subset(part), amplitude[part], mean[part], endmembers)
    return found, normal


def _solve(kind: Kind, s: Samples, amplitude: Tensor, mean: Tensor, endmembers: Tensor) -> tuple[Tensor, Tensor]:
    """`told_apart` of cells that some view shows in the sun, by Gauss-Newton steps."""
    bands = amplitude.shape[1]
    one = torch.eye(bands).to(amplitude)
    precision = torch.linalg.inv((ALIKE + (1 - ALIKE) * one) * TEXTURE**2)
    # of a logarithm of the amplitude per unit of the unbounded form; rounding makes it 0 where a material is all white
    relative = 1 - torch.sigmoid(mean.clamp_max(9))
    precision = relative[:, :, None] * precision * relative[:, None, :]
    seen, counts, astray = _target(s, predict(kind, s, amplitude, endmembers))
    amplitude = torch.where(astray[:, None], mean, amplitude)
    slope = amplitude.new_zeros(amplitude.shape[0], 2)
    for _ in range(ROUNDS):
        now = _derivatives(kind, replace(s, normal=tilted(s.normal, slope)), amplitude, endmembers)
        residual = seen - now.here
        hessian = amplitude.new_zeros(amplitude.shape[0], bands + 2, bands + 2)
        hessian[:, :bands, :bands] = precision + one * (counts * now.amplitude**2).sum(0)[:, :, None]
        cross = torch.einsum("vnc,vnca->nca", counts * now.amplitude, now.slope)
        hessian[:, :bands, bands:], hessian[:, bands:, :bands] = cross, cross.transpose(1, 2)
        tilt = torch.einsum("vnca,vncb->nab", counts[..., None] * now.slope, now.slope)
        hessian[:, bands:, bands:] = tilt + torch.eye(2).to(tilt) / SLOPE_STD**2
        pull = torch.einsum("ncd,nd->nc", precision, mean - amplitude)
        down = torch.einsum("vnc,vnca->na", counts * residual, now.slope) - slope / SLOPE_STD**2
        gradient = torch.cat([(counts * now.amplitude * residual).sum(0) + pull, down], -1)
        step = torch.linalg.solve(hessian, gradient)
        amplitude = (amplitude + step[:, :bands].clamp(-1.5, 1.5)).clamp(-9, 9)
        slope = (slope + step[:, bands:].clamp(-0.2, 0.2)).clamp(-STEEPEST, STEEPEST)
    return amplitude, tilted(s.normal, slope)


def _target(s: Samples, here: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """What is to be explained, its weight ``[V, N, C]``, and ``[N]`` where the fit's own view ``here`` is off.

    That is the fit's own view of a cell, unless the views agree to something else; a view that differs from the others
    counts less.
    """
    sigma, weight = noise_of(s), s.weight[..., None]
    count = weight.sum(0).clamp_min(1e-3)
    residual = (s.seen - here) / sigma
    common = (weight * residual).sum(0) / count
    alike = common.square().mean(-1).clamp_min(1e-6)
    unlike = ((weight * (residual - common).square()).sum(0) / count).mean(-1)
    # steeply: a common residual within the noise is the images' blur, which the descent has undone
    believed = 1 / (1 + ((MISFIT**2 + unlike) / alike) ** 2)
    misfit = ((weight * residual**2).sum(0) / count).mean(-1, keepdim=True).clamp(0.25, 25)
    counts = weight / (sigma**2 * misfit * (1 + ((residual - common) / ROBUST) ** 2))
    return here + believed[:, None] * (s.seen - here), counts, believed > 0.5


__all__ = ["TEXTURE", "tilted", "told_apart"]
