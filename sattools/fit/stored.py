"""Models larger than memory: read part by part, and written row by row."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from dataclasses import dataclass, fields, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from torch import Tensor

from sattools.errors import InputError
from sattools.fit.checkpoint import CHECKSUM, KEY, VERSION, Put, save_in_pieces, verify
from sattools.fit.model import IMAGE_MAPS, FittedModel, check_height_limits
from sattools.scene import Grid

CELL_MAPS = ("height", "height_std", "albedo")
IN_MEMORY = 32 << 20  # bytes up to which a model is read at once
_STRIP_CELLS = 1_000_000


@dataclass
class StoredModel:
    """A surface's file, of which parts are read; small ones are held in memory.

    Attributes:
        path: of the file.
        grid: of its maps.
        whole: the model, where it is small.
    """

    path: Path
    grid: Grid
    whole: FittedModel | None = None

    @classmethod
    def open(cls, path: Path, in_memory: int | None = None) -> StoredModel:
        """Check a file from its first byte to its last, and open it.

        Args:
            path: of the file.
            in_memory: bytes up to which a model is held in memory; None = `IN_MEMORY`.

        Raises:
            InputError: as `FittedModel.load` does.
        """
        try:
            limit = IN_MEMORY if in_memory is None else in_memory
            about = _description(path) if path.stat().st_size > limit else {}
        except OSError:
            about = {}
        if VERSION not in about:  # small, or of before there were numbers: the reader of whole files knows what to say
            model = FittedModel.load(path)
            return cls(path, model.grid, model)
        verify(path)
        stored = cls(path, Grid.from_dict(about["grid"]))
        stored._check()
        return stored

    @cached_property
    def head(self) -> FittedModel:
        """The model, of the maps of which nothing but the first cell counts."""
        return self.whole or self.part(slice(0, 1), slice(0, 1))

    def part(self, rows: slice, cols: slice) -> FittedModel:
        """The model of these cells, without a reflectance model's own maps unless these are all cells."""
        from safetensors import safe_open

        grid = self.grid.part(rows, cols)
        if self.whole is not None:
            if grid == self.grid:
                return self.whole
            maps: dict[str, Any] = {name: getattr(self.whole, name)[rows, cols] for name in CELL_MAPS}
            maps |= {name: layers[:, rows, cols] for name, layers in self.whole.image_maps().items()}
            return replace(self.whole, grid=grid, extra={}, **maps)
        tensors: dict[str, Tensor] = {}
        with safe_open(self.path, framework="pt") as file:
            for name in {item.name for item in fields(FittedModel)} & set(file.keys()):
                if name in CELL_MAPS:
                    tensors[name] = file.get_slice(name)[rows, cols].clone()
                elif name in IMAGE_MAPS:
                    tensors[name] = file.get_slice(name)[:, rows, cols].clone()
                else:
                    tensors[name] = file.get_tensor(name)
        about = {k: v for k, v in _description(self.path).items() if k not in (CHECKSUM, VERSION)}
        return FittedModel.of(tensors, about | {"grid": grid.to_dict()}, self.path)

    def strips(self) -> list[slice]:
        """Its rows, some at a time."""
        count = max(1, _STRIP_CELLS // self.grid.width)
        return [slice(k, min(k + count, self.grid.height)) for k in range(0, self.grid.height, count)]

    def _check(self) -> None:
        """Raise InputError where the maps are not those of its grid, or hold heights that no surface has."""
        from safetensors import safe_open

        with safe_open(self.path, framework="pt") as file:
            for name in CELL_MAPS:
                shape = tuple(file.get_slice(name).get_shape()) if name in set(file.keys()) else ()
                if shape[:2] != self.grid.shape or len(shape) != (3 if name == "albedo" else 2):
                    found, expected = " x ".join(map(str, shape)), " x ".join(map(str, self.grid.shape))
                    raise InputError(f"{self.path}: found {name} of {found} values, expected {expected}")
        lowest, highest = np.inf, -np.inf
        for rows in self.strips():
            height = self.part(rows, slice(0, self.grid.width)).height.numpy()
            known = height[np.isfinite(height)]
            if known.size:
                lowest, highest = min(lowest, float(known.min())), max(highest, float(known.max()))
        check_height_limits(self.path, lowest, highest)


def _description(path: Path) -> dict[str, Any]:
    """What a model's file says of itself; empty where it is none."""
    from safetensors import SafetensorError, safe_open

    try:
        with safe_open(path, framework="np") as file:
            about = json.loads((file.metadata() or {})[KEY])
        return dict(about)
    except (SafetensorError, KeyError, TypeError, ValueError, OSError, RecursionError):
        return {}


@dataclass
class StreamedModel:
    """A model to be written row by row, in the place of a `FittedModel` that would be too large.

    Attributes:
        head: everything but the maps, which are of any size.
        grid: of the whole.
        bands: of the albedo.
        image_maps: names of those per image that it has.
        rows: maps of some rows by name: ``[h, W]``, ``[h, W, C]``, ``[V, h, W]``.
        strip: rows at a time.
    """

    head: FittedModel
    grid: Grid
    bands: int
    image_maps: tuple[str, ...]
    rows: Callable[[slice], Mapping[str, np.ndarray]]
    strip: int

    @property
    def items(self) -> list[str]:
        """Ids of the training images."""
        return self.head.items

    def save(self, path: Path) -> None:
        """Write the file that `FittedModel.save` would write of the whole.

        Raises:
            SattoolsError: it cannot be written.
        """
        height, width = self.grid.shape
        views = len(self.items)
        shapes: dict[str, tuple[int, ...]] = {"height": (height, width), "height_std": (height, width)}
        shapes["albedo"] = (height, width, self.bands)
        shapes |= dict.fromkeys(self.image_maps, (views, height, width))
        tensors, description = replace(self.head, grid=self.grid, s_net=None, tau=None, beta=None, extra={}).parts()
        small = {name: tensor.detach().cpu().float() for name, tensor in tensors.items() if name not in CELL_MAPS}
        shapes |= {name: tuple(tensor.shape) for name, tensor in small.items()}

        def fill(put: Put) -> None:
            for name, tensor in small.items():
                put(name, 0, tensor.numpy())
            for first in range(0, height, self.strip):
                rows = slice(first, min(first + self.strip, height))
                for name, values in self.rows(rows).items():
                    if name in IMAGE_MAPS:
                        for k, image in enumerate(values):
                            put(name, (k * height + first) * width, image)
                    else:
                        put(name, first * width * (self.bands if name == "albedo" else 1), values)

        save_in_pieces(path, shapes, description, fill)


__all__ = ["CELL_MAPS", "IMAGE_MAPS", "StoredModel", "StreamedModel"]
