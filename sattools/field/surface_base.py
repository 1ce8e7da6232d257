"""What a network starts from: a surface with colours, to which it learns what is different."""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from torch import Tensor
from torch.nn.functional import grid_sample

from sattools.field.constants import constant
from sattools.field.protocol import Box

LEAST_OPTICAL = 1e-4  # of the network's unit of density, far above the surface
COLOUR_LIMITS = (0.02, 0.98)  # of a head's range, where a sigmoid still has a gradient


SUN_SHARPNESS = 300.0  # suns 5 degrees apart are told from each other, 1 degree apart are the same


@dataclass(frozen=True)
class KnownLight:
    """How a surface is lit under the suns of the images, as what is added to a network's answers.

    Attributes:
        suns: ``[K, 3]`` unit vectors.
        ambient: ``[K, C]`` light in shade, as a share of the light in the sun.
        visible: ``[K, H, W]`` visibility of the sun in [0, 1] on the surface's grid; None where it is not learned.
    """

    suns: Tensor
    ambient: Tensor
    visible: Tensor | None = None

    def to(self, device: torch.device) -> KnownLight:
        """The same on a device."""
        visible = None if self.visible is None else self.visible.to(device)
        return KnownLight(self.suns.to(device), self.ambient.to(device), visible)

    def shares(self, sun: Tensor) -> Tensor:
        """Parts ``[N, K]`` that the known suns have in what is known of suns ``[N, 3]``: the nearest, by its cosine."""
        return torch.softmax(SUN_SHARPNESS * sun @ self.suns.T, dim=-1)


@dataclass(frozen=True)
class SurfaceBase:
    """Density and colour of a surface, as what is added to a network's answers before their activations.

    The density is sigmoid((h - z) / s) / s per metre of height, as the surface field has it: a vertical ray's
    transmittance crosses one half at z = h whatever s is.

    Attributes:
        box: the part of space.
        height: ``[H, W]`` [m], on a grid that spans the box; row 0 in the north.
        colour: ``[H, W, C]`` in [0, 1].
        softness: s [m].
        shape: ``[H, W, P]`` shape parameters of a reflectance model, in the order of the network's heads, or none.
        light: how it is lit, or None where a network has to learn that by itself.
    """

    box: Box
    height: Tensor
    colour: Tensor
    softness: float
    shape: Tensor | None = None
    light: KnownLight | None = None

    def to(self, device: torch.device) -> SurfaceBase:
        """The same on a device."""
        shape = None if self.shape is None else self.shape.to(device)
        light = None if self.light is None else self.light.to(device)
        return replace(self, height=self.height.to(device), colour=self.colour.to(device), shape=shape, light=light)

    def at(self, points: Tensor) -> tuple[Tensor, Tensor]:
        """Density ``[N]`` per metre, colour, shape parameters and visibilities ``[N, C + P + K]`` at ``[N, 3]`` [m]."""
        maps = [self.height[..., None], self.colour] + ([] if self.shape is None else [self.shape])
        if self.light is not None and self.light.visible is not None:
            maps.append(self.light.visible.permute(1, 2, 0))
        height, *colour = self._read(torch.cat(maps, dim=-1), points)
        return self._density(height, points), torch.stack(colour, dim=-1)

    def density(self, points: Tensor) -> Tensor:
        """Density ``[N]`` per metre at points ``[N, 3]`` [m]."""
        return self._density(self.heights(points), points)

    def _density(self, height: Tensor, points: Tensor) -> Tensor:
        return torch.sigmoid((height - points[:, 2]) / self.softness) / self.softness

    def heights(self, points: Tensor) -> Tensor:
        """Heights ``[N]`` of the surface over or under points ``[N, 3]`` [m]."""
        return self._read(self.height[..., None], points)[0]

    def _read(self, maps: Tensor, points: Tensor) -> Tensor:
        where = self.box.scaled(points)[:, :2] * constant((1.0, -1.0), points)  # rows run south
        # cells are areas: the box ends at their outer edges
        read = grid_sample(maps.permute(2, 0, 1)[None], where[None, None], padding_mode="border", align_corners=False)
        return read[0, :, 0]

    def tensors(self) -> dict[str, Tensor]:
        """What `restored` needs beside the box: heights and softness [m], colours, shape parameters, light."""
        found = {"height": self.height, "colour": self.colour, "softness": self.height.new_tensor(self.softness)}
        more = {"shape": self.shape}
        if self.light is not None:
            more |= {"suns": self.light.suns, "ambient": self.light.ambient, "visible": self.light.visible}
        return found | {name: tensor for name, tensor in more.items() if tensor is not None}

    @classmethod
    def restored(cls, tensors: dict[str, Tensor], box: Box) -> SurfaceBase:
        """Inverse of `tensors`: heights and softness [m], colours."""
        light = None
        if "suns" in tensors:
            light = KnownLight(tensors["suns"], tensors["ambient"], tensors.get("visible"))
        return cls(box, tensors["height"], tensors["colour"], float(tensors["softness"]), tensors.get("shape"), light)


def before_softplus(density: Tensor) -> Tensor:
    """The x with softplus(x) = density (at least `LEAST_OPTICAL`), any shape, unitless."""
    density = density.clamp_min(LEAST_OPTICAL)
    return density + torch.log(-torch.expm1(-density))


def before_sigmoid(value: Tensor, low: float, high: float) -> Tensor:
    """The x with low + (high - low) sigmoid(x) = value, within `COLOUR_LIMITS`, any shape, unitless.

    Args:
        value: any shape, in the head's unit.
        low: end of the head's range.
        high: end of the head's range.
    """
    return torch.logit(((value - low) / (high - low)).clamp(*COLOUR_LIMITS))


__all__ = ["KnownLight", "SurfaceBase", "before_sigmoid", "before_softplus"]
