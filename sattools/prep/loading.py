"""Images as they come: opening them, finding their cameras and metadata."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from rasterio.errors import RasterioError
from rasterio.io import DatasetReader
from rasterio.windows import Window

from sattools.camera import RPC
from sattools.errors import InputError
from sattools.prep.cameras import beside_georeference, georeference_of, of_another_window, of_other_pixels, own_camera
from sattools.prep.images import SourceImage
from sattools.prep.metadata import Metadata, from_tags, read_sidecar
from sattools.prep.tiles import camera_of_tile
from sattools.scene.gdal import rpc_tags
from sattools.scene.location import RemotePath
from sattools.scene.opening import opened
from sattools.scene.raster import has_mask
from sattools.scene.sidecars import sidecars

_OFF_PX, _OFF_SHARE = 10.0, 0.02  # of an image's side, that a georeference by its corners may be off


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
        descriptions = tuple(data.descriptions)
        mask_like = "alpha" in meanings and _two_values(data, path, meanings.index("alpha") + 1)
        if data.count and data.tags(1, ns="IMAGE_STRUCTURE").get("NBITS") == "1":
            raise InputError(f"{path}: found pixels of 1 bit, as masks have, expected brightness")
        masked, stated, within = has_mask(data), georeference_of(data), data.subdatasets
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
    own_rpc = own_camera(path) if found_rpc else None
    if metadata.rpc is None:
        metadata.rpc = _camera_of_tags(path, found_rpc, beside, misread, folders)
        metadata.rpc_source = str(path)
    else:
        try:
            metadata.rpc = camera_of_tile(path, metadata.rpc, str(metadata.rpc_source), metadata.tiles)
        except InputError:
            if own_rpc is None:
                raise
            metadata.rpc, metadata.rpc_source = own_rpc, str(path)
    source = SourceImage(name, path, size, bands, dtype, metadata.rpc, metadata, (0, 0, size[1], size[0]), notes)
    source.meanings, source.mask_like, source.masked = meanings, mask_like, masked
    source.descriptions = descriptions
    if own_rpc is not None:
        _compare_with_own(source, own_rpc, metadata_dir)
    _doubt(source, within, beside_georeference(source.rpc, size, stated) if stated is not None else 0.0)
    return source


def _doubt(source: SourceImage, within: Sequence[str], off: float) -> None:
    """Say what an image may be beside what it is taken for.

    Args:
        source: the image.
        within: names of all images in its file, if there are several.
        off: how far its georeference is from its camera [px].
    """
    if len(within) > 1:
        source.warn(
            f"holds {len(within)} images, of which the first is taken (gdal_translate {within[1]} takes another)"
        )
    if off > max(_OFF_PX, _OFF_SHARE * min(source.size)):
        source.warn(
            f"its georeference and its RPC ({source.metadata.rpc_source}) are {off:.0f} px apart across it: an "
            "orthophoto with the RPC of the raw image? That image is needed"
        )


def _compare_with_own(source: SourceImage, own: RPC, metadata_dir: Path | None) -> None:
    """Take an image's own camera where that of a file beside it was left behind when the image was cut or reduced."""
    metadata = source.metadata
    file = None if metadata.rpc_source == str(source.path) else Path(str(metadata.rpc_source))
    pointed_to = file is not None and metadata_dir is not None and file.parent == metadata_dir != source.path.parent
    if not pointed_to and (apart := of_another_window(source.rpc, own, source.size)) is not None:
        whose = f"another window of the image ({apart[0]:+.0f} columns, {apart[1]:+.0f} rows)"
    elif not pointed_to and (factor := of_other_pixels(source.rpc, own, source.size)) is not None:
        whose = f"the image in other pixels ({factor:.3g} along one of its own)"
    else:
        source.tags_rpc = own
        return
    name = "a file beside it" if file is None else file.name  # GDAL knows more of them
    source.warn(f"{name} has the camera of {whose}: its own RPC tags are taken")
    source.rpc = metadata.rpc = own
    metadata.rpc_source = str(source.path)


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


__all__ = ["load_source"]
