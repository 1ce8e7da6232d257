"""A fitted model: what `fit` hands to `export`, with one schema for memory and file."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from sattools.fit.checkpoint import KNOWN_NEEDS, NEEDS, load, save
from sattools.fit.described import (
    CELL_MAPS,
    COLOURS,
    IMAGE_MAPS,
    PER_IMAGE,
    Description,
    check_height_limits,
    check_maps,
    members,
)
from sattools.fit.materials.scene import restored
from sattools.fit.resume import IlluminationOptions
from sattools.fit.surface.scene import SurfaceScene
from sattools.scene.jsonio import JsonObject


@dataclass(frozen=True, kw_only=True)
class FittedModel(Description):
    """A fitted scene: the surface and its colours, and how the images show them.

    Attributes:
        height: ``[H, W]`` ellipsoidal heights [m].
        height_std: ``[H, W]`` their standard deviation [m].
        albedo: ``[H, W, C]``; with a reflectance model its BRF at standard geometry.
        gain, offset, ambient: ``[V, C]`` colours of the images, see `SurfaceScene`.
        pose: ``[V, 2]`` (east, north) shift of each view's rays [m].
        s_net: ``[V, H, W]`` learned sun visibility, or None.
        tau: ``[V, H, W]`` transmission of transient objects, or None.
        beta: ``[V, H, W]`` learned uncertainty of the image's radiance, in its unit, or None.
        extra: tensors of the reflectance model (see `ReflectiveScene`) and ``NAME_std`` of its parameters, or the
            field's own.
    """

    height: Tensor
    height_std: Tensor
    albedo: Tensor
    gain: Tensor
    offset: Tensor
    ambient: Tensor
    pose: Tensor
    s_net: Tensor | None = None
    tau: Tensor | None = None
    beta: Tensor | None = None
    extra: Mapping[str, Tensor] = dataclasses.field(default_factory=dict)

    @property
    def illumination(self) -> IlluminationOptions:
        """How the light was modelled."""
        return IlluminationOptions(self.shadow, self.transient)

    def to(self, device: torch.device) -> FittedModel:
        """The same with all tensors on a device."""
        tensors = {f.name: getattr(self, f.name) for f in fields(self)}
        moved: dict[str, Any] = {n: t.detach().to(device) for n, t in tensors.items() if isinstance(t, Tensor)}
        return dataclasses.replace(self, **moved, extra={n: t.detach().to(device) for n, t in self.extra.items()})

    def image_maps(self) -> dict[str, Tensor]:
        """Maps ``[V, H, W]`` of every image that the model has, by name: shares of light in [0, 1], and beta."""
        return {name: getattr(self, name) for name in IMAGE_MAPS if getattr(self, name) is not None}

    def surface(self) -> SurfaceScene:
        """The scene that was fitted, with its reflectance model if it has one.

        Raises:
            KeyError, TypeError, RuntimeError: the model lacks what its kind needs.
        """
        maps = {name: getattr(self, name) for name in ("height", "albedo", *COLOURS)}
        if self.brdf == "lambert" or self.field != "surface":  # a field has its own way to be shown
            return SurfaceScene(**maps, absolute=self.absolute)
        return restored({**self.extra, **maps}, self.brdf, self.grid.cell_size, 0.0, self.absolute)

    def save(self, path: Path) -> None:
        """Write the model's file.

        Raises:
            SattoolsError: it cannot be written.
        """
        save(path, *self.parts())

    def parts(self) -> tuple[dict[str, Tensor], JsonObject]:
        """What its file holds: tensors of any unit by name, and the description."""
        own = {name: getattr(self, name) for name in (*CELL_MAPS, *PER_IMAGE)}
        needs = [name for name in KNOWN_NEEDS if name in self.extra]
        described = self.to_dict() | ({NEEDS: needs} if needs else {})
        return {**self.extra, **{n: t for n, t in own.items() if t is not None}}, described

    @classmethod
    def load(cls, path: Path) -> FittedModel:
        """Read what `save` wrote, in this or in an older version.

        Raises:
            InputError: one line, naming the file: missing, damaged, or tensors and description that contradict each
                other or hold what no surface has.
        """
        model = cls.of(*load(path), path)
        _check_heights(path, model.height)
        return model

    @classmethod
    def of(cls, tensors: dict[str, Tensor], description: Mapping[str, Any], path: Path) -> FittedModel:
        """The model of a file's tensors, of any unit, and its description; raises as `load` does, but for heights."""
        known = members(description, path)
        check_maps(tensors, path)
        known |= {name: tensors.pop(name) for name in (*CELL_MAPS, *PER_IMAGE) if name in tensors}
        for name, value in _neutral(len(known["items"]), known["albedo"]).items():
            known.setdefault(name, value)
        model = cls(**known, extra=tensors)
        own = {name: getattr(model, name) for name in (*CELL_MAPS, *PER_IMAGE)}
        model.check_shapes({name: tuple(tensor.shape) for name, tensor in own.items() if tensor is not None}, path)
        return model


def _neutral(views: int, albedo: Tensor) -> dict[str, Tensor]:
    """Colours ``[V, C]`` and poses ``[V, 2]`` [m] of images that show the albedo as it is, for files without any."""
    none = albedo.new_zeros(views, albedo.shape[-1] if albedo.dim() else 1)
    return {"gain": none + 1, "offset": none, "ambient": none, "pose": albedo.new_zeros(views, 2)}


def _check_heights(path: Path, height: Tensor) -> None:
    known = height[height.isfinite()] if height.is_floating_point() else height[:0]
    check_height_limits(path, *((float(known.min()), float(known.max())) if known.numel() else (1.0, 0.0)))


__all__ = ["FittedModel"]
