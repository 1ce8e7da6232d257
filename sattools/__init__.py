"""Satellite images with RPC cameras to surface models and reflectance maps by differentiable rendering.

    import sattools

    scene = sattools.prepare(["a.tif", "b.tif", "c.tif"])
    scene = sattools.export(sattools.fit(scene))
    print(scene.dsm())

See `sattools.api` for the functions; nothing heavy is imported before it is used.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

__version__ = "0.2.0"

if TYPE_CHECKING:
    from sattools.api import match, normalise, prepare
    from sattools.camera.rpc import RPC
    from sattools.scene import Grid, Scene

_HOMES = {
    "Scene": "sattools.scene", "Grid": "sattools.scene", "RPC": "sattools.camera.rpc", "prepare": "sattools.api",
    "normalise": "sattools.api", "match": "sattools.api",
}  # fmt: skip
# packages that can be called, see `sattools.callable_module`
_STAGES = ("fit", "export", "align", "compare", "change", "simulate")


def __getattr__(name: str) -> Any:
    if name in _HOMES:
        return getattr(importlib.import_module(_HOMES[name]), name)
    if name in _STAGES:
        return importlib.import_module(f"sattools.{name}")
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted({*globals(), *_HOMES, *_STAGES})


__all__ = [
    "RPC", "Grid", "Scene", "__version__", "align", "change", "compare", "export", "fit", "match", "normalise",
    "prepare", "simulate",
]  # fmt: skip
