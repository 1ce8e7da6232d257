"""A fitted model in parts, each with what lies around it as far as rays reach."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Protocol

import numpy as np
import torch
from torch import Tensor

from sattools.export.blocks import Block, Surroundings
from sattools.fit.around import casting
from sattools.fit.model import FittedModel
from sattools.fit.stored import StoredModel
from sattools.fit.surface.scene import SurfaceScene
from sattools.render.around import Around
from sattools.scene import Grid
from sattools.scene.stored import cut

EDGE = 512  # cells of a part's own
_SPARE_CELLS = 4
Vector = tuple[float, float, float]


@dataclass(frozen=True)
class Part:
    """Some cells of a model, and those around them.

    Attributes:
        rows, cols: of the whole, with what is around.
        own: rows and columns of the whole that are meant.
        model: of rows and cols.
        surface: the same as a scene.
        valid: ``[h, w]`` bool, where it may be shown; None = everywhere.
        around: heights of the whole, for the shadows; None = the part is the whole.
        beyond: the ground around the whole, where it is known and the part is the whole.
    """

    rows: slice
    cols: slice
    own: tuple[slice, slice]
    model: FittedModel
    surface: SurfaceScene
    valid: np.ndarray | None
    around: Surroundings | None = None
    beyond: Around | None = None

    def lit(self, sun: Vector | None) -> Tensor | None:
        """Share ``[h, w]`` of a sun's light that reaches the cells; None where nothing casts shadows."""
        if self.model.shadow == "none" or sun is None:
            return None
        if self.around is None:
            return casting(self.beyond)(self.surface.casting(), self.model.grid.cell_size, sun)
        return torch.from_numpy(self.around.lit(Block(self.rows, self.cols, self.model.grid), sun))


class Parts(Protocol):
    """A model that can be had in parts."""

    @property
    def grid(self) -> Grid:
        """Of the whole."""

    @property
    def head(self) -> FittedModel:
        """The model, of which the maps do not count."""

    def parts(self, reach: float = 0.0) -> Iterator[Part]:
        """All parts, with at least so many metres around each."""


@dataclass(frozen=True)
class WholeModel:
    """A model that is held in memory, as one part.

    Attributes:
        head: the model.
        surface: the same as a scene.
        valid: see `Part`.
        beyond: the ground around it, None = unknown.
    """

    head: FittedModel
    surface: SurfaceScene
    valid: np.ndarray | None = None
    beyond: Around | None = None

    @property
    def grid(self) -> Grid:
        """See `Parts`."""
        return self.head.grid

    def parts(self, reach: float = 0.0) -> Iterator[Part]:
        """See `Parts`."""
        all_ = slice(0, self.grid.height), slice(0, self.grid.width)
        yield Part(*all_, all_, self.head, self.surface, self.valid, beyond=self.beyond)


@dataclass(frozen=True)
class ModelInParts:
    """A surface of Lambert's reflectance in a file.

    Attributes:
        stored: the file.
        around: its heights.
        valid: ``[H, W]`` uint8 map that is read by rows, 1 where it may be shown.
    """

    stored: StoredModel
    around: Surroundings
    valid: np.ndarray = field(repr=False)

    @property
    def grid(self) -> Grid:
        """See `Parts`."""
        return self.stored.grid

    @property
    def head(self) -> FittedModel:
        """See `Parts`."""
        return self.stored.head

    def parts(self, reach: float = 0.0) -> Iterator[Part]:
        """See `Parts`."""
        spare = _SPARE_CELLS + math.ceil(reach / self.grid.cell_size)
        for own in cut(self.grid.shape, EDGE):
            rows, cols = (
                slice(max(0, part.start - spare), min(count, part.stop + spare))
                for part, count in zip(own, self.grid.shape, strict=True)
            )
            model = self.stored.part(rows, cols)
            valid = self.valid[rows, cols] > 0
            yield Part(rows, cols, own, model, model.surface(), valid, self.around)


__all__ = ["ModelInParts", "Part", "Parts", "WholeModel"]
