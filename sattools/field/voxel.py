"""A density grid for trees and overhangs, held to look like a surface where the images do not say otherwise."""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn.functional import grid_sample, relu

from sattools.field.constants import constant
from sattools.field.protocol import Box

START_SOFTNESS_M = 2.0
SMOOTH, MONOTONE = 0.02, 0.05


class VoxelField:
    """Density sigmoid(g) / softness with logits g on a grid, albedo on the same grid.

    The logits start as those of a surface, (h - z) / s, and the field is charged for two things that a free density
    grid falls into: differences between neighbours, and density that grows upwards (fog above the ground). Both are
    absolute values, so that a wall, a crown or a bridge costs only its own rim.

    Args:
        box: the part of space.
        shape: (planes, rows, columns).
        surface: ``[rows, columns]`` first heights [m].
        colour: ``[rows, columns, C]`` first albedo.
    """

    heads = frozenset({"albedo"})

    def __init__(self, box: Box, shape: tuple[int, int, int], surface: Tensor, colour: Tensor) -> None:
        self.box = box
        planes = shape[0]
        # align_corners=True: the first and the last plane lie on the box
        z = torch.linspace(box.low[2], box.high[2], planes, device=surface.device)[:, None, None]
        self.step_m = (box.high[2] - box.low[2]) / (planes - 1)
        self.softness = max(START_SOFTNESS_M, self.step_m)
        self.logits = ((surface[None] - z) / self.softness).clamp(-6, 6).contiguous()
        self.albedo = torch.logit(colour.clamp(0.01, 0.99)).permute(2, 0, 1)[:, None].repeat(1, planes, 1, 1)

    def density(self, points: Tensor) -> tuple[Tensor, Tensor]:
        """See `Field.density`; the features are the points themselves [m]."""
        logit = self._read(self.logits[None], points)[:, 0]
        return torch.sigmoid(logit) / self.softness, points

    def shown(self, features: Tensor, transmittance: Tensor) -> Tensor:
        """See `Field.shown`: all of them, whatever the share in [0, 1]."""
        return features

    def look(self, features: Tensor, sun: Tensor | None, embedding: Tensor | None) -> dict[str, Tensor]:
        """See `Field.look`: colours."""
        return {"albedo": torch.sigmoid(self._read(self.albedo, features))}

    def _read(self, grid: Tensor, points: Tensor) -> Tensor:
        """Trilinear values ``[N, C]`` of ``[C, D, H, W]``; rows run south."""
        where = self.box.scaled(points) * constant((1.0, -1.0, 1.0), points)
        read = grid_sample(grid[None], where[None, None, None], padding_mode="border", align_corners=True)
        return read[0, :, 0, 0].T

    def penalty(self) -> Tensor:
        """Steps between cells and fog upwards, unitless."""
        across = self.logits.diff(dim=1).abs().mean() + self.logits.diff(dim=2).abs().mean()
        return SMOOTH * across + MONOTONE * relu(self.logits.diff(dim=0)).mean()

    def start_density(self) -> dict[str, Tensor]:
        """None: it starts far from a surface."""
        return {}

    def named_tensors(self) -> dict[str, Tensor]:
        """Logits and albedo."""
        return {"logits": self.logits, "albedo": self.albedo}


__all__ = ["VoxelField"]
