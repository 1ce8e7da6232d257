"""What a page says of a scene that was moved onto a reference."""

from __future__ import annotations

import numpy as np

from sattools.report.page import Section, Table
from sattools.report.parts import number
from sattools.scene.document import Scene
from sattools.scene.jsonio import JsonObject, read_json
from sattools.scene.schema import Items, Number, Text
from sattools.scene.schema import Table as Members

_SHOWN = 15
_POINT = Members(
    {"name": Text(), "item": Text(), "before_px": Items(Number(), 2, 2), "after_px": Items(Number(), 2, 2)},
    ("name", "item", "before_px", "after_px"),
)
_TRANSFORM = Members({"residuals": Items(_POINT)})


def alignment_section(scene: Scene) -> Section:
    """The shifts, and of control points those that fit least."""
    section = Section("Onto a reference")
    for entry in scene.history:
        if entry.get("command") != "align":
            continue
        section.parts += [f"{note[0].upper()}{note[1:]}." for note in entry.get("notes", [])]
        path = scene.path(entry["transform"]) if entry.get("transform") else None
        if path is not None and path.is_file():
            transform = read_json(path, "a transform of `sattools align`")
            _TRANSFORM.check(transform, str(path))
            if transform.get("residuals"):
                section.parts.append(_points(transform["residuals"]))
    return section


def _points(residuals: list[JsonObject]) -> Table:
    def length(row: JsonObject, name: str) -> float:
        return float(np.hypot(*row[name]))

    worst = sorted(residuals, key=lambda row: -length(row, "after_px"))[:_SHOWN]
    rows = [
        [row["name"], row["item"], number(length(row, "before_px"), 2), *(number(v, 2) for v in row["after_px"])]
        for row in worst
    ]
    caption = "Control points, those first that fit least; what is left is measured minus projected."
    if len(residuals) > _SHOWN:
        caption += f" {_SHOWN} of {len(residuals)}."
    return Table(["point", "image", "before [px]", "column, left [px]", "row, left [px]"], rows, caption)


__all__ = ["alignment_section"]
