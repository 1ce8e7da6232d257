"""Reflectance of a surface: parameter maps, and the light that every cell sends towards a view.

A model's amplitude (Hapke's w, Rahman's rho0) is a map per band; its three shape parameters belong to few endmembers of
which every cell holds fixed abundances. All are trained in an unbounded form and come out within their ranges by smooth
maps.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import torch
from torch import Tensor

from sattools.reflectance import hapke, rpv
from sattools.reflectance.hapke_bands import hapke_light

Kind = Literal["rpv", "hapke"]


@dataclass(frozen=True)
class Parameter:
    """Name and range of a parameter, with the mean of its prior and its standard deviation in the unbounded form."""

    name: str
    low: float
    high: float
    prior_mean: float
    prior_sigma: float = 1.0

    def bounded(self, raw: Tensor) -> Tensor:
        """Value within the range, in the parameter's unit, of an unbounded one."""
        return self.low + (self.high - self.low) * torch.sigmoid(raw)

    def raw(self, value: Tensor) -> Tensor:
        """Inverse of `bounded`, unbounded; values at or beyond the range come just inside."""
        share = ((value - self.low) / (self.high - self.low)).clamp(1e-4, 1 - 1e-4)
        return torch.log(share / (1 - share))

    def slope(self, raw: Tensor) -> Tensor:
        """Derivative of `bounded` by the unbounded value."""
        s = torch.sigmoid(raw)
        return (self.high - self.low) * s * (1 - s)


AMPLITUDE: dict[Kind, Parameter] = {
    "rpv": Parameter("rho0", 0.0, 1.0, 0.2),
    "hapke": Parameter("w", 0.0, 0.98, 0.4),
}
SHAPE: dict[Kind, tuple[Parameter, Parameter, Parameter]] = {
    "rpv": (
        Parameter("k", 0.3, 1.7, 0.85),
        Parameter("asymmetry", -0.6, 0.6, -0.1),
        Parameter("rhoc", 0.0, 1.0, 0.8),
    ),
    "hapke": (
        Parameter("b", 0.0, 0.9, 0.3, 0.4),
        Parameter("c", 0.0, 1.0, 0.5, 0.4),
        Parameter("theta", 0.2, 50.0, 20.0, 1.0),
    ),
}
"""Prior means are typical values of rocks and soils; sigmas are in the unbounded form."""


def radiance_factor(
    kind: Kind,
    normal: Tensor,
    sun: Tensor,
    view: Tensor,
    amplitude: Tensor,
    shape: tuple[Tensor, Tensor, Tensor],
    *,
    plain: Tensor | None = None,
) -> Tensor:
    """BRF * cos i = pi L / E ``[..., C]``, E the sun's irradiance across its beam.

    Hapke's model on processors is a kernel that works out once what bands share.

    Args:
        kind: model.
        normal: ``[..., 3]`` unit vectors.
        sun: ``[3]`` unit vectors.
        view: ``[3]`` unit vectors.
        amplitude: ``[..., C]``.
        shape: three ``[...]``.
        plain: share ``[...]`` of the ground that reflects as Lambert's law has it, `diffuse` to all sides; None = none.
    """
    if kind == "hapke" and normal.device.type == "cpu":
        light = hapke_light(normal, sun, view, amplitude, shape)
    else:
        facet = normal[..., None, :]
        parts = [p[..., None] for p in shape]
        model = hapke if kind == "hapke" else rpv
        light = model(facet, sun, view, amplitude, *parts) * (normal @ sun).clamp_min(0)[..., None]
    if plain is None:
        return light
    return light + plain[..., None] * (diffuse(kind, amplitude) * (normal @ sun).clamp_min(0)[..., None] - light)


def diffuse(kind: Kind, amplitude: Tensor) -> Tensor:
    """Share of light from all sides that leaves again: Hapke's diffusive reflectance r0, or rho0 itself."""
    if kind == "rpv":
        return amplitude
    root = torch.sqrt(1 - amplitude)
    return (1 - root) / (1 + root)


__all__ = [
    "AMPLITUDE",
    "SHAPE",
    "Kind",
    "Parameter",
    "diffuse",
    "radiance_factor",
]
