"""Images as they come: opening, checking, reading a window, and writing the scene's own copy."""

from __future__ import annotations

import logging
import math
import re
from collections import Counter
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from rasterio.enums import MaskFlags
from rasterio.errors import RasterioError
from rasterio.io import DatasetReader
from rasterio.windows import Window

from sattools.camera import RPC
from sattools.errors import InputError
from sattools.prep.frames import Frame
from sattools.prep.metadata import Metadata, from_tags, read_sidecar
from sattools.scene.gdal import rpc_tags
from sattools.scene.location import RemotePath
from sattools.scene.opening import opened
from sattools.scene.sidecars import sidecars

log = logging.getLogger(__name__)
LARGE_PX = 9_000_000  # of an image, beyond which none is read as a whole
LARGE_TOTAL_PX = 200_000_000  # of all images together
REDUCED_PX = 5_000_000
_STRIP_PX = 4_000_000
_AT_ONCE_PX = 9_000_000  # of images that are read or written at a time


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
    mask_like: bool = False  # the band marked as alpha holds two values at most
    masked: bool = False  # a mask lies beside the bands
    tags_rpc: RPC | None = None  # the camera of the image's own tags, whichever is used
    frame: Frame | None = None  # of pixels without data that the file does not call so
    read_range: tuple[tuple[int, int, int, int], tuple[float, float]] | None = None  # window, its extreme numbers

    def warn(self, text: str) -> None:
        """A note that the user sees at once."""
        self.notes.append(text)
        log.warning("%s: %s", self.id, text)


def image_id(path: Path) -> str:
    """The item's name: the file's stem with everything odd replaced."""
    name = re.sub(r"[^A-Za-z0-9._-]+", "_", path.stem).lstrip("._-")[:128]
    if not name:
        raise InputError(f"{path}: found a name without letters or digits, expected one that can serve as an id")
    return name


def common_name(ids: Sequence[str]) -> str:
    """What image names have in common, up to a separator; `scene` when that is nothing."""
    first, last = min(ids), max(ids)
    n = next((k for k, (a, b) in enumerate(zip(first, last, strict=False)) if a != b), min(len(first), len(last)))
    head = first[:n]
    cut = max(head.rfind(s) for s in "_-.")
    return (head[:cut].rstrip("_-.") if cut > 0 else "") or "scene"


def check_ids(images: Sequence[Path]) -> list[str]:
    """Ids of all images; InputError when there are fewer than two images or two have the same id."""
    for path in images:
        check_there(path)
    if len(images) < 2:
        problem = f"{images[0]}: found this one image only" if images else "prep: found no image"
        raise InputError(f"{problem}, expected at least 2 images of one place")
    ids = [image_id(p) for p in images]
    twice = [i for i, n in Counter(ids).items() if n > 1]
    if twice:
        paths = [str(p) for p, i in zip(images, ids, strict=True) if i == twice[0]]
        raise InputError(f"{paths[1]}: found id {twice[0]!r}, which {paths[0]} has too, expected unique file names")
    return ids


def check_there(path: Path) -> None:
    """Raise InputError where a file of this machine is not there."""
    if isinstance(path, RemotePath):
        return
    try:
        there = path.exists()
    except OSError as error:
        raise InputError(f"{path}: found {error.strerror}, expected an image") from None
    if not there or path.suffix.lower() == ".json":
        found = "found a document (of a scene? it goes on with `sattools prior`)" if there else "no such file"
        raise InputError(f"{path}: {found}, expected an image")


def load_source(path: Path, name: str, metadata_dir: Path | None) -> SourceImage:
    """Open an image, find its camera and metadata.

    What `metadata_dir` holds comes before what lies beside the image, and that before the image's own tags.
    Raises InputError: missing, unreadable, no RPC, metadata of another crop.

    Args:
        path: of the image.
        name: its id.
        metadata_dir: folder to look for metadata in, too.
    """
    with opened(path) as data:
        size = (data.height, data.width)
        bands, dtype = data.count, str(data.dtypes[0])
        tags, found_rpc = data.tags(), rpc_tags(data)
        meanings = tuple(interpretation.name for interpretation in data.colorinterp)
        mask_like = "alpha" in meanings and _two_values(data, path, meanings.index("alpha") + 1)
        masked = any(flags == [MaskFlags.per_dataset] for flags in data.mask_flag_enums)
    if not (np.issubdtype(np.dtype(dtype), np.integer) or np.issubdtype(np.dtype(dtype), np.floating)):
        raise InputError(f"{path}: found pixels of type {dtype}, expected integers or floating point numbers")
    metadata = Metadata()
    notes = []
    misread: dict[Path, InputError] = {}
    own = path.parent if not isinstance(path, RemotePath) else None
    folders = [f for f in (metadata_dir, own) if f is not None]
    beside = sidecars(path, folders)
    for sidecar in beside:
        try:
            part = read_sidecar(sidecar)
        except InputError as error:
            # Beside an image may lie anything; what the user pointed to must be readable, and what is a camera by its
            # name: it comes before the image's own tags.
            if metadata_dir is not None and sidecar.parent == metadata_dir:
                raise
            if sidecar.suffix.lower() in (".json", ".rpb") or sidecar.stem.lower().endswith("_rpc"):
                raise
            misread[sidecar] = error
            notes.append(f"{sidecar.name}: not understood, left aside")
            continue
        if part.size is not None and part.size != size:
            raise InputError(
                f"{sidecar}: found metadata of an image of {part.size[1]} x {part.size[0]} pixels, "
                f"expected {size[1]} x {size[0]} as {path.name} has"
            )
        metadata = metadata.filled(part)
    metadata = metadata.filled(from_tags(tags, path.stem))
    if metadata.rpc is None:
        metadata.rpc = _camera_of_tags(path, found_rpc, beside, misread, folders)
        metadata.rpc_source = str(path)
    source = SourceImage(name, path, size, bands, dtype, metadata.rpc, metadata, (0, 0, size[1], size[0]), notes)
    source.meanings, source.mask_like, source.masked = meanings, mask_like, masked
    if found_rpc and metadata.rpc_source != str(path):
        with suppress(InputError):  # it is not used
            source.tags_rpc = RPC.from_tags(found_rpc, source=str(path))
    return source


def _camera_of_tags(
    path: Path,
    tags: Mapping[str, str],
    beside: Sequence[Path],
    misread: Mapping[Path, InputError],
    folders: Sequence[Path],
) -> RPC:
    """The camera of an image that no metadata file has one for; raises InputError, naming those that were looked at.

    Args:
        path: of the image.
        tags: the RPC that GDAL finds, which may be that of a file beside it.
        beside: metadata files that belong to the image by their names.
        misread: those of them that were not understood, and why.
        folders: where they were looked for.
    """
    try:
        if tags:
            return RPC.from_tags(tags, source=str(path))
    except InputError:
        if not misread:
            raise
    if misread:
        file, why = next(iter(misread.items()))
        raise InputError(f"{why} (and {path.name}, to which {file.name} belongs, has no other RPC)") from None
    nor = f", nor one in {' or '.join(str(file) for file in beside)}" if beside else ""
    where = f" or a metadata file in {' or '.join(str(folder) for folder in folders)}" if folders else ""
    raise InputError(f"{path}: found no RPC{nor}, expected RPC tags in the image{where}")


def _two_values(data: DatasetReader, path: Path, band: int) -> bool:
    """A sample of a band holds two values at most, as masks do."""
    size = 64
    picks = [Window(c, r, min(size, data.width - c), min(size, data.height - r)) for c, r in _corners(data, size)]
    try:
        values = [data.read(band, window=window).ravel() for window in picks]
    except (RasterioError, ValueError):
        raise InputError(f"{path}: found a damaged or truncated image in band {band}, expected pixels") from None
    return np.unique(np.concatenate(values)).size <= 2


def _corners(data: DatasetReader, size: int) -> list[tuple[int, int]]:
    cols = {0, max(0, data.width // 2 - size // 2), max(0, data.width - size)}
    rows = {0, max(0, data.height // 2 - size // 2), max(0, data.height - size)}
    return [(c, r) for c in sorted(cols) for r in sorted(rows)]


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


def at_once(sources: Sequence[SourceImage]) -> int:
    """Images that are read or written at a time: several small ones, but one that is a whole satellite scene."""
    largest = max((source.window[2] * source.window[3] for source in sources), default=1)
    return max(1, _AT_ONCE_PX // max(largest, 1))


__all__ = [
    "LARGE_PX", "LARGE_TOTAL_PX", "SourceImage", "at_once", "block_factor", "check_ids", "common_name", "image_id",
    "load_source",
]  # fmt: skip
