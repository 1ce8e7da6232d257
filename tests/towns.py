"""Copies of simulated scenes, with what was made of them."""

import shutil
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from sattools import api
from sattools.scene import Scene


@dataclass(frozen=True)
class Done:
    """A scene on which a stage was run, what that found, and what it told on the way; tests must leave it alone."""

    scene: Scene
    found: dict[str, Any]
    told: list[tuple[float, str]]


def copied(source: Scene, root: Path) -> Scene:
    """The scene and all its files in a folder of its own, which gives it its name."""
    shutil.copytree(source.root, root)
    scene = Scene.from_json(source.to_json())
    scene.id, scene.root = root.name, root
    (root / "scene.json").write_text(scene.to_json() + "\n")
    return scene


def matched(source: Scene, root: Path) -> Scene:
    """A copy that has the prior that `fit` would make of it."""
    return api.match(copied(source, root))


def northern_half(scene: Scene) -> Scene:
    """The same images of half of the area: as many tiles side by side as the whole has in a row."""
    grid = scene.require_grid()
    return replace(scene, grid=grid.part(slice(0, grid.height // 2), slice(0, grid.width)))
