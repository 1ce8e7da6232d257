"""Maps on the way: arrays while they are small, files without a name when they are not.

Either is read and written by slices of rows and columns, so that what is made of a map piece by piece takes the memory
of a piece, whatever the size of the map.
"""

from __future__ import annotations

import os
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any, cast

import numpy as np

from sattools import system
from sattools.errors import SattoolsError

HELD = 8 << 20  # bytes of a map that is an array
PIECE_CELLS = 1 << 19  # of which pieces of a map are made, in rows over its whole width
EDGE = 512  # cells: of blocks, as files are tiled
AT_ONCE = 1 << 20  # cells of a map that is one block


class StoredMap:
    """A map ``[H, W]`` in a file that has no name and goes with the process; what is sliced off is an array.

    Args:
        shape: (rows, columns).
        dtype: of the cells, which are 0 at first.
        folder: where the file is; None = the system's for temporary files.

    Raises:
        SattoolsError: the file cannot be made, or the disk is full.
    """

    def __init__(self, shape: tuple[int, int], dtype: Any, folder: Path | None = None) -> None:
        self.shape, self.dtype, self.folder = shape, np.dtype(dtype), folder
        self.ndim, self.size = 2, shape[0] * shape[1]
        try:
            self._file = tempfile.TemporaryFile(dir=folder)  # noqa: SIM115  # it is open as long as the map is there
            os.ftruncate(self._file.fileno(), self.size * self.dtype.itemsize)
        except OSError as error:
            raise self._failed(error) from error

    def __del__(self) -> None:
        if "_file" in vars(self):  # not where it could not be made
            self._file.close()

    def __len__(self) -> int:
        return self.shape[0]

    def __array__(self, dtype: Any = None, copy: bool | None = None) -> np.ndarray:
        return np.asarray(self[:], dtype=dtype)

    def __getitem__(self, part: slice | tuple[slice, slice]) -> np.ndarray:
        rows, cols = part if isinstance(part, tuple) else (part, slice(None))
        first, last, step = rows.indices(self.shape[0])
        if step == 1:
            return self._read(first, max(first, last))[:, cols]
        found = [self._read(row, row + 1)[:, cols] for row in range(first, last, step)]
        return np.concatenate(found) if found else self._read(0, 0)[:, cols]

    def __setitem__(self, part: slice | tuple[slice, slice], values: Any) -> None:
        rows, cols = part if isinstance(part, tuple) else (part, slice(None))
        first, last, _ = rows.indices(self.shape[0])
        left, right, _ = cols.indices(self.shape[1])
        cells = np.broadcast_to(np.asarray(values, self.dtype), (last - first, right - left))
        if right - left == self.shape[1]:
            self._write(np.ascontiguousarray(cells), first, 0)
            return
        for row, own in enumerate(np.ascontiguousarray(cells), start=first):
            self._write(own, row, left)

    def _at(self, row: int, col: int) -> int:
        return (row * self.shape[1] + col) * self.dtype.itemsize

    def _read(self, first: int, last: int) -> np.ndarray:
        found = np.empty((last - first, self.shape[1]), self.dtype)
        into, at = found.reshape(-1).view(np.uint8).data, self._at(first, 0)
        while into:
            count = system.read_at(self._file.fileno(), into, at)
            if not count:
                raise self._failed(OSError(5, "found less than was written"))
            into, at = into[count:], at + count
        return found

    def _write(self, cells: np.ndarray, row: int, col: int) -> None:
        rest, at = cells.reshape(-1).view(np.uint8).data, self._at(row, col)
        try:
            while rest:
                count = system.write_at(self._file.fileno(), rest, at)
                rest, at = rest[count:], at + count
        except OSError as error:
            raise self._failed(error) from error

    def _failed(self, error: OSError) -> SattoolsError:
        place = self.folder or tempfile.gettempdir()
        return SattoolsError(f"{place}: a temporary file cannot be written ({error.strerror}), expected room for it")


def new_map(shape: tuple[int, int], dtype: Any = np.float32, folder: Path | None = None) -> np.ndarray:
    """A map of zeros to be filled: an array, or what behaves like one where it is sliced.

    Args:
        shape: (rows, columns).
        dtype: of the cells.
        folder: of what is too large for an array; None = the system's for temporary files.
    """
    if shape[0] * shape[1] * np.dtype(dtype).itemsize <= HELD:
        return np.zeros(shape, dtype)
    return cast(np.ndarray, StoredMap(shape, dtype, folder))


def map_like(other: np.ndarray, shape: tuple[int, int], dtype: Any) -> np.ndarray:
    """A map of zeros to be filled, in memory if the other one is.

    Args:
        other: a map.
        shape: (rows, columns).
        dtype: of the cells.
    """
    if isinstance(other, StoredMap):
        return new_map(shape, dtype, other.folder)
    return np.zeros(shape, dtype)


def pieces(shape: tuple[int, int], most_rows: int | None = None) -> Iterator[slice]:
    """Rows of a map in pieces of about `PIECE_CELLS` cells.

    Args:
        shape: (rows, columns).
        most_rows: of a piece; None = any number.
    """
    height, width = shape
    rows = max(1, PIECE_CELLS // max(width, 1))
    rows = rows if most_rows is None else min(rows, most_rows)
    for first in range(0, height, rows):
        yield slice(first, min(first + rows, height))


def cut(shape: tuple[int, int], edge: int | None = None) -> Iterator[tuple[slice, slice]]:
    """Rows and columns of a map in square blocks, row by row; all of it where it is small.

    Args:
        shape: (rows, columns).
        edge: of a block [cells]; None = `EDGE`.
    """
    height, width = shape
    if height * width <= AT_ONCE:
        yield slice(0, height), slice(0, width)
        return
    edge = edge or EDGE
    for row in range(0, height, edge):
        for col in range(0, width, edge):
            yield slice(row, min(row + edge, height)), slice(col, min(col + edge, width))


__all__ = ["PIECE_CELLS", "StoredMap", "cut", "map_like", "new_map", "pieces"]
