"""The trainable surface scene: height and albedo on the ground grid, colour per image."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor

if TYPE_CHECKING:
    from sattools.views import View


@dataclass
class SurfaceScene:
    """Everything the fit learns.

    The radiance of a cell towards image j is gain_j * (l * albedo) + offset_j with irradiance l = v + (1 - v) *
    ambient_j and sun visibility v (the EO-NeRF form, with the whole light of a sunlit cell as unit).

    Attributes:
        height: ``[H, W]`` ellipsoidal height [m].
        albedo: ``[H, W, C]``.
        gain, offset: ``[V, C]``; the first view's are 1 and 0.
        ambient: ``[V, C]`` share of the light that reaches a shaded cell.
        pose: ``[V, 2]`` (east, north) shift of each view's rays [m]; not trained by gradient.
        absolute: the images are reflectances, so that gain and offset stay as they are.
        held: colours and poses stay as they are: other tiles have the same.
    """

    height: Tensor
    albedo: Tensor
    gain: Tensor
    offset: Tensor
    ambient: Tensor
    pose: Tensor
    absolute: bool = False
    held: bool = field(default=False, init=False)

    def colour(self, index: int, visibility: Tensor | None) -> Tensor:
        """Radiance ``[H, W, C]`` of every cell towards image ``index``; visibility ``[H, W]`` or None = all lit."""
        light = self.albedo
        if visibility is not None:
            v = visibility[..., None]
            light = light * (v + (1 - v) * self.ambient[index])
        return self.gain[index] * light + self.offset[index]

    def trainable(self) -> dict[str, Tensor]:
        """Tensors that gradient descent changes: heights [m], albedo, colours."""
        leaves = {"height": self.height, "albedo": self.albedo}
        if self.held:
            return leaves
        leaves["ambient"] = self.ambient
        return leaves if self.absolute else {**leaves, "gain": self.gain, "offset": self.offset}

    def tensors(self) -> dict[str, Tensor]:
        """All tensors, for saving: heights [m], albedo, colours, poses [m]."""
        names = ("height", "albedo", "gain", "offset", "ambient", "pose")
        return {name: getattr(self, name) for name in names}

    def casting(self) -> Tensor:
        """Heights ``[H, W]`` [m] that cast the shadows."""
        return self.height

    def penalty(self) -> Tensor | float:
        """What the loss holds against the scene's materials, beside the images; unitless."""
        return 0.0

    def refresh(self, views: Sequence[View], visibility: Sequence[Tensor | None]) -> None:
        """Bring up to date what is not trained by gradient; called every few epochs.

        Args:
            views: the views.
            visibility: per view, ``[H, W]`` in [0, 1], or None = all lit.
        """

    def to(self, device: torch.device) -> SurfaceScene:
        """The scene on a device."""
        moved: dict[str, Any] = {name: tensor.to(device) for name, tensor in self.tensors().items()}
        moved_scene = replace(self, **moved)
        moved_scene.held = self.held
        return moved_scene

    def resized(self, shape: tuple[int, int], extent: tuple[float, float]) -> SurfaceScene:
        """The scene on another grid with the same upper left corner.

        Args:
            shape: new (rows, columns).
            extent: new cell size over old, per (row, column) axis.
        """
        maps = torch.cat([self.height[None], self.albedo.permute(2, 0, 1)])[None].detach()
        rows, cols = shape
        old_rows, old_cols = self.height.shape
        y = ((torch.arange(rows) + 0.5) * extent[0]) / old_rows * 2 - 1
        x = ((torch.arange(cols) + 0.5) * extent[1]) / old_cols * 2 - 1
        where = torch.stack([x.expand(rows, cols), y[:, None].expand(rows, cols)], dim=-1)[None].to(maps)
        finer = torch.nn.functional.grid_sample(maps, where, padding_mode="border", align_corners=False)[0]
        resampled = SurfaceScene(
            finer[0].contiguous(),
            finer[1:].permute(1, 2, 0).contiguous(),
            self.gain.detach().clone(),
            self.offset.detach().clone(),
            self.ambient.detach().clone(),
            self.pose.clone(),
            self.absolute,
        )
        resampled.held = self.held
        return resampled


def start_scene(
    height: Tensor, albedo: Tensor, gain: Tensor, offset: Tensor, ambient: float, absolute: bool = False
) -> SurfaceScene:
    """A first surface ``[H, W]`` with an albedo ``[H, W, C]`` and the images' colour relations ``[V, C]``.

    Args:
        height: ``[H, W]`` [m].
        albedo: ``[H, W, C]``.
        gain: ``[V, C]``.
        offset: ``[V, C]`` radiance.
        ambient: share of the light that reaches shade.
        absolute: whether the images are reflectances.
    """
    return SurfaceScene(
        height.clone(),
        albedo.clone(),
        gain.clone(),
        offset.clone(),
        torch.full_like(gain, ambient),
        torch.zeros(gain.shape[0], 2),
        absolute,
    )


__all__ = ["SurfaceScene", "start_scene"]
