"""Metadata files that lie beside an image, found by their names."""

from __future__ import annotations

import re
from collections.abc import Iterable
from pathlib import Path


def sidecars(image: Path, folders: Iterable[Path]) -> list[Path]:
    """Metadata files that belong to an image by their names, in the order of the folders.

    Upper and lower case count only between files whose names differ in nothing else.
    """
    stem = image.stem.lower()
    core = re.sub(r"^(img|dim|rpc)_", "", stem)
    # Airbus writes IMG_<name>_R1C1.TIF beside DIM_<name>.XML and RPC_<name>.XML
    core_tile = re.sub(r"_r\d+c\d+$", "", core)
    names = [f"{stem}.json", f"{stem}_rpc.txt", f"{stem}.rpb", f"{stem}.xml", f"{stem}.imd"]
    names += [f"{stem}_metadata.json", f"{stem}_metadata.xml", f"{stem}_rpc.xml", f"{stem}.rpc"]
    for c in dict.fromkeys((core, core_tile)):
        names += [f"rpc_{c}.xml", f"dim_{c}.xml"]
    beside = []
    for folder in folders:
        files = sorted((p for p in folder.iterdir() if p.is_file()), key=lambda p: (_spelt_as(image, p), p))
        listing = {p.name.lower(): p for p in files}
        beside += [listing[n] for n in dict.fromkeys(names) if n in listing and listing[n] != image]
    return list(dict.fromkeys(beside))


def _spelt_as(image: Path, path: Path) -> bool:
    """Whether a file has an image's name in its own upper and lower case."""
    name = re.sub(r"(?i)^(img|dim|rpc)_|_r\d+c\d+$", "", image.stem)
    return path.name.startswith(name) or path.name.partition("_")[2].startswith(name)


__all__ = ["sidecars"]
