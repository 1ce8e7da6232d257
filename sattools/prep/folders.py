"""Folders in place of images, of which what is none is left out, and what is read beside images."""

from __future__ import annotations

import logging
from collections.abc import Iterable, Sequence
from pathlib import Path

from sattools.errors import InputError
from sattools.prep.colours import colour_files
from sattools.scene.gdal import rpc_tags
from sattools.scene.location import RemotePath, image_locations, location
from sattools.scene.opening import opened
from sattools.scene.sidecars import sidecars

log = logging.getLogger(__name__)
_NAMED = 5  # of the files left out


def images_with_cameras(names: Iterable[str], metadata: str | None) -> list[Path]:
    """Images by path or address, of folders those in them but for maps and quick looks, which have no camera at all.

    Args:
        names: as the user gives them.
        metadata: folder with metadata files, where there is one.

    Raises:
        InputError: an address that is none, or a folder without images.
    """
    found: list[Path] = []
    for name in names:
        inside, place = image_locations([name]), location(name)
        if not isinstance(place, RemotePath) and place.is_dir():
            inside = _with_cameras(place, inside, metadata)
        found += inside
    return found


def _with_cameras(folder: Path, images: Sequence[Path], metadata: str | None) -> list[Path]:
    beside = [Path(metadata)] if metadata and Path(metadata).is_dir() else []
    left = [path for path in images if not _may_have_camera(path, [*beside, folder])]
    if not left or len(left) == len(images):
        return list(images)  # which of them lacks what is told later
    names = ", ".join(path.name for path in left[:_NAMED]) + (", ..." if len(left) > _NAMED else "")
    log.warning("%s: left out %s, without RPC tags and metadata files", folder, names)
    return [path for path in images if path not in left]


def _may_have_camera(path: Path, folders: Sequence[Path]) -> bool:
    """An image with RPC tags or a metadata file of its name, whatever is in it, or one that cannot be opened."""
    if sidecars(path, folders):
        return True
    try:
        with opened(path) as data:
            return bool(rpc_tags(data))
    except InputError:
        return True


def input_files(
    images: Sequence[Path], metadata: str | None, named: Iterable[str | None], colours: str | None
) -> list[Path]:
    """All files of this machine that `prep` reads.

    Args:
        images: the images.
        metadata: folder with metadata files, if any.
        named: other files that options name.
        colours: folder of multispectral images, if any.
    """
    paths = [location(name) for name in named if name] + (colour_files(colours) if colours else [])
    for image in images:
        folders = [*([Path(metadata)] if metadata else []), image.parent]
        local = [folder for folder in folders if not isinstance(folder, RemotePath) and folder.is_dir()]
        paths += [image, *sidecars(image, local)]
    return [path for path in paths if not isinstance(path, RemotePath)]


__all__ = ["images_with_cameras", "input_files"]
