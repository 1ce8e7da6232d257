"""What a field must answer: what is at a point, and how it looks."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

from torch import Tensor

from sattools.field.constants import constant


@dataclass(frozen=True)
class Box:
    """The part of space that a field describes; its coordinates are scaled to [-1, 1].

    Attributes:
        low, high: (east, north, height) corners [m], east and north relative to the grid's upper left corner.
    """

    low: tuple[float, float, float]
    high: tuple[float, float, float]

    def scaled(self, points: Tensor) -> Tensor:
        """Points ``[..., 3]`` in metres -> [-1, 1]."""
        low, high = constant(self.low, points), constant(self.high, points)
        return (points - low) / (high - low) * 2 - 1


class Field(Protocol):
    """A volume with density and colour; everything differentiable.

    Attributes:
        heads: names that `look` answers: always ``albedo``; perhaps ``sun`` (learned visibility of the sun),
            ``sky`` or ``ambient`` (light of shaded points), ``tau`` (transient darkening), ``beta`` (uncertainty),
            and parameters of a reflectance model (``w``, ``b``, ``c``, ``theta`` or ``rho0``, ``k``, ``theta``,
            ``rhoc``).
    """

    heads: frozenset[str]

    def density(self, points: Tensor) -> tuple[Tensor, Tensor]:
        """Density ``[N]`` per metre and features ``[N, F]`` at points ``[N, 3]`` in metres (see `Box`)."""
        ...

    def look(self, features: Tensor, sun: Tensor | None, embedding: Tensor | None) -> dict[str, Tensor]:
        """Every head's answer ``[N, outputs]``.

        Heads that need a missing sun ``[N, 3]`` or image embedding ``[N, 4]`` are left out.

        Args:
            features: ``[N, F]`` of the points.
            sun: ``[N, 3]`` unit vectors, or None.
            embedding: ``[N, E]`` of the images, or None.
        """
        ...

    def shown(self, features: Tensor, transmittance: Tensor) -> Tensor:
        """Features ``[N, F]`` for `look`, perhaps without those that a small transmittance ``[N]`` in [0, 1] hides."""
        ...

    def penalty(self) -> Tensor | float:
        """What the loss holds against the field itself, in its unitless terms."""
        ...

    def start_density(self) -> dict[str, Tensor]:
        """What its tensors, by name, are where its density is that of the surface it starts from; none without one."""
        ...

    def named_tensors(self) -> dict[str, Tensor]:
        """Trainable tensors by name, in the field's own units or unbounded."""
        ...


__all__ = ["Box", "Field"]
