"""Samples along rays, compositing, sun visibility, shading.

Names are looked up when they are asked for: `shadows` and the kernels do without PyTorch, whose import takes a second.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from sattools.render.surface import render
    from sattools.render.view import ParallelRays, Quadrature
    from sattools.render.visibility import plate_slopes, sun_visibility

_FROM = {
    "render": "surface", "ParallelRays": "view", "Quadrature": "view", "plate_slopes": "visibility",
    "sun_visibility": "visibility",
}  # fmt: skip


def __getattr__(name: str) -> Any:
    if name in _FROM:
        return getattr(importlib.import_module(f"{__name__}.{_FROM[name]}"), name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


__all__ = ["ParallelRays", "Quadrature", "plate_slopes", "render", "sun_visibility"]
