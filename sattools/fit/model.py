"""A fitted model: what `fit` hands to `export`, with one schema for memory and file."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any, Literal

import torch
from torch import Tensor

from sattools.camera.view_direction import ViewDirection
from sattools.errors import InputError
from sattools.fit.checkpoint import load, save
from sattools.fit.illumination import Radiance
from sattools.fit.materials.scene import restored
from sattools.fit.resume import IlluminationOptions
from sattools.fit.surface.scene import SurfaceScene
from sattools.scene import Grid
from sattools.scene.jsonio import JsonObject
from sattools.scene.members import GRID, HEIGHT_LIMITS_M
from sattools.scene.schema import Items, Maybe, Number, Table, Text

Sun = tuple[float, float, float]
COLOURS = ("gain", "offset", "ambient", "pose")
_MAPS = ("height", "height_std", "albedo")
IMAGE_MAPS = ("s_net", "tau", "beta")
_PER_IMAGE = (*IMAGE_MAPS, *COLOURS)
_DESCRIPTION = Table(
    {
        "grid": GRID,
        "items": Items(Text(), 1),
        "suns": Items(Maybe(Items(Number(-1.001, 1.001), 3, 3)), 1),
        "slopes": Items(Items(Number(-100, 100), 2, 2)),
        "z_ref": Number(*HEIGHT_LIMITS_M),
        "softness": Number(0, 1e6),
        "shadow": Text(("none", "geometric", "learned", "auto")),
        "transient": Text(("on", "off", "auto")),
        "radiance": Text(("toa_reflectance", "reflectance_factor", "relative")),
        "brdf": Text(("lambert", "rpv", "hapke")),
        "field": Text(),
        "network": Maybe(Text()),
        "bands": Items(Text()),
    },
    ("grid", "items", "suns", "shadow"),
)


@dataclass(frozen=True)
class FittedModel:
    """A fitted scene: the surface and its colours, and how the images show them.

    Attributes:
        grid: of the maps.
        items: ids of the training images, in the order of everything per image.
        suns: unit vectors (east, north, up) to the sun; None where unknown.
        height: ``[H, W]`` ellipsoidal heights [m].
        height_std: ``[H, W]`` their standard deviation [m].
        albedo: ``[H, W, C]``; with a reflectance model its BRF at standard geometry.
        gain, offset, ambient: ``[V, C]`` colours of the images, see `SurfaceScene`.
        pose: ``[V, 2]`` (east, north) shift of each view's rays [m].
        slopes: line of sight of each view.
        z_ref: reference height of the views [m].
        softness: of the surface at the end [m].
        shadow: how the sun's visibility was modelled.
        transient: whether images had darkenings of their own.
        radiance: what the images' numbers were.
        brdf: reflectance model.
        field: what was fitted.
        network: of ``field="mlp"``.
        bands: of the images that were fitted, as the user named them; none = all.
        s_net: ``[V, H, W]`` learned sun visibility, or None.
        tau: ``[V, H, W]`` transmission of transient objects, or None.
        beta: ``[V, H, W]`` learned uncertainty of the image's radiance, in its unit, or None.
        extra: tensors of the reflectance model (see `ReflectiveScene`) and ``NAME_std`` of its parameters, or the
            field's own.
    """

    grid: Grid
    items: list[str]
    suns: list[Sun | None]
    height: Tensor
    height_std: Tensor
    albedo: Tensor
    gain: Tensor
    offset: Tensor
    ambient: Tensor
    pose: Tensor
    slopes: list[ViewDirection] = dataclasses.field(default_factory=list)
    z_ref: float = 0.0
    softness: float = 0.0
    shadow: Literal["none", "geometric", "learned", "auto"] = "geometric"
    transient: Literal["on", "off", "auto"] = "off"
    radiance: Radiance = "relative"
    brdf: Literal["lambert", "rpv", "hapke"] = "lambert"
    field: str = "surface"
    network: str | None = None
    bands: list[str] = dataclasses.field(default_factory=list)
    s_net: Tensor | None = None
    tau: Tensor | None = None
    beta: Tensor | None = None
    extra: Mapping[str, Tensor] = dataclasses.field(default_factory=dict)

    @property
    def absolute(self) -> bool:
        """Whether the albedo is a reflectance rather than relative to the first image."""
        return self.radiance != "relative"

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
        tensors, description = dict(self.extra), {}
        for item in fields(self):
            value = getattr(self, item.name)
            if isinstance(value, Tensor):
                tensors[item.name] = value
            elif item.name == "grid":
                description[item.name] = self.grid.to_dict()
            elif item.name not in (*IMAGE_MAPS, "extra"):
                description[item.name] = value
        return tensors, description

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
        _DESCRIPTION.check(description, f"{path}: model")
        for name in _MAPS:
            if name not in tensors:
                raise InputError(f"{path}: found a model without {name}, expected a surface model")
        own = {item.name for item in fields(cls)}
        known = {name: value for name, value in description.items() if name in own and name != "extra"}
        known |= {name: tensors.pop(name) for name in (*_MAPS, *_PER_IMAGE) if name in tensors}
        for name, value in _neutral(len(known["items"]), known["albedo"]).items():
            known.setdefault(name, value)
        model = cls(**{**known, **_typed(known)}, extra=tensors)
        model._check(path)
        return model

    def _check(self, path: Path) -> None:
        """Raise InputError where tensors and description contradict each other."""
        shape = self.grid.shape
        for name in _MAPS:
            size, dimensions = tuple(getattr(self, name).shape), 3 if name == "albedo" else 2
            if len(size) != dimensions or size[:2] != shape:
                raise InputError(f"{path}: found {name} of {_by(size)} values, expected {_by(shape)} as its grid has")
        count = len(self.items)
        if len(self.suns) != count:
            raise InputError(f"{path}: found {len(self.suns)} suns for {count} images, expected one for each")
        for name in _PER_IMAGE:
            tensor = getattr(self, name)
            if tensor is not None and (tensor.dim() < 1 or tensor.shape[0] != count):
                raise InputError(f"{path}: found {name} of {_by(tuple(tensor.shape))} values for {count} images")
        for name, maps in self.image_maps().items():
            if tuple(maps.shape[1:]) != shape:
                raise InputError(f"{path}: found {name} of another size, expected {_by(shape)} as its grid has")


def _typed(description: Mapping[str, Any]) -> JsonObject:
    """What JSON holds as lists and tables, as the model holds it."""
    return {
        "grid": Grid.from_dict(description["grid"]),
        "suns": [None if sun is None else tuple(sun) for sun in description["suns"]],
        "slopes": [ViewDirection(*slope) for slope in description.get("slopes", [])],
    }


def _neutral(views: int, albedo: Tensor) -> dict[str, Tensor]:
    """Colours ``[V, C]`` and poses ``[V, 2]`` [m] of images that show the albedo as it is, for files without any."""
    none = albedo.new_zeros(views, albedo.shape[-1] if albedo.dim() else 1)
    return {"gain": none + 1, "offset": none, "ambient": none, "pose": albedo.new_zeros(views, 2)}


def _check_heights(path: Path, height: Tensor) -> None:
    known = height[height.isfinite()] if height.is_floating_point() else height[:0]
    check_height_limits(path, *((float(known.min()), float(known.max())) if known.numel() else (1.0, 0.0)))


def check_height_limits(path: Path, low: float, high: float) -> None:
    """Raise InputError where the lowest and highest height [m] of a model's file are none of the Earth."""
    if low > high:
        raise InputError(f"{path}: found no finite height in the model, expected a fitted surface")
    if low < HEIGHT_LIMITS_M[0] or high > HEIGHT_LIMITS_M[1]:
        raise InputError(f"{path}: found heights from {low:g} to {high:g} m, expected some of the Earth")


def _by(shape: tuple[int, ...]) -> str:
    return " x ".join(map(str, shape)) or "1"


__all__ = ["COLOURS", "IMAGE_MAPS", "FittedModel", "check_height_limits"]
