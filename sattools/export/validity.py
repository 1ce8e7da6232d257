"""Which cells of a surface the images have really shown."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import groupby
from operator import itemgetter

import numpy as np
from numpy.typing import NDArray

from sattools.camera.cells import project_cells
from sattools.camera.ground import ground_sample_distance, middle_lon_lat
from sattools.camera.rpc import RPC
from sattools.camera.view_direction import SMALLEST_ANGLE, angle_deg
from sattools.export.blocks import Block, Surroundings
from sattools.processors import side_by_side
from sattools.radiometry.saturated import conversion_of, showing_asset
from sattools.scene import Grid, Scene
from sattools.scene.pixels import ImagePart, image_part
from sattools.scene.validity import FILLED, MEASURED, UNSEEN
from sattools.views import line_of_sight

NEEDED = 2  # images that a height takes
_STRIP_CELLS = 1_000_000  # of all images that are looked at at a time
_WHOLE_PIXELS = 16_000_000  # of an image whose frame is found pixel by pixel
_FRAME_STEP = 16  # pixels along an axis that are looked at as one where it is larger
_PIXELS_PER_CELL = 1.5  # that are kept where an image is read reduced


@dataclass(frozen=True)
class Witness:
    """An image, and where its vendor's frame is.

    Attributes:
        rpc: its camera.
        part: its pixels.
        frame: ``[h, w]`` bool of squares of ``step`` pixels: no ground there; None = nowhere.
        step: see above.
    """

    rpc: RPC
    part: ImagePart
    frame: NDArray[np.bool_] | None
    step: int

    def shown(self, grid: Grid, height: NDArray[np.float32]) -> NDArray[np.bool_]:
        """Whether it has a valid pixel of a cell's surface point, hidden or not; every ray by the RPC itself.

        Args:
            grid: of the cells.
            height: ``[H, W]`` [m above the ellipsoid].
        """
        shown = np.zeros(grid.shape, bool)
        strip = max(1, _STRIP_CELLS // grid.width)
        for first in range(0, grid.height, strip):
            part = slice(first, min(first + strip, grid.height))
            own = grid.part(part, slice(0, grid.width))
            col, row = project_cells(self.rpc, own, height[part])
            rows, cols = self.part.shape
            inside = (col >= -0.5) & (row >= -0.5) & (col < cols - 0.5) & (row < rows - 0.5)
            if inside.any():
                step = self._reduction(own, float(height[part].mean()))
                shown[part][inside] = self._valid(np.round(row[inside]), np.round(col[inside]), step)
        return shown

    def _reduction(self, grid: Grid, height: float) -> int:
        lon, lat = middle_lon_lat(grid)
        pixel = ground_sample_distance(self.rpc, lon, lat, height)
        return max(1, int(grid.cell_size / pixel / _PIXELS_PER_CELL)) if math.isfinite(pixel) and pixel > 0 else 1

    def _valid(self, row: np.ndarray, col: np.ndarray, reduce: int) -> NDArray[np.bool_]:
        """Whether pixels ``[N]`` show something; ``reduce``: pixels along an axis that are read as one."""
        r, c = row.astype(np.intp), col.astype(np.intp)
        reduce = min(reduce, *self.part.shape)
        rows, cols = (
            slice(min(int(at.min()), size - reduce), min(size, int(at.max()) + reduce))
            for at, size in zip((r, c), self.part.shape, strict=True)
        )
        pixels = self.part.read((rows, cols), reduce)
        height, width = pixels.shape[1:]
        at = np.minimum((r - rows.start) // reduce, height - 1), np.minimum((c - cols.start) // reduce, width - 1)
        valid = np.isfinite(pixels).all(axis=0)[at]
        if self.frame is not None:
            square = self.frame[np.minimum(r // self.step, len(self.frame) - 1),
                                np.minimum(c // self.step, self.frame.shape[1] - 1)]  # fmt: skip
            valid &= ~(square & ((pixels == 0).all(axis=0)[at] | (self.step == 1)))
        return np.asarray(valid)


class Witnesses:
    """The images that a surface was made from.

    Args:
        scene: with the images.
        ids: of the images.

    Raises:
        InputError: an image or camera that cannot be read.
    """

    def __init__(self, scene: Scene, ids: Sequence[str]) -> None:
        used = [item for item in scene.items if item.id in ids]
        named = all("rpc" in i.assets and {"radiance", "image"} & i.assets.keys() for i in used)
        #: whether the scene still names all images and cameras
        self.known = len(used) == len(ids) and named
        items = used if self.known else []
        cameras = [RPC.from_file(scene.path(item.assets["rpc"].href)) for item in items]
        sides = _sides(scene, cameras)
        order = sorted(range(len(items)), key=lambda k: sides[k])
        items, cameras = [items[k] for k in order], [cameras[k] for k in order]
        self._sides = sorted(sides)
        parts = [image_part(scene, item, showing_asset(item)) for item in items]
        largest = max((rows * cols for rows, cols in (part.shape for part in parts)), default=1)
        frames = side_by_side(_frame, parts, max(1, _WHOLE_PIXELS // max(largest, 1)))
        found = zip(cameras, parts, frames, strict=True)
        self._witnesses = [Witness(rpc, part, frame, step) for rpc, part, (frame, step) in found]
        # what they show of the radiance, where that is less
        self._radiant = list(self._witnesses) if any(conversion_of(item) for item in items) else []
        for k, item in enumerate(items if self._radiant else []):
            if conversion_of(item):
                self._radiant[k] = Witness(cameras[k], image_part(scene, item, "radiance"), None, 1)

    def validity(self, block: Block, surface: Surroundings) -> NDArray[np.uint8]:
        """How every cell of a block came by its height.

        Args:
            block: of the surface.
            surface: heights [m above the ellipsoid], NaN = none.

        Returns:
            ``[h, w]``: 0 unseen = fewer than two images reach the cell; 2 filled = two reach it, but it is hidden
            from all of them but one by what stands around it; 1 measured = two see it. Images from one direction count
            as one.
        """
        reached, seen = (np.zeros(block.grid.shape, np.uint16) for _ in range(2))
        known = np.isfinite(surface.read(block.rows, block.cols))
        looks = zip(self._sides, _looks(self._witnesses, block, surface), strict=False)  # no looks without heights
        for _, alike in groupby(looks, key=itemgetter(0)):
            shown, visible = np.any([look for _, look in alike], axis=0)
            reached += shown
            seen += visible
        of_reached = np.where(seen >= NEEDED, MEASURED, FILLED)
        return np.where(known & (reached >= NEEDED), of_reached, UNSEEN).astype(np.uint8)

    def saturated(self, block: Block, surface: Surroundings) -> NDArray[np.bool_] | None:
        """Cells ``[h, w]`` of which the images that see them show no radiance, as it is masked; None = nowhere.

        Arguments as of `validity`.
        """
        if not self._radiant:
            return None
        seen, radiant = (np.zeros(block.grid.shape, bool) for _ in range(2))
        for witnesses, found in ((self._witnesses, seen), (self._radiant, radiant)):
            for _, visible in _looks(witnesses, block, surface):
                found |= visible
        return np.asarray(seen & ~radiant)


def _sides(scene: Scene, cameras: Sequence[RPC]) -> list[int]:
    """From which direction each camera looks, numbered; two of one direction are too near to be matched.

    Tiles of one acquisition, or a picture and a copy of it, tell no heights where they overlap.
    """
    heights = scene.require_height_range() if cameras else (0.0, 0.0)
    firsts: list[tuple[float, float, float]] = []
    sides = []
    for camera in cameras:
        towards = line_of_sight(camera, scene.require_grid(), heights[0], heights)[0].unit()
        # half of the angle, as then no two of a side are further from each other than that
        near = (k for k, first in enumerate(firsts) if angle_deg(first, towards) < SMALLEST_ANGLE / 2)
        side = next(near, len(firsts))
        firsts += [towards] if side == len(firsts) else []
        sides.append(side)
    return sides


def _looks(
    witnesses: Sequence[Witness], block: Block, surface: Surroundings
) -> Iterator[tuple[NDArray[np.bool_], NDArray[np.bool_]]]:
    """Per image, the cells ``[h, w]`` that it shows, hidden or not, and those of them that it sees."""
    height = surface.read(block.rows, block.cols)
    level = surface.level(height)
    low, high = surface.low, max(surface.high, surface.low + 1.0)
    asked = witnesses if np.isfinite(height).any() else []
    looks = side_by_side(lambda witness: witness.shown(block.grid, level), asked, max(1, _STRIP_CELLS // level.size))
    for witness, shown in zip(asked, looks, strict=True):
        visible = shown
        if shown.any():
            slope, _ = line_of_sight(witness.rpc, block.grid, low, (low, high))
            visible = shown & (surface.lit(block, slope.unit()) >= 0.5)
        yield shown, visible


def _frame(part: ImagePart) -> tuple[NDArray[np.bool_] | None, int]:
    """Where the frame of zeros is that vendors put around an image without saying so, and pixels per square of it."""
    from scipy.ndimage import binary_dilation

    rows, cols = part.shape
    step = 1 if rows * cols <= _WHOLE_PIXELS else _FRAME_STEP
    pixels = part.read(None, step)
    frame = np.isfinite(pixels).all(axis=0) & ~valid_pixels(pixels)
    if not frame.any():
        return None, step
    # squares that hold some of the frame lie beside those of nothing else
    return (frame if step == 1 else binary_dilation(frame, iterations=1, structure=np.ones((3, 3)))), step


def valid_pixels(image: NDArray[np.float32]) -> NDArray[np.bool_]:
    """Pixels ``[h, w]`` bool of an image ``[C, h, w]`` that show something.

    They are finite, and not of the frame of zeros in all bands that vendors put around an image without saying so.
    """
    from scipy.ndimage import label

    valid = np.isfinite(image).all(axis=0)
    frame, _ = label(~valid | (image == 0).all(axis=0))
    border = np.concatenate([frame[0], frame[-1], frame[:, 0], frame[:, -1]])
    valid &= ~np.isin(frame, np.unique(border[border > 0]))
    return np.asarray(valid)


__all__ = ["Witnesses", "valid_pixels"]
