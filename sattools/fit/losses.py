"""Photometric losses of linear radiance (Mildenhall et al. 2022, RawNeRF; the HDR satellite NeRF's four variants)."""

from __future__ import annotations

import torch
from torch import Tensor

GAMMA = 2.2
# Predictions below this radiance get the weight they would have here: it bounds raw-log's weight by 1/(1e-3)^2 = 1e6
# and raw-gamma's by (1e-3^(1/2.2 - 1) / 2.2)^2 = 387, also where an image's offset makes a prediction zero or negative.
FLOOR = 1e-3
LOG_EPSILON = 1e-6
UNIT = 0.1  # of the losses: tone-mapped units from which a residual counts less, if nothing else is asked for
CALIBRATED_SHARE = 0.1  # of that, for calibrated images
RADIANCES = ("mse", "raw-log")  # losses whose residuals are not tone-mapped
ENOUGH = 1_000_000  # numbers that tell a median


def tone(x: Tensor) -> Tensor:
    """The gamma curve x^(1/2.2) of a radiance, below `FLOOR` a straight line, so that its slope stays finite."""
    slope = FLOOR ** (1 / GAMMA - 1) / GAMMA
    curve = x.clamp_min(FLOOR) ** (1 / GAMMA)
    return torch.where(x < FLOOR, FLOOR ** (1 / GAMMA) + (x - FLOOR) * slope, curve)


def raw_weight(name: str, predicted: Tensor) -> Tensor:
    """Squared slope of the tone curve at the prediction, without gradient; 1 for the losses that do not weight."""
    x = predicted.detach().clamp_min(FLOOR)
    if name == "raw-gamma":
        return (x ** (1 / GAMMA - 1) / GAMMA) ** 2
    if name == "raw-log":
        return 1 / (x + LOG_EPSILON) ** 2
    return torch.ones_like(x)


def typical_radiance(numbers: Tensor) -> float:
    """Median of the radiances of images, any shape, by a million of them; 1 where there are none."""
    flat = numbers.flatten()
    return float(flat[:: max(1, flat.numel() // ENOUGH)].median()) if flat.numel() else 1.0


def robust_scale(name: str, robust: float, typical: float, *, unit: float = UNIT) -> float:
    """A residual of ``robust`` tone-mapped units at the radiance ``typical``, in the units of a loss's residual.

    So every loss weighs a pixel of typical brightness the same against the other terms of the fit; they differ in what
    darker and brighter pixels count. ``robust`` = 0 (no residual counts less) keeps the usual unit.

    Args:
        name: of the loss.
        robust: residual in tone-mapped units.
        typical: median radiance of the images.
        unit: usual residual in tone-mapped units.
    """
    robust = robust or unit
    x = max(typical, FLOOR)
    slope = x ** (1 / GAMMA - 1) / GAMMA  # tone-mapped units per radiance
    return {"mse": robust / slope, "raw-log": robust / slope / (x + LOG_EPSILON)}.get(name, robust)


def photometric(name: str, predicted: Tensor, target: Tensor, robust: float = 0.0) -> Tensor:
    """Loss per pixel and band.

    Args:
        name: ``mse``: (p - y)^2; ``mse-gamma``: (psi(p) - psi(y))^2; ``raw-gamma``, ``raw-log``: psi'(sg p)^2 (p - y)^2
            with psi(x) = x^(1/2.2) or log(x + 1e-6).
        predicted: linear radiance, any shape.
        target: linear radiance.
        robust: scale k of a Geman-McClure weight (k^2 / (k^2 + r^2))^2 in the loss's own units of r; 0 = none. The
            weight has no gradient.

    Returns:
        The loss in the shape of the inputs.
    """
    if name == "mse-gamma":
        squared = (tone(predicted) - tone(target)) ** 2
    elif name in ("mse", "raw-gamma", "raw-log"):
        squared = raw_weight(name, predicted) * (predicted - target) ** 2
    else:
        raise ValueError(f"loss {name!r}: expected mse, mse-gamma, raw-gamma or raw-log")
    if robust > 0:
        weight = (robust**2 / (robust**2 + squared.detach())) ** 2
        return weight * squared
    return squared


__all__ = [
    "CALIBRATED_SHARE", "FLOOR", "GAMMA", "RADIANCES", "UNIT", "photometric", "raw_weight", "robust_scale", "tone",
    "typical_radiance",
]  # fmt: skip
