"""Work on a scene without touching its folder."""

from __future__ import annotations

from pathlib import Path

from sattools.scene.document import Scene


def absolute_copy(scene: Scene, root: Path) -> Scene:
    """A copy of a scene that reads its files where they are and writes below `root`."""
    copy = Scene.from_json(scene.to_json())
    for item in copy.items:
        for asset in item.assets.values():
            asset.href = str(scene.path(asset.href))
    copy.products = {name: str(scene.path(href)) for name, href in scene.products.items()}
    copy.root = Path(root).absolute()
    return copy


def in_another_root(path: Path, root: Path) -> Path:
    """`absolute_copy` of a scene's document; the path of the copy's."""
    copy = absolute_copy(Scene.from_file(path), root)
    return copy.write()


__all__ = ["absolute_copy", "in_another_root"]
