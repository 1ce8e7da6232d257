"""What the sections of a scene's page share."""

from __future__ import annotations

import csv
import io
from pathlib import Path
from typing import Any

from sattools.scene.document import Scene
from sattools.scene.jsonio import read_text


def product(scene: Scene, name: str) -> Path | None:
    """File of a product, None where the scene has none."""
    path = scene.path(scene.products[name]) if name in scene.products else None
    return path if path is not None and path.is_file() else None


def number(value: Any, digits: int) -> str:
    """A number with so many digits, nothing for None."""
    return "" if value is None else f"{float(value):.{digits}f}"


def trace_rows(scene: Scene) -> list[dict[str, float]]:
    """The lines of the fit's trace that have a time and a loss; empty without one."""
    path = product(scene, "trace")
    if path is None:
        return []
    rows = [
        {k: float(v) for k, v in row.items() if isinstance(v, str) and _is_number(v)}
        for row in csv.DictReader(io.StringIO(read_text(path)))
    ]
    return [row for row in rows if {"seconds", "loss"} <= row.keys()]


def _is_number(text: str | None) -> bool:
    try:
        float(text or "")
    except ValueError:
        return False
    return True


__all__ = ["number", "product", "trace_rows"]
