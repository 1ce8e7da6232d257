"""Work on a scene without touching its folder."""

from __future__ import annotations

from pathlib import Path

from sattools.scene.document import Scene
from sattools.scene.raster import write_text


def in_another_root(path: Path, root: Path) -> Path:
    """A copy of a scene's document that reads its files where they are and writes below `root`; the copy's path."""
    scene = Scene.from_file(path)
    for item in scene.items:
        for asset in item.assets.values():
            asset.href = str(scene.path(asset.href))
    scene.products = {name: str(scene.path(href)) for name, href in scene.products.items()}
    scene.root = Path(root).absolute()
    copy = scene.output("scene.json")
    write_text(copy, scene.to_json() + "\n")
    return copy


__all__ = ["in_another_root"]
