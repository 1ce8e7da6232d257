"""Metadata files that lie beside an image, found by their names."""

from __future__ import annotations

import re
from collections.abc import Iterable
from pathlib import Path

_PLANET = re.compile(r"(\d{8}_\d{6}_.+?)_(?:basic|ortho|1b|3b)(?:_|$)")  # names in lower case
_TILE = re.compile(r"_r(\d+)c(\d+)(?=-|$)", re.IGNORECASE)


def tile_of(stem: str) -> tuple[int, int] | None:
    """Row and column, from 1, of a file that is part of a vendor's product; None of others.

    Args:
        stem: the file's name without its ending.
    """
    match = _TILE.search(stem)
    return None if match is None else (int(match[1]), int(match[2]))


def sidecars(image: Path, folders: Iterable[Path]) -> list[Path]:
    """Metadata files that belong to an image by their names, in the order of the folders.

    Upper and lower case count only between files whose names differ in nothing else.
    """
    stem = image.stem.lower()
    core = re.sub(r"^(img|dim|rpc)_", "", stem)
    # Airbus writes IMG_<name>_R1C1.TIF beside DIM_<name>.XML and RPC_<name>.XML
    core_tile = _TILE.sub("", core)
    names = [f"{stem}.json", f"{stem}_rpc.txt", f"{stem}.rpb", f"{stem}.xml", f"{stem}.imd"]
    names += [f"{stem}_metadata.json", f"{stem}_metadata.xml", f"{stem}_rpc.xml", f"{stem}.rpc"]
    # of Pléiades Neo IMG_<name>_P_R1C1.TIF, or IMG_<name>_RGB_R1C1.TIF and IMG_<name>_NED_R1C1.TIF beside the same
    core_bands = re.sub(r"^(pneo\d.*)_(p|rgb|ned)$", r"\1", core_tile)
    for c in dict.fromkeys((core, core_tile, core_bands)):
        names += [f"rpc_{c}.xml", f"dim_{c}.xml"]
    # Planet writes <item>_basic_l1a_panchromatic_dn.tif, <item>_1B_AnalyticMS.tif beside <item>_metadata.json
    item = _PLANET.match(stem)
    if item is not None:
        names.append(f"{item[1]}_metadata.json")
    if re.search(_TILE.pattern + "-", stem, re.IGNORECASE):
        # DigitalGlobe writes <date>-M1BS_R1C1-<order>.TIF beside <date>-M1BS-<order>.RPB, .IMD, .XML and .TIL
        names += [f"{_TILE.sub('', stem)}.{ending}" for ending in ("rpb", "xml", "imd", "til")]
    beside = []
    for folder in folders:
        files = sorted((p for p in folder.iterdir() if p.is_file()), key=lambda p: (_spelt_as(image, p), p))
        listing = {p.name.lower(): p for p in files}
        beside += [listing[n] for n in dict.fromkeys(names) if n in listing and listing[n] != image]
    return list(dict.fromkeys(beside))


def _spelt_as(image: Path, path: Path) -> bool:
    """Whether a file has an image's name in its own upper and lower case."""
    name = _TILE.sub("", re.sub(r"(?i)^(img|dim|rpc)_", "", image.stem))
    return path.name.startswith(name) or path.name.partition("_")[2].startswith(name)


__all__ = ["sidecars", "tile_of"]
