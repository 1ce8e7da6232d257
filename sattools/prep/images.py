"""Images as they come: what is known of one, and how many are read at a time."""

from __future__ import annotations

import logging
import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

from sattools.camera import RPC
from sattools.prep.frames import Frame
from sattools.prep.metadata import Metadata
from sattools.scene.blocks import Blocks

log = logging.getLogger(__name__)
LARGE_PX = 9_000_000  # of an image, beyond which none is read as a whole
LARGE_TOTAL_PX = 200_000_000  # of all images together
REDUCED_PX = 5_000_000
_AT_ONCE_PX = 9_000_000  # of images that are read or written at a time
# measured on 3 to 22 images of 0.3 to 9 million pixels, and on 3 of 10,000 x 10,000: right to 7 %
_LEAST_BYTES, _BASE_BYTES = 0.38e9, 0.13e9
_PX_BYTES, _FEATURES_PX_BYTES = 4, 246.0  # of an image that is held; of one whose features are looked for


@dataclass
class SourceImage:
    """One input image: its file, what is known about it, and the part of it that is used."""

    id: str
    path: Path
    size: tuple[int, int]  # (height, width)
    bands: int
    dtype: str
    rpc: RPC
    metadata: Metadata
    window: tuple[int, int, int, int] = (0, 0, 0, 0)  # col0, row0, width, height
    notes: list[str] = field(default_factory=list)
    meanings: tuple[str, ...] = ()  # of the bands: gray, red, alpha, palette, ...
    descriptions: tuple[str | None, ...] = ()  # of the bands
    mask_like: bool = False  # the band marked as alpha holds two values at most
    masked: bool = False  # a mask lies beside the bands
    tags_rpc: RPC | None = None  # the camera of the image's own tags, whichever is used
    frames: tuple[Frame, ...] = ()  # of pixels without data that the file does not call so
    clouds: Blocks | None = None  # that hide the ground
    hot: int | None = None  # how many hot pixels the window has; None = not looked for
    read_range: tuple[tuple[int, int, int, int], tuple[float, float]] | None = None  # window, its extreme numbers

    def warn(self, text: str) -> None:
        """A note that the user sees at once."""
        self.notes.append(text)
        log.warning("%s: %s", self.id, text)


def block_factor(size: tuple[int, int], sizes: Sequence[tuple[int, int]]) -> int:
    """Pixels along an axis that are read as one where images are looked at as a whole; 1 for small ones.

    Args:
        size: (height, width) of the image [px].
        sizes: of all images.
    """
    pixels = [h * w for h, w in sizes]
    if max(pixels) <= LARGE_PX and sum(pixels) <= LARGE_TOTAL_PX:
        return 1
    budget = min(REDUCED_PX, LARGE_TOTAL_PX // len(sizes))
    return max(1, math.ceil(math.sqrt(size[0] * size[1] / budget)))


def memory_needed(sizes: Sequence[tuple[int, int]]) -> float:
    """Bytes that `prep` takes: all images, and the features of one or, while clouds are looked for, all once more.

    Args:
        sizes: (height, width) of what is read of every image [px].
    """
    from sattools.camera.tiepoints import TiePointOptions  # late: only who asks needs it

    held = [h * w / block_factor((h, w), sizes) ** 2 for h, w in sizes]
    features = _FEATURES_PX_BYTES * min(max(held, default=0.0), TiePointOptions().max_image_px)
    return max(_LEAST_BYTES, _BASE_BYTES + _PX_BYTES * sum(held) + max(features, _BASE_BYTES + _PX_BYTES * sum(held)))


def at_once(sources: Sequence[SourceImage]) -> int:
    """Images that are read or written at a time: several small ones, but one that is a whole satellite scene."""
    largest = max((source.window[2] * source.window[3] for source in sources), default=1)
    return max(1, _AT_ONCE_PX // max(largest, 1))


__all__ = ["LARGE_PX", "LARGE_TOTAL_PX", "SourceImage", "at_once", "block_factor", "memory_needed"]
