"""Models larger than memory: read part by part, and written row by row."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from sattools.errors import InputError
from sattools.fit.checkpoint import KEY, VERSION, Put, save_in_pieces, verify
from sattools.fit.described import (
    CELL_MAPS,
    COLOURS,
    IMAGE_MAPS,
    Description,
    check_height_limits,
    check_maps,
    members,
)
from sattools.scene import Grid

if TYPE_CHECKING:
    from sattools.fit.model import FittedModel

IN_MEMORY = 32 << 20  # bytes up to which a model's maps are read at once
_STRIP_CELLS = 1_000_000


@dataclass(frozen=True)
class CellMaps:
    """Maps of a model of some cells.

    Attributes:
        height: ``[h, w]`` [m].
        height_std: ``[h, w]`` [m].
        albedo: ``[h, w, C]``.
        images: ``[V, h, w]`` those of every image that the model has, by name: shares of light in [0, 1], and beta.
    """

    height: np.ndarray
    height_std: np.ndarray
    albedo: np.ndarray
    images: Mapping[str, np.ndarray]

    def part(self, rows: slice, cols: slice) -> CellMaps:
        """Those of fewer cells."""
        images = {name: layers[:, rows, cols] for name, layers in self.images.items()}
        return CellMaps(self.height[rows, cols], self.height_std[rows, cols], self.albedo[rows, cols], images)


@dataclass(frozen=True)
class StoredModel:
    """A surface's file, of which parts are read; the maps of small ones are held in memory.

    Attributes:
        path: of the file.
        about: what it says of itself.
        shapes: of what it holds, by name.
        held: all maps, where they are small.
        old: the model, where the file is one of before files had a number.
    """

    path: Path
    about: Description
    shapes: Mapping[str, tuple[int, ...]]
    held: CellMaps | None = None
    old: FittedModel | None = None

    @classmethod
    def open(cls, path: Path, in_memory: int | None = None) -> StoredModel:
        """Check a file from its first byte to its last, and open it.

        Args:
            path: of the file.
            in_memory: bytes up to which the maps of a model are held in memory; None = `IN_MEMORY`.

        Raises:
            InputError: as `FittedModel.load` does.
        """
        about = _description(path)
        if VERSION not in about:  # no model, or of before there were numbers: the reader of whole files knows
            from sattools.fit.model import FittedModel

            model = FittedModel.load(path)
            shapes = {name: tuple(tensor.shape) for name, tensor in model.parts()[0].items()}
            images = {name: tensor.numpy() for name, tensor in model.image_maps().items()}
            held = CellMaps(model.height.numpy(), model.height_std.numpy(), model.albedo.numpy(), images)
            return cls(path, model.described(), shapes, held, model)
        verify(path)
        shapes = _shapes(path)
        described = Description(**members(about, path))
        check_maps(shapes, path)
        described.check_shapes(shapes, path)
        stored = cls(path, described, shapes)
        limit = IN_MEMORY if in_memory is None else in_memory
        if path.stat().st_size <= limit:
            stored = replace(stored, held=stored._read(slice(None), slice(None)))
        stored._check_heights()
        return stored

    @property
    def grid(self) -> Grid:
        """Of the maps."""
        return self.about.grid

    @property
    def bands(self) -> int:
        """Bands of the albedo."""
        return self.shapes["albedo"][-1]

    @property
    def plain(self) -> bool:
        """Whether it holds nothing beside the maps and the images' colours."""
        return self.shapes.keys() <= {*CELL_MAPS, *IMAGE_MAPS, *COLOURS}

    @property
    def image_maps(self) -> list[str]:
        """Names of the maps per image that it has."""
        return [name for name in IMAGE_MAPS if name in self.shapes]

    @cached_property
    def head(self) -> FittedModel:
        """The model of the first cell, for what is of all cells."""
        return self.part(slice(0, 1), slice(0, 1))

    def load(self) -> FittedModel:
        """All of the model, with the reflectance model's own maps or the field's tensors.

        Raises:
            InputError: as `FittedModel.load`.
        """
        from sattools.fit.model import FittedModel

        return self.old or FittedModel.load(self.path)

    def colours(self) -> dict[str, np.ndarray]:
        """What it holds per image beside maps, ``[V, C]`` or ``[V, 2]`` by name."""
        if self.old is not None:
            return {name: getattr(self.old, name).numpy() for name in COLOURS}
        with _content(self.path) as file:
            return {name: file.get_tensor(name) for name in COLOURS if name in self.shapes}

    def maps(self, rows: slice, cols: slice) -> CellMaps:
        """The maps of these cells."""
        return self._read(rows, cols) if self.held is None else self.held.part(rows, cols)

    def part(self, rows: slice, cols: slice) -> FittedModel:
        """The model of these cells, without a reflectance model's own maps."""
        import torch

        from sattools.fit.model import FittedModel

        grid, maps = self.grid.part(rows, cols), self.maps(rows, cols)
        arrays = {name: getattr(maps, name) for name in CELL_MAPS} | self.colours() | dict(maps.images)
        tensors: dict[str, Any] = {name: torch.from_numpy(np.ascontiguousarray(a)) for name, a in arrays.items()}
        if self.old is not None:
            return replace(self.old, grid=grid, extra={}, **tensors)
        return FittedModel.of(tensors, _description(self.path) | {"grid": grid.to_dict()}, self.path)

    def strips(self) -> list[slice]:
        """Its rows, some at a time."""
        count = max(1, _STRIP_CELLS // self.grid.width)
        return [slice(k, min(k + count, self.grid.height)) for k in range(0, self.grid.height, count)]

    def _read(self, rows: slice, cols: slice) -> CellMaps:
        with _content(self.path) as file:
            height, std, albedo = (file.get_slice(name)[rows, cols] for name in CELL_MAPS)
            images = {name: file.get_slice(name)[:, rows, cols] for name in self.image_maps}
        return CellMaps(height, std, albedo, images)

    def _check_heights(self) -> None:
        """Raise InputError where no surface has such heights."""
        lowest, highest = np.inf, -np.inf
        for rows in self.strips():
            height = self.maps(rows, slice(0, self.grid.width)).height
            known = height[np.isfinite(height)] if np.issubdtype(height.dtype, np.floating) else height[:0]
            if known.size:
                lowest, highest = min(lowest, float(known.min())), max(highest, float(known.max()))
        check_height_limits(self.path, lowest, highest)


@contextmanager
def _content(path: Path) -> Iterator[Any]:
    """A file that was whole when the model was opened; InputError where it has gone since."""
    from safetensors import SafetensorError, safe_open

    try:
        with safe_open(path, framework="np") as file:
            yield file
    except FileNotFoundError:
        raise InputError(f"{path}: no such file any more, expected it there until the end") from None
    except (SafetensorError, OSError) as error:
        text = " ".join(str(error).split())[:120]
        raise InputError(f"{path}: cannot be read any more ({text}), expected it there until the end") from None


def _shapes(path: Path) -> dict[str, tuple[int, ...]]:
    """Shapes of what a file holds."""
    with _content(path) as file:
        return {name: tuple(file.get_slice(name).get_shape()) for name in file.keys()}  # noqa: SIM118


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
        about: what it is; its grid is that of the whole.
        colours: what it holds per image (``gain``, ...), ``[V, C]`` or ``[V, 2]``.
        bands: of the albedo.
        image_maps: names of those per image that it has.
        rows: maps of some rows by name: ``[h, W]``, ``[h, W, C]``, ``[V, h, W]``.
        strip: rows at a time.
    """

    about: Description
    colours: Mapping[str, np.ndarray]
    bands: int
    image_maps: tuple[str, ...]
    rows: Callable[[slice], Mapping[str, np.ndarray]]
    strip: int

    @property
    def items(self) -> list[str]:
        """Ids of the training images."""
        return self.about.items

    def save(self, path: Path) -> None:
        """Write the file that `FittedModel.save` would write of the whole.

        Raises:
            SattoolsError: it cannot be written.
        """
        height, width = self.about.grid.shape
        views = len(self.items)
        shapes: dict[str, tuple[int, ...]] = {"height": (height, width), "height_std": (height, width)}
        shapes["albedo"] = (height, width, self.bands)
        shapes |= dict.fromkeys(self.image_maps, (views, height, width))
        shapes |= {name: values.shape for name, values in self.colours.items()}

        def fill(put: Put) -> None:
            for name, values in self.colours.items():
                put(name, 0, values)
            for first in range(0, height, self.strip):
                rows = slice(first, min(first + self.strip, height))
                for name, part in self.rows(rows).items():
                    if name in IMAGE_MAPS:
                        for k, image in enumerate(part):
                            put(name, (k * height + first) * width, image)
                    else:
                        put(name, first * width * (self.bands if name == "albedo" else 1), part)

        save_in_pieces(path, shapes, self.about.to_dict(), fill)


__all__ = ["CellMaps", "StoredModel", "StreamedModel"]
