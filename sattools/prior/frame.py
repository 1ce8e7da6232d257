"""Views on the ground grid, as matching wants them."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np


@dataclass(frozen=True)
class Frame:
    """Views on the ground grid with a margin on every side.

    Attributes:
        images: ``[V, H + 2 margin, W + 2 margin]`` float32 grey radiance at the reference height.
        masks: same shape, uint8, 1 = valid.
        parallax: ``[V, 2]`` float64: (row, column) cells by which a point moves in the frame per metre of height.
        z_ref: reference height [m].
        cell: edge of a cell [m].
        margin: cells.
        suns: per view, unit vector (east, north, up) to the sun; None = unknown, then nothing counts as shaded.
        pixels: per view, edge of the image's pixels on the ground [m]; empty = unknown.
        shares: per view, how much it counts beside the others (0 to 1); empty = all alike.
        tone: exponent of the tone curve that the images have got.
    """

    images: np.ndarray
    masks: np.ndarray
    parallax: np.ndarray
    z_ref: float
    cell: float
    margin: int
    suns: tuple[tuple[float, float, float] | None, ...]
    pixels: tuple[float, ...] = ()
    shares: tuple[float, ...] = ()
    tone: float = 1.0

    @property
    def shape(self) -> tuple[int, int]:
        """(rows, columns) of the grid inside the margin."""
        rows, cols = self.images.shape[1:]
        return rows - 2 * self.margin, cols - 2 * self.margin

    @property
    def view_weights(self) -> np.ndarray:
        """The shares ``[V]`` float32."""
        return np.array(self.shares or (1.0,) * len(self.images), np.float32)

    @property
    def light(self) -> np.ndarray:
        """(row, column) cells ``[V, 2]`` float64 by which the light of each sun moves as it falls by a metre.

        NaN = the sun is unknown, or not above the horizon.
        """
        unknown = (np.nan, np.nan, np.nan)
        east, north, up = np.array([unknown if sun is None else sun for sun in self.suns]).T
        return np.stack([north, -east], axis=1) / np.where(up > 0, up, np.nan)[:, None] / self.cell

    def halved(self) -> Frame:
        """The same with cells of twice the size; margin, rows and columns must be even."""
        images, masks = self.images[:, ::2] + self.images[:, 1::2], np.minimum(self.masks[:, ::2], self.masks[:, 1::2])
        images = (images[..., ::2] + images[..., 1::2]) / np.float32(4)
        masks = np.minimum(masks[..., ::2], masks[..., 1::2])
        parallax, cell, margin = self.parallax / 2, self.cell * 2, self.margin // 2
        return replace(self, images=images, masks=masks, parallax=parallax, cell=cell, margin=margin)

    def widened(self, margin: int) -> Frame:
        """The same with at least that margin; what is added has no valid pixel."""
        add = max(0, margin - self.margin)
        around = ((0, 0), (add, add), (add, add))
        return replace(
            self, images=np.pad(self.images, around), masks=np.pad(self.masks, around), margin=self.margin + add
        )


__all__ = ["Frame"]
