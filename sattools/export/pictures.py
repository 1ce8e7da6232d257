"""Pictures on an image's own pixels, put together of what is shown of parts of the ground."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from sattools.camera.ground import from_geographic, project
from sattools.camera.rpc import RPC
from sattools.export.parts import Part
from sattools.scene import Grid, Item, Scene
from sattools.scene.pixels import image_part
from sattools.scene.stored import new_map, pieces
from sattools.views import View, check_seen

_STRIDE = 16  # pixels
_FEW_CELLS = 10  # that tell no colours
_SPARE_PIXELS = 2
_TOLERANCE = 1e-3  # of a cell, so that no pixel between two parts is rounded out of both
Window = tuple[slice, slice]


class Picture:
    """Bands and height of an image's pixels.

    Args:
        scene: of the item.
        item: the image.
        bands: number of bands.
        folder: for temporary files; None = the system's.
        in_part: whether only a part of it tells how good it is.

    Attributes:
        bands: ``[h, w]`` float32 each, maps that are read by rows; NaN = nothing.
        height: ``[h, w]`` float32 [m].
        scored: ``[h, w]`` float32, 1 where it may be held against the image, NaN elsewhere; None = everywhere.
        rpc: the image's camera.
    """

    def __init__(self, scene: Scene, item: Item, bands: int, folder: Path | None, *, in_part: bool = False) -> None:
        name = "radiance" if "radiance" in item.assets else "image"
        self.rpc = RPC.from_file(scene.path(item.assets["rpc"].href))
        self.shape, self._id = image_part(scene, item, name).shape, item.id
        self.bands = [new_map(self.shape, np.float32, folder) for _ in range(bands)]
        self.height = new_map(self.shape, np.float32, folder)
        self.scored = new_map(self.shape, np.float32, folder) if in_part else None
        self._any = False
        for map_ in (*self.bands, self.height, *self._more):
            for rows in pieces(self.shape):
                map_[rows] = np.nan

    @property
    def _more(self) -> list[np.ndarray]:
        return [] if self.scored is None else [self.scored]

    def window(self, part: Part, whole: Grid, z_ref: float) -> Window | None:
        """Rows and columns of the pixels whose lines of sight cross a height on a part's own cells; None = none."""
        west, south, east, north = whole.part(*part.own).bounds
        x, y = (a.ravel() for a in np.meshgrid(np.linspace(west, east, 5), np.linspace(south, north, 5)))
        col, row = project(self.rpc, whole.crs, x, y, np.full(x.size, z_ref))
        known = np.isfinite(col) & np.isfinite(row)
        if not known.any():
            return None
        if not known.all():  # where the camera's model ends nobody knows how far the part goes on in the image
            return slice(0, self.shape[0]), slice(0, self.shape[1])
        rows, cols = (
            slice(max(0, int(at.min()) - _SPARE_PIXELS), min(count, int(at.max()) + 1 + _SPARE_PIXELS))
            for at, count in zip((row, col), self.shape, strict=True)
        )
        return (rows, cols) if rows.start < rows.stop and cols.start < cols.stop else None

    def put(
        self,
        window: Window,
        part: Part,
        radiance: np.ndarray,
        height: np.ndarray,
        z_ref: float,
        *,
        scored: np.ndarray | None = None,
    ) -> None:
        """Show a part in the pixels of a window whose lines of sight cross a height on its own cells.

        Args:
            window: of the image.
            part: of the model.
            radiance: ``[h, w, C]`` on the part's cells at that height; NaN = nothing.
            height: ``[h, w]`` of what is seen there [m].
            z_ref: that height [m].
            scored: ``[h, w]`` on the part's cells, see `Picture.scored`.
        """
        import cv2

        rows, cols = window
        shape = rows.stop - rows.start, cols.stop - cols.start
        at_col, at_row = pixels_on(self.rpc.cropped(cols.start, rows.start), shape, part.model.grid, z_ref)
        own = np.ones(shape, bool)
        for at, inner, outer in ((at_row, part.own[0], part.rows), (at_col, part.own[1], part.cols)):
            first, last = inner.start - outer.start - 0.5, inner.stop - outer.start - 0.5
            own &= (at >= first - _TOLERANCE) & (at < last + _TOLERANCE)
        layers = [*np.moveaxis(radiance, -1, 0), height, *([] if scored is None else [scored])]
        for map_, values in zip((*self.bands, self.height, *self._more), layers, strict=True):
            shown = cv2.remap(
                np.ascontiguousarray(values, np.float32), at_col, at_row, cv2.INTER_LINEAR,
                borderMode=cv2.BORDER_CONSTANT, borderValue=(np.nan,) * 4,
            )  # fmt: skip
            map_[rows, cols] = np.where(own, shown, map_[rows, cols])
        self._any = self._any or bool(own.any())

    def check(self) -> None:
        """Raise SceneError where no pixel shows the model's ground."""
        check_seen(self._id, np.array([self._any]), f"leave out --view {self._id}")


class ColourScale:
    """Gain and offset per band that bring a picture's western half to what an image shows.

    Args:
        bands: number of bands.
    """

    def __init__(self, bands: int) -> None:
        self._count = 0
        self._sums = np.zeros((bands, 4))  # of p, t, p p, p t

    def add(self, radiance: np.ndarray, view: View, part: Part, west: int) -> None:
        """Count a part's own cells in the western half.

        Args:
            radiance: ``[h, w, C]`` of the picture; NaN = nothing.
            view: the image on the same cells.
            part: of the model.
            west: columns of the part that lie in that half.
        """
        counted = (view.mask > 0) & np.isfinite(radiance).all(axis=-1)
        counted[:, west:] = False
        own = np.zeros_like(counted)
        rows, cols = (
            slice(inner.start - outer.start, inner.stop - outer.start)
            for inner, outer in zip(part.own, (part.rows, part.cols), strict=True)
        )
        own[rows, cols] = counted[rows, cols]
        p, t = radiance[own].astype(np.float64), view.target[own].astype(np.float64)
        self._count += len(p)
        self._sums += np.stack([p.sum(0), t.sum(0), (p * p).sum(0), (p * t).sum(0)], axis=1)

    def apply(self, bands: list[np.ndarray]) -> None:
        """Bring a picture's bands to the image's colours.

        Args:
            bands: ``[h, w]`` each, maps that are read by rows.
        """
        if self._count < _FEW_CELLS:
            return
        for map_, (p, t, pp, pt) in zip(bands, self._sums / self._count, strict=True):
            spread = pp - p * p
            gain = (pt - p * t) / spread if spread > 1e-12 * pp else 1.0
            for rows in pieces((map_.shape[0], map_.shape[1])):
                map_[rows] = gain * map_[rows] + (t - gain * p)


def pixels_on(rpc: RPC, shape: tuple[int, ...], grid: Grid, z_ref: float) -> tuple[np.ndarray, np.ndarray]:
    """Where the lines of sight of an image's pixels cross the reference height: (column, row) of the grid, float32.

    The camera is asked at every `_STRIDE`-th pixel only, and is as good as straight between them.

    Args:
        rpc: the image's camera.
        shape: rows and columns of the image, last.
        grid: ground grid.
        z_ref: reference height [m].
    """
    from scipy.interpolate import RegularGridInterpolator

    rows, cols = shape[-2:]
    knots = [np.append(np.arange(0, size - 1, _STRIDE), size - 1).astype(np.float64) for size in (rows, cols)]
    if min(len(axis) for axis in knots) < 2:
        knots = [np.array([0.0, max(1.0, size - 1)]) for size in (rows, cols)]
    row, col = np.meshgrid(*knots, indexing="ij")
    lon, lat = rpc.localization(col.ravel(), row.ravel(), np.full(col.size, z_ref))
    east, north = from_geographic(grid.crs, lon, lat)
    at_col = (np.asarray(east) - grid.left) / grid.cell_size - 0.5
    at_row = (grid.top - np.asarray(north)) / grid.cell_size - 0.5
    between = RegularGridInterpolator(tuple(knots), np.stack([at_col, at_row], axis=1).reshape(*col.shape, 2))
    every = np.stack(np.meshgrid(np.arange(rows), np.arange(cols), indexing="ij"), axis=-1)
    found = between(every.reshape(-1, 2)).reshape(rows, cols, 2).astype(np.float32)
    return np.ascontiguousarray(found[..., 0]), np.ascontiguousarray(found[..., 1])


__all__ = ["ColourScale", "Picture", "pixels_on"]
