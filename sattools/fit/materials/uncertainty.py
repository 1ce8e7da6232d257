"""Standard deviations of the reflectance parameters."""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor

from sattools.fit.materials.inversion import Samples, Solution, noise_of, predict, with_slopes
from sattools.fit.materials.parameters import AMPLITUDE, SHAPE, Kind

SLOPE_STD = 0.06  # of the surface's slopes, metres per metre: about 3.5 degrees
TEXTURE_STD = 0.04  # of the amplitude: texture finer than the surface's own error in place is smeared
# errors of the geometry are alike in neighbouring cells, which the curvature takes for independent; one factor per
# shape parameter. Of theta it was set on simulated scenes of 15 to 40 degrees, where smooth ground comes out too rough;
# b and c of laboratory samples spread more than the simulated materials, and than the priors that hold the fit
MEMBER_FACTOR: dict[Kind, tuple[float, float, float]] = {"rpv": (1.8, 1.8, 1.8), "hapke": (2.5, 2.5, 2.0)}


@torch.no_grad()
def parameter_std(kind: Kind, s: Samples, amplitude: Tensor, solution: Solution) -> dict[str, Tensor]:
    """Standard deviations of the amplitude ``[N, C]`` and of the three shape parameters ``[N]``, by name.

    From the Gauss-Newton curvature of `invert`: all cells of one material, whose slopes differ, constrain its shape
    together. A cell's amplitude has the noise of its own views, the share of the shape's error that it takes up, the
    error of its slope (`SLOPE_STD`), which all views under one sun share, and that of its texture's place
    (`TEXTURE_STD`). Materials that were told apart wrongly are not in it.

    Args:
        kind: reflectance model.
        s: the samples.
        amplitude: ``[N, C]`` unbounded.
        solution: of the inversion.
    """
    endmembers = solution.endmembers
    sigma = noise_of(s)
    here, slopes = with_slopes(kind, s, amplitude, endmembers)
    residual = (s.seen - here) / sigma
    j_amplitude = slopes[..., 0] / sigma
    weight = s.weight[..., None]
    a = (weight * j_amplitude**2).sum(0) + 1e-3

    def answer(change: Tensor) -> Tensor:
        """How the amplitudes follow when the prediction changes."""
        return -(weight * j_amplitude * change / sigma).sum(0) / a

    seen = weight.sum(0).clamp_min(1)
    misfit = ((weight * residual**2).sum(0) / seen).mean(-1, keepdim=True).clamp(0.25, 25)
    variance = misfit / a
    for axis in (0, 1):
        normal = s.normal.clone()
        normal[:, axis] += SLOPE_STD * normal[:, 2]
        normal = normal / normal.norm(dim=-1, keepdim=True)
        variance = variance + answer(predict(kind, replace(s, normal=normal), amplitude, endmembers) - here) ** 2
    factor = endmembers.new_tensor(MEMBER_FACTOR[kind]).repeat(endmembers.shape[0])
    covariance = solution.covariance.to(endmembers) * factor * factor[:, None]
    blocks = covariance.reshape(endmembers.shape[0], 3, endmembers.shape[0], 3)
    shares = s.shape_shares
    own = torch.einsum("nk,kplq,nl->npq", shares, blocks, shares)  # [N, 3, 3]
    j = torch.stack([answer(slopes[..., 1 + p]) for p in range(3)], -1)  # [N, C, 3]
    variance = variance + torch.einsum("ncp,npq,ncq->nc", j, own, j)
    value, slope = AMPLITUDE[kind].bounded(amplitude), AMPLITUDE[kind].slope(amplitude)
    variance = variance + (TEXTURE_STD * value / slope) ** 2
    # beyond one unit of the unbounded form the range itself is the limit
    result = {AMPLITUDE[kind].name: variance.sqrt().clamp_max(1.5) * slope}
    for p, parameter in enumerate(SHAPE[kind]):
        std = own[:, p, p].sqrt().clamp_max(1.5)
        result[parameter.name] = std * parameter.slope(shares @ endmembers[:, p])
    return result


@torch.no_grad()
def known_share(kind: Kind, solution: Solution) -> Tensor:
    """Share ``[K, 3]`` of each shape parameter's prior variance that the images took away: 0 = its prior, 1 = known.

    Args:
        kind: reflectance model.
        solution: of the inversion.
    """
    count = solution.endmembers.shape[0]
    prior = solution.covariance.new_tensor([p.prior_sigma**2 for p in SHAPE[kind]])
    return (1 - solution.covariance.diagonal().reshape(count, 3) / prior).clamp(0, 1)


@torch.no_grad()
def shape_correlation(solution: Solution, plain: Tensor | None = None) -> float:
    """Correlation of the errors of the first two shape parameters (b and c, k and Theta), median over the endmembers.

    Args:
        solution: of the inversion.
        plain: ``[K]`` 1 = the endmember has no shape and does not count; or None.
    """
    count = solution.endmembers.shape[0]
    blocks = solution.covariance.reshape(count, 3, count, 3)
    own = torch.stack([blocks[k, :, k] for k in range(count) if plain is None or not plain[k]])
    return float((own[:, 0, 1] / (own[:, 0, 0] * own[:, 1, 1]).sqrt()).median())


__all__ = ["SLOPE_STD", "known_share", "parameter_std", "shape_correlation"]
