"""What a fit in tiles leaves below `fit/tiles`, found again and removed; files of other origin stay there."""

from __future__ import annotations

import re
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path

from sattools.errors import OutputExistsError, SattoolsError, SceneError
from sattools.fit.files import CHECKPOINT, MODEL, TRACE
from sattools.fit.tiles.state import COARSE, STATE, read_state
from sattools.prior.files import MAPS, SURROUNDINGS
from sattools.prior.resume import kept_in
from sattools.runlog import NAME
from sattools.scene import Scene
from sattools.scene.dependencies import STAGES
from sattools.scene.document import PARTS
from sattools.scene.files import remove_orphans

COMMON = f"{PARTS}/common.safetensors"
WHOLE = f"{PARTS}/scene.json"  # the document of the whole as it was cut
_PART = re.compile(rf"{COARSE}|(pilot\.)?r\d+c\d+")
_OF_BATCHES = ("task.json", "begun.json", "attempts.jsonl", "config.toml", "log.txt")
_IN_PARTS = ("scene.json", MODEL, TRACE, CHECKPOINT, *MAPS.values(), SURROUNDINGS, NAME, f"{NAME}.1", *_OF_BATCHES)
_STAGES = ("normalise", "prior", "fit")  # what is done of a part before it is joined


def check_clear(root: Path) -> None:
    """Whether tiles may be begun where no fit has noted any.

    Args:
        root: folder of the scene.

    Raises:
        OutputExistsError: there is a file that they would replace.
        SceneError: a damaged list of tiles.
    """
    if read_state(root) is None and (there := next(_made(root), None)):
        raise OutputExistsError(f"{there}: exists already; give --overwrite to replace it")


def remove_parts(root: Path) -> None:
    """Remove what a fit in tiles has left, and the folders that are empty then.

    Args:
        root: folder of the scene.

    Raises:
        SattoolsError: a file cannot be removed.
    """
    remove_orphans(root / PARTS)
    for path in list(_made(root)):
        try:
            path.unlink(missing_ok=True)
        except OSError as error:
            raise SattoolsError(f"{path}: cannot be removed ({error.strerror})") from error
        with suppress(OSError):  # the first folder that holds something else
            for folder in path.relative_to(root / PARTS).parents:
                (root / PARTS / folder).rmdir()


def _made(root: Path) -> Iterator[Path]:
    """The files that a fit in tiles has left, of an earlier one too: the list of tiles comes last."""
    folder = root / PARTS
    if not folder.is_dir():
        return
    parts = sorted(path for path in folder.iterdir() if path.is_dir() and _PART.fullmatch(path.name))
    found = [path for part in parts for path in (*_named(part), *(part / name for name in _IN_PARTS), *kept_in(part))]
    found += [root / name for name in (COMMON, WHOLE, STATE)]
    yield from (path for path in dict.fromkeys(found) if path.is_symlink() or path.is_file())


def _named(part: Path) -> list[Path]:
    """The files that lie in the folder of a part and that its document names as made of it."""
    try:
        scene = Scene.from_file(part / "scene.json")
    except SattoolsError:
        return []
    stages = [STAGES[name] for name in _STAGES]
    hrefs = [scene.products[name] for stage in stages for name in stage.products if name in scene.products]
    assets = [name for stage in stages for name in stage.assets]
    hrefs += [item.assets[name].href for item in scene.items for name in assets if name in item.assets]
    paths = []
    for href in hrefs:
        with suppress(SceneError):
            paths.append(scene.path(href))
    # what it reads of the whole is named by `..` or a link
    return [path for path in map(Path, paths) if path.resolve().is_relative_to(part.resolve())]


__all__ = ["COMMON", "WHOLE", "check_clear", "remove_parts"]
