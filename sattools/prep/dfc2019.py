"""Where the Data Fusion Contest 2019 (track 3) keeps the images and metadata of an area."""

from __future__ import annotations

import re
from pathlib import Path

from sattools.errors import InputError


def find_images(root: Path, aoi: str) -> tuple[list[Path], Path | None]:
    """RGB crops of an area such as `JAX_068` below the contest's root, and the folder of their metadata, if any."""
    if not root.is_dir():
        raise InputError(f"{root}: found no such folder, expected the root of the contest's data")
    if not re.fullmatch(r"[A-Z]{3}_\d{3}", aoi):
        raise InputError(f"aoi: found {aoi!r}, expected an area of the contest such as JAX_068")
    images = sorted(p for p in root.glob(f"Track3-RGB*/**/{aoi}_*_RGB.tif") if p.is_file())
    if not images:
        raise InputError(f"{root}: found no Track3-RGB*/**/{aoi}_*_RGB.tif, expected the contest's image crops")
    metadata = [p for p in (root / "rpc_raw" / aoi, root / "metadata" / aoi) if p.is_dir()]
    return images, metadata[0] if metadata else None


__all__ = ["find_images"]
