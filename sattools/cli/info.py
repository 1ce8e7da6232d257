"""`sattools info`: what is in a scene."""

from __future__ import annotations

from typing import TYPE_CHECKING

import click

from sattools.cli.options import scene_argument
from sattools.cli.pipe import each_scene

if TYPE_CHECKING:
    from sattools.scene import Scene


@click.command("info")
@scene_argument
def command(scenes: tuple[str, ...]) -> None:
    """Print a summary of scenes on stdout (no scene document: the end of a pipe)."""

    def show(scene: Scene) -> str:
        from sattools.scene.summary import summary

        return summary(scene)

    each_scene("info", scenes, show)
