"""Work on a scene without touching its folder."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path

from sattools.scene.document import Scene


def absolute_copy(scene: Scene, root: Path) -> Scene:
    """A copy of a scene that reads its files where they are and writes below `root`."""
    return _copy(scene, root, lambda href: str(scene.path(href)))


def part_copy(scene: Scene, root: Path) -> Scene:
    """A copy of a scene for a part of it, whose folder lies in the scene's own and goes with it when that is moved."""
    return _copy(scene, root, lambda href: href_of_part(scene, root, scene.path(href)))


def href_of_part(scene: Scene, root: Path, path: Path) -> str:
    """How a part of a scene, whose folder ``root`` lies below the scene's, names a file: relative where that has it."""
    return Path(os.path.relpath(path, root)).as_posix() if path.is_relative_to(scene.root) else str(path)


def _copy(scene: Scene, root: Path, named: Callable[[str], str]) -> Scene:
    copy = Scene.from_json(scene.to_json())
    for item in copy.items:
        for asset in item.assets.values():
            asset.href = named(asset.href)
    copy.products = {name: named(href) for name, href in scene.products.items()}
    copy.root = Path(root).absolute()
    return copy


def in_another_root(document: Path, root: Path, together: Path | None = None) -> Path:
    """A copy of a scene's document that reads the scene's files and writes below `root`.

    What a scene has in a folder that may be moved or copied as a whole gets a second name there (a hard link), so that
    the copy finds it beside itself, whatever becomes of the first one. Files of other places stay where they are.

    Args:
        document: of the scene.
        root: folder of the copy, below ``together``; that of the scene itself leaves all names as they are.
        together: the folder that may be moved; None = there is none, and all files stay where they are.

    Returns: path of the copy's document.
    """
    scene = Scene.from_file(document)
    root = Path(root).absolute()
    own = together is not None and scene.root.is_relative_to(together)

    def named(href: str) -> str:
        path = scene.path(href)
        if own and path.is_relative_to(scene.root) and _linked(path, root / path.relative_to(scene.root)):
            return path.relative_to(scene.root).as_posix()
        return str(path)

    return _copy(scene, root, (lambda href: href) if scene.root == root else named).write()


def _linked(path: Path, name: Path) -> bool:
    """Give a file a second name; whether the file system could."""
    try:
        if name.exists() and name.samefile(path):  # by a link between folders it may be the only one
            return True
        name.parent.mkdir(parents=True, exist_ok=True)
        name.unlink(missing_ok=True)  # of an earlier copy
        name.hardlink_to(path)
    except OSError:
        return False
    return True


__all__ = ["absolute_copy", "href_of_part", "in_another_root", "part_copy"]
