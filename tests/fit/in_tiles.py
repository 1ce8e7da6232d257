"""The small scene in four tiles: the options of such a fit, and what tests ask of its parts."""

from typing import Any

import torch

from sattools.fit.checkpoint import load
from sattools.fit.options import FitOptions
from sattools.scene import Scene

TILED = FitOptions(resolution=1.0, epochs=[8], tile=16.0, overlap=4.0)


class Interrupted(Exception):
    """Stands for whatever ends a process."""


def model(scene: Scene) -> Any:
    return load(scene.root / "fit/model.safetensors")


def tile(scene: Scene, name: str) -> Scene:
    return Scene.from_file(scene.root / f"fit/tiles/{name}/scene.json")


def assert_same(found: dict[str, torch.Tensor], expected: dict[str, torch.Tensor]) -> None:
    """Bit for bit."""
    assert found.keys() == expected.keys()
    for name, tensor in expected.items():
        assert torch.equal(found[name].nan_to_num(-1), tensor.nan_to_num(-1)), name


def until(*words: str) -> tuple[list[tuple[float, str]], Any]:
    """A list of what is told, and what fills it and interrupts a fit that tells all of these words in one message."""
    said: list[tuple[float, str]] = []

    def progress(share: float, message: str) -> None:
        said.append((share, message))
        if words and all(word in message for word in words):
            raise Interrupted

    return said, progress
