"""Pixels as rays."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor

from sattools.fit.depth_prior import depth_std_m
from sattools.render.volume import RayBatch

SUN_SAMPLES = 24
# sun rays begin this much higher than the surface, or its soft upper side (2 % of it) would shade it; along the ray, as
# shadows of surfaces that are lifted are too short
SKIP_M = 2.0


@dataclass
class RaySet:
    """All pixels of all views as rays; millions, so that what a view's rays share is held once.

    Attributes:
        place: ``[P, 2]`` (east, north) where a ray is at the highest height [m].
        target: ``[P, C]`` radiance; view: ``[P]`` int16, number of the view.
        depth: ``[P]`` share of the path at which the prior's surface lies; confidence ``[P]`` in [0, 1], 0 = none.
        normal: ``[P, 3]`` of the prior's surface there; None where no reflectance model asks for it.
        path: ``[V, 3]`` from the highest height to the lowest [m].
        suns: ``[V, 3]`` unit vectors, nan where unknown.
        view_vectors: ``[V, 3]`` unit vectors to the sensor.
        top: highest height [m].
        with_depth: whether any confidence is above 0.
    """

    place: Tensor
    target: Tensor
    view: Tensor
    depth: Tensor
    confidence: Tensor
    normal: Tensor | None
    path: Tensor
    suns: Tensor
    view_vectors: Tensor
    top: float
    with_depth: bool = True

    def batch(self, chosen: Tensor) -> RayBatch:
        """Rays of these numbers ``[R]`` [m]."""
        place = self.place[chosen]
        start = torch.cat([place, torch.full_like(place[:, :1], self.top)], dim=1)
        return RayBatch(start, self.path[self.view[chosen].long()])

    def depth_std(self, chosen: Tensor) -> Tensor:
        """How far off the prior's depth may be ``[R]``, as share of the path."""
        return depth_std_m(self.confidence[chosen]) / -self.path[0, 2]

    def to(self, device: torch.device) -> RaySet:
        """The same on a device."""
        tensors = {f.name: getattr(self, f.name) for f in dataclasses.fields(self)}
        moved: dict[str, Any] = {n: t.to(device) for n, t in tensors.items() if isinstance(t, Tensor)}
        return replace(self, **moved)


__all__ = ["SKIP_M", "SUN_SAMPLES", "RaySet"]
