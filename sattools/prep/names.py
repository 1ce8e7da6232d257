"""What images are called: ids of items, and the scene's name."""

from __future__ import annotations

import hashlib
import os
import re
import unicodedata
from collections import Counter
from collections.abc import Sequence
from pathlib import Path

from sattools.errors import InputError
from sattools.scene.location import RemotePath

_LONGEST = 128  # letters of an id


def image_id(path: Path) -> str:
    """The item's name: the file's stem with everything odd replaced, and letters of other scripts by their numbers."""
    stem = "".join(f"u{ord(c):04x}" if c.isalnum() and not _latin(c) else c for c in path.stem)
    name = re.sub(r"[^A-Za-z0-9._-]+", "_", stem).lstrip("._-")
    if len(name) > _LONGEST and stem != path.stem:  # five letters for one: what tells names apart may come late
        digest = hashlib.sha256(stem.encode(errors="surrogatepass")).hexdigest()[:8]
        name = f"{name[: _LONGEST - 9]}-{digest}"
    name = name[:_LONGEST]
    if not name:
        raise InputError(f"{path}: found a name without letters or digits, expected one that can serve as an id")
    return name


def _latin(letter: str) -> bool:
    return letter.isascii() or unicodedata.name(letter, "").startswith("LATIN ")


def common_name(ids: Sequence[str]) -> str:
    """What image names have in common, up to a separator; `scene` when that is nothing."""
    first, last = min(ids), max(ids)
    n = next((k for k, (a, b) in enumerate(zip(first, last, strict=False)) if a != b), min(len(first), len(last)))
    head = first[:n]
    cut = max(head.rfind(s) for s in "_-.")
    return (head[:cut].rstrip("_-.") if cut > 0 else "") or "scene"


def check_ids(images: Sequence[Path]) -> list[str]:
    """Ids of all images; InputError when there are fewer than two images or two have the same id, but for its case."""
    for path in images:
        _check_there(path)
    if len(images) < 2:
        problem = f"{images[0]}: found this one image only" if images else "prep: found no image"
        raise InputError(f"{problem}, expected at least 2 images of one place")
    ids = [image_id(p) for p in images]
    twice = [i for i, n in Counter(ids).items() if n > 1]
    if twice:
        paths = [p for p, i in zip(images, ids, strict=True) if i == twice[0]]
        if os.path.abspath(paths[0]) == os.path.abspath(paths[1]):
            raise InputError(f"{paths[1]}: found this image twice, expected every image once")
        expected = "expected unique file names"
        if paths[0].stem != paths[1].stem:
            expected = f"expected names that differ in their first {_LONGEST} letters a to z, digits, '.', '_' and '-'"
        raise InputError(f"{paths[1]}: found id {twice[0]!r}, which {paths[0]} has too, {expected}")
    first: dict[str, int] = {}
    for k, own in enumerate(ids):
        if (j := first.setdefault(own.lower(), k)) != k:
            raise InputError(
                f"{images[k]}: found id {own!r}, which differs from {ids[j]!r} of {images[j]} by its case only, "
                "expected names that differ on disks without case, too"
            )
    return ids


def _check_there(path: Path) -> None:
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


__all__ = ["check_ids", "common_name", "image_id"]
