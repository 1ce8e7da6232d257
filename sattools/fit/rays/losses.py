"""Losses of rays beside the photometric one: uncertainty, depths, learned visibility of the sun."""

from __future__ import annotations

import torch
from torch import Tensor

BETA_MIN = 0.05  # Sat-NeRF: beta = softplus + 0.05


def beta_loss(squared: Tensor, beta: Tensor) -> Tensor:
    """mean[squared / (2 beta^2)] + mean[3 + log beta] / 2 (Sat-NeRF, eq. 7; Martin-Brualla et al. 2021).

    Args:
        squared: ``[R, C]`` squared residuals.
        beta: ``[R, 1]`` uncertainty, at least 0.05, so that 3 + log beta is positive.
    """
    return (squared / (2 * beta**2)).mean() + (3 + torch.log(beta)).mean() / 2


def solar_correction(weights: Tensor, transmittance: Tensor, s: Tensor) -> Tensor:
    """Mean over rays of sum_i (T_i - s_i)^2 + 1 - sum_i w_i s_i, all ``[R, S]`` (S-NeRF and Sat-NeRF).

    Args:
        weights: ``[R, S]`` of the samples, sum at most 1.
        transmittance: ``[R, S]`` along the sun's rays, in [0, 1].
        s: ``[R, S]`` learned sun visibility, in [0, 1].
    """
    return ((transmittance - s) ** 2).sum(dim=1).mean() + (1 - (weights * s).sum(dim=1)).mean()


def depth_loss(weights: Tensor, t: Tensor, depth: Tensor, prior: Tensor, confidence: Tensor, std: Tensor) -> Tensor:
    """Confidence-weighted squared depth error where it matters (SparseSat-NeRF, section 3.3; Hapke-NeRF).

    It matters where the ray disagrees with the prior by more than the prior's standard deviation, or where its own
    spread is larger. Depths as shares of the path, of which the papers' unit is half.

    Args:
        weights: ``[R, S]`` of the samples, sum at most 1.
        t: ``[R, S]`` shares of the path.
        depth: ``[R]`` composited share of the path.
        prior: ``[R]`` the prior's share of the path.
        confidence: ``[R]`` in [0, 1].
        std: ``[R]`` expected spread, as share of the path.
    """
    spread = ((weights * (t - depth[:, None]) ** 2).sum(dim=1)).clamp_min(0).sqrt()
    matters = ((depth - prior).abs() > std) | (spread > std)
    return (confidence * (2 * (depth - prior)) ** 2 * matters).mean()


__all__ = ["BETA_MIN", "beta_loss", "depth_loss", "solar_correction"]
