"""Where the Data Fusion Contest 2019 (track 3) keeps the images, metadata and reference of an area."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Literal

from sattools.errors import InputError

Imagery = Literal["auto", "crops", "rgb", "msi"]
_CROPS, _RGB, _MSI = "Track3-RGB-crops", "Track3-RGB*", "Track3-MSI*"


def find_images(root: Path, aoi: str, imagery: Imagery = "auto") -> tuple[list[Path], Path | None]:
    """Images of an area such as `JAX_068` below the contest's root, and the folder of their metadata, if any.

    Args:
        root: folder that holds `Track3-RGB-1`, `Track3-MSI-1`, ..., `Track3-Truth`, or Sat-NeRF's `Track3-RGB-crops`.
        aoi: name of the area.
        imagery: Sat-NeRF's crops, the contest's RGB or MSI tiles; auto = the first of these that is there.

    Raises:
        InputError: no such folder, not the name of an area, or no image of it.
    """
    if not root.is_dir():
        raise InputError(f"{root}: found no such folder, expected the root of the contest's data")
    if not re.fullmatch(r"[A-Z]{3}_\d{3}", aoi):
        raise InputError(f"aoi: found {aoi!r}, expected an area of the contest such as JAX_068")
    crops = _files(root, f"{_CROPS}/**/{aoi}_*_RGB.tif")
    choices = {
        "crops": crops,
        # the contest's tiles come in several folders; one image never lies in two of them
        "rgb": [p for p in _files(root, f"{_RGB}/**/{aoi}_*_RGB.tif") if p not in crops],
        "msi": _files(root, f"{_MSI}/**/{aoi}_*_MSI.tif"),
    }
    if imagery != "auto":
        choices = {imagery: choices[imagery]}
    images = next((choice for choice in choices.values() if choice), [])
    if not images:
        pattern = f"{_MSI}/**/{aoi}_*_MSI.tif" if imagery == "msi" else f"{_RGB}/**/{aoi}_*_RGB.tif"
        raise InputError(f"{root}: found no {pattern}, expected the contest's images of {aoi}")
    metadata = [p for p in (root / "rpc_raw" / aoi, root / "metadata" / aoi) if p.is_dir()]
    return images, metadata[0] if metadata else None


def is_crop(image: Path) -> bool:
    """The image is one of Sat-NeRF's crops, which show the area alone; the contest's tiles show more."""
    return _CROPS in image.parts


def find_truth(root: Path, aoi: str) -> Path | None:
    """Folder with `<AOI>_DSM.tif`, its `.txt` and class map, or None."""
    files = _files(root, f"Track3-Truth*/**/{aoi}_DSM.tif")
    return files[0].parent if files else None


def _files(root: Path, pattern: str) -> list[Path]:
    return sorted(p for p in root.glob(pattern) if p.is_file())


__all__ = ["Imagery", "find_images", "find_truth", "is_crop"]
