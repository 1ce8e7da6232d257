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
    return os.path.relpath(path, root) if path.is_relative_to(scene.root) else str(path)


def _copy(scene: Scene, root: Path, named: Callable[[str], str]) -> Scene:
    copy = Scene.from_json(scene.to_json())
    for item in copy.items:
        for asset in item.assets.values():
            asset.href = named(asset.href)
    copy.products = {name: named(href) for name, href in scene.products.items()}
    copy.root = Path(root).absolute()
    return copy


def in_another_root(path: Path, root: Path) -> Path:
    """`absolute_copy` of a scene's document; the path of the copy's."""
    copy = absolute_copy(Scene.from_file(path), root)
    return copy.write()


__all__ = ["absolute_copy", "href_of_part", "in_another_root", "part_copy"]
