"""Score surfaces, parameter maps and images against references."""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from sattools.compare.heights import height_errors
    from sattools.compare.metrics import image_errors, map_errors
    from sattools.compare.options import CompareOptions
    from sattools.compare.registration import Registration, register
    from sattools.compare.stage import compare, compare_dsm, compare_file
    from sattools.compare.surface import Comparison
    from sattools.compare.text import table
    from sattools.compare.truth import Truth, read_dfc2019, read_reference, read_truth

_HOMES = {
    "heights": ("height_errors",),
    "metrics": ("image_errors", "map_errors"),
    "options": ("CompareOptions",),
    "registration": ("Registration", "register"),
    "stage": ("compare", "compare_dsm", "compare_file"),
    "surface": ("Comparison",),
    "text": ("table",),
    "truth": ("Truth", "read_dfc2019", "read_reference", "read_truth"),
}


def __getattr__(name: str) -> Any:
    # imported when used: the command's help needs the options alone
    for home, names in _HOMES.items():
        if name in names:
            return getattr(importlib.import_module(f"sattools.compare.{home}"), name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


__all__ = [
    "CompareOptions",
    "Comparison",
    "Registration",
    "Truth",
    "compare",
    "compare_dsm",
    "compare_file",
    "height_errors",
    "image_errors",
    "map_errors",
    "read_dfc2019",
    "read_reference",
    "read_truth",
    "register",
    "table",
]
