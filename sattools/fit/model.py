"""A fitted model as it comes from a file: checked before anything is made of it."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from torch import Tensor

from sattools.errors import InputError
from sattools.fit.checkpoint import load
from sattools.scene.members import GRID, HEIGHT_LIMITS_M
from sattools.scene.schema import Items, Maybe, Number, Table, Text

_VECTOR = Maybe(Items(Number(-1.001, 1.001), 3, 3))
_META = Table(
    {
        "grid": GRID,
        "items": Items(Text(), 1),
        "suns": Items(_VECTOR, 1),
        "slopes": Items(Items(Number(-100, 100), 2, 2)),
        "z_ref": Number(*HEIGHT_LIMITS_M),
        "softness": Number(0, 1e6),
        "shadow": Text(("none", "geometric", "learned", "auto")),
        "radiance": Text(("toa_reflectance", "reflectance_factor", "relative")),
        "brdf": Text(("lambert", "rpv", "hapke")),
    },
    ("grid", "items", "suns", "shadow"),
)
_MAPS = ("height", "height_std", "albedo")
_PER_IMAGE = ("s_net", "tau", "gain", "offset", "pose", "ambient")


def read_model(path: Path) -> tuple[dict[str, Tensor], dict[str, Any]]:
    """Tensors and description of a model that `fit` has written.

    Raises: InputError (one line, naming the file): missing, damaged, or tensors and description that contradict each
    other or hold what no surface has.
    """
    tensors, meta = load(path)
    _META.check(meta, f"{path}: model")
    for name in _MAPS:
        if name not in tensors:
            raise InputError(f"{path}: found a model without {name}, expected a surface model")
    shape = (meta["grid"]["height"], meta["grid"]["width"])
    for name in _MAPS:
        size, dimensions = tuple(tensors[name].shape), 3 if name == "albedo" else 2
        if len(size) != dimensions or size[:2] != shape:
            raise InputError(f"{path}: found {name} of {_by(size)} values, expected {_by(shape)} as its grid has")
    count = len(meta["items"])
    if len(meta["suns"]) != count:
        raise InputError(f"{path}: found {len(meta['suns'])} suns for {count} images, expected one for each")
    for name in _PER_IMAGE:
        if name in tensors and (tensors[name].dim() < 1 or tensors[name].shape[0] != count):
            raise InputError(f"{path}: found {name} of {_by(tuple(tensors[name].shape))} values for {count} images")
        if name in ("s_net", "tau") and name in tensors and tuple(tensors[name].shape[1:]) != shape:
            raise InputError(f"{path}: found {name} of another size, expected {_by(shape)} as its grid has")
    _check_heights(path, tensors["height"])
    return tensors, meta


def _check_heights(path: Path, height: Tensor) -> None:
    if not height.is_floating_point() or not bool(height.isfinite().any()):
        raise InputError(f"{path}: found no finite height in the model, expected a fitted surface")
    known = height[height.isfinite()]
    low, high = float(known.min()), float(known.max())
    if low < HEIGHT_LIMITS_M[0] or high > HEIGHT_LIMITS_M[1]:
        raise InputError(f"{path}: found heights from {low:g} to {high:g} m, expected some of the Earth")


def _by(shape: tuple[int, ...]) -> str:
    return " x ".join(map(str, shape)) or "1"


__all__ = ["read_model"]
