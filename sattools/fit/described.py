"""What the file of a fitted model says of itself, and the shapes of what it holds: read without PyTorch.

Whoever needs the maps alone is spared a second and 0.15 GiB for the import.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any, Literal

from sattools.camera.view_direction import ViewDirection
from sattools.errors import InputError, counted
from sattools.scene import Grid
from sattools.scene.jsonio import JsonObject
from sattools.scene.members import GRID, HEIGHT_LIMITS_M
from sattools.scene.schema import Items, Maybe, Number, Table, Text

Sun = tuple[float, float, float]
Radiance = Literal["reflectance_factor", "toa_reflectance", "relative"]
COLOURS = ("gain", "offset", "ambient", "pose")
CELL_MAPS = ("height", "height_std", "albedo")
IMAGE_MAPS = ("s_net", "tau", "beta")
PER_IMAGE = (*IMAGE_MAPS, *COLOURS)
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
        "heights": Text(("own", "surface", "prior")),
        "network": Maybe(Text()),
        "bands": Items(Text()),
    },
    ("grid", "items", "suns", "shadow"),
)


@dataclass(frozen=True, kw_only=True)
class Description:
    """What a fitted model is, but for its numbers.

    Attributes:
        grid: of the maps.
        items: ids of the training images, in the order of everything per image.
        suns: unit vectors (east, north, up) to the sun; None where unknown.
        slopes: line of sight of each view.
        z_ref: reference height of the views [m].
        softness: of the surface at the end [m].
        shadow: how the sun's visibility was modelled.
        transient: whether images had darkenings of their own.
        radiance: what the images' numbers were.
        brdf: reflectance model.
        field: what was fitted.
        heights: ``own``, or those that a field of rays started from, of the ``surface`` fit or the ``prior``, where its
            own were not found to explain held-out rays better.
        network: of ``field="mlp"``.
        bands: of the images that were fitted, as the user named them; none = all.
    """

    grid: Grid
    items: list[str]
    suns: list[Sun | None]
    slopes: list[ViewDirection] = dataclasses.field(default_factory=list)
    z_ref: float = 0.0
    softness: float = 0.0
    shadow: Literal["none", "geometric", "learned", "auto"] = "geometric"
    transient: Literal["on", "off", "auto"] = "off"
    radiance: Radiance = "relative"
    brdf: Literal["lambert", "rpv", "hapke"] = "lambert"
    field: str = "surface"
    heights: Literal["own", "surface", "prior"] = "own"
    network: str | None = None
    bands: list[str] = dataclasses.field(default_factory=list)

    @property
    def absolute(self) -> bool:
        """Whether the albedo is a reflectance rather than relative to the first image."""
        return self.radiance != "relative"

    def described(self) -> Description:
        """This alone, without what a subclass adds."""
        return Description(**{item.name: getattr(self, item.name) for item in fields(Description)})

    def to_dict(self) -> JsonObject:
        """As the file has it, see `members`."""
        own = {item.name: getattr(self, item.name) for item in fields(Description)}
        return own | {"grid": self.grid.to_dict()}

    def check_shapes(self, shapes: Mapping[str, tuple[int, ...]], path: Path) -> None:
        """Raise InputError where the arrays of a file, of which there are the maps of every cell, contradict this.

        Args:
            shapes: of the arrays by name.
            path: of the file.
        """
        for name in CELL_MAPS:
            size, dimensions = shapes[name], 3 if name == "albedo" else 2
            if len(size) != dimensions or size[:2] != self.grid.shape:
                expected = _by(self.grid.shape)
                raise InputError(f"{path}: found {name} of {_by(size)} values, expected {expected} as its grid has")
        count = len(self.items)
        if len(self.suns) != count:
            raise InputError(
                f"{path}: found {counted(len(self.suns), 'suns')} for {counted(count, 'images')}, expected one for each"
            )
        for name in PER_IMAGE:
            size = shapes.get(name, (count, *self.grid.shape))
            if len(size) < 1 or size[0] != count:
                raise InputError(f"{path}: found {name} of {_by(size)} values for {counted(count, 'images')}")
            if name in IMAGE_MAPS and size[1:] != self.grid.shape:
                raise InputError(
                    f"{path}: found {name} of another size, expected {_by(self.grid.shape)} as its grid has"
                )


def members(description: Mapping[str, Any], path: Path) -> JsonObject:
    """The attributes of a `Description` that a file's JSON gives.

    Raises:
        InputError: it is not that of a model.
    """
    _DESCRIPTION.check(description, f"{path}: model")
    own = {item.name for item in fields(Description)}
    return {name: value for name, value in description.items() if name in own} | {
        "grid": Grid.from_dict(description["grid"]),
        "suns": [None if sun is None else tuple(sun) for sun in description["suns"]],
        "slopes": [ViewDirection(*slope) for slope in description.get("slopes", [])],
    }


def check_maps(names: Mapping[str, Any], path: Path) -> None:
    """Raise InputError where a file lacks a map that every surface has."""
    for name in CELL_MAPS:
        if name not in names:
            raise InputError(f"{path}: found a model without {name}, expected a surface model")


def check_height_limits(path: Path, low: float, high: float) -> None:
    """Raise InputError where the lowest and highest height [m] of a model's file are none of the Earth."""
    if low > high:
        raise InputError(f"{path}: found no finite height in the model, expected a fitted surface")
    if low < HEIGHT_LIMITS_M[0] or high > HEIGHT_LIMITS_M[1]:
        raise InputError(f"{path}: found heights from {low:g} to {high:g} m, expected some of the Earth")


def _by(shape: tuple[int, ...]) -> str:
    """A shape in words."""
    return " x ".join(map(str, shape)) or "1"


__all__ = [
    "CELL_MAPS",
    "COLOURS",
    "IMAGE_MAPS",
    "PER_IMAGE",
    "Description",
    "Radiance",
    "Sun",
    "check_height_limits",
    "check_maps",
    "members",
]
