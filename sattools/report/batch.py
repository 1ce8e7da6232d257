"""The page of a batch."""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from sattools.batch.configuration import COMMANDS
from sattools.batch.figure import means, speed_error_figure
from sattools.batch.table import SHORT
from sattools.errors import InputError
from sattools.report.page import Code, Picture, Section, Table, render
from sattools.report.parts import product
from sattools.scene.document import Scene, check_id
from sattools.scene.jsonio import JsonObject, read_text
from sattools.scene.raster import read_overview

_BEFORE = {"mosaic": "split", "split": "coarse"}  # part of a fit in tiles -> that which it goes on from
SHOWN = 24  # difference maps of more runs would make a page that no browser likes
NUMBERS = {name for name in SHORT if name.endswith("_m") or name in ("completeness", "seconds", "peak_memory_mb")}


def batch_page(folder: Path) -> str:
    """HTML of a folder that `sattools batch` has written. Raises InputError where there is no table."""
    rows = read_rows(folder / "table.csv")
    sections = [_speed(rows), _table(rows), _surfaces(folder, rows), _commands(folder, rows)]
    return render(f"Batch {folder.resolve().name}", sections)


def read_rows(path: Path) -> list[JsonObject]:
    """The rows of a batch's table, numbers as numbers, empty cells as None."""
    try:
        rows = list(csv.DictReader(io.StringIO(read_text(path))))
    except csv.Error as error:
        raise InputError(f"{path}: cannot be read ({error}), expected the table of a batch") from error
    needed = ("scene", "configuration", "status", "seconds", "mae_m")
    if not rows or not set(needed) <= rows[0].keys():
        raise InputError(f"{path}: found no rows of a batch, expected columns {', '.join(needed)}")
    if any(None in row or None in row.values() for row in rows):
        raise InputError(f"{path}: found a row with more or fewer cells than columns, expected the table of a batch")
    for row in rows:  # they become folder names below
        check_id(row["scene"], f"{path}: scene")
        check_id(row["configuration"], f"{path}: configuration")
    try:
        parsed = [{k: (float(v) if k in NUMBERS else v) if v else None for k, v in row.items()} for row in rows]
    except ValueError as error:
        raise InputError(f"{path}: found text where a number belongs ({error})") from error
    for row in parsed:
        for name in NUMBERS & row.keys():
            value = row[name]
            if isinstance(value, float) and not math.isfinite(value):
                raise InputError(f"{path}: found {name} {value} of {row['scene']}, expected a finite number")
    return parsed


def _speed(rows: list[JsonObject]) -> Section:
    section = Section("Error against time")
    figure = speed_error_figure(rows)
    if figure is not None:
        caption = (
            f"Means of {len(means(rows))} configurations over the scenes that all have scored (large), every scene "
            "(small); rings: no other configuration is both faster and better."
        )
        section.parts.append(Picture(figure, "Mean absolute error [m] over seconds", caption))
    return section


def _table(rows: list[JsonObject]) -> Section:
    shown = [name for name in SHORT if any(row.get(name) is not None for row in rows)]
    cells = [[_text(name, row.get(name)) for name in shown] for row in rows]
    caption = "Errors against the reference; time from images to surface model; table.csv has all columns."
    return Section("Results", [Table([SHORT[name] for name in shown], cells, caption)])


def _surfaces(folder: Path, rows: list[JsonObject]) -> Section:
    from sattools.compare.picture import difference_figure
    from sattools.export.datum import vertical_datum
    from sattools.export.hillshade import picture

    section = Section("Surfaces")
    done = [row for row in rows if row["status"] == "done"]
    for row in done[:SHOWN]:
        root, name = folder / "runs" / row["configuration"] / row["scene"], f"{row['scene']}, {row['configuration']}"
        scene = Scene.from_file(root / "scene.json") if (root / "scene.json").is_file() else None
        # by the document: `align` may have moved the surface, and a file may be that of an earlier run in the folder
        dsm, scored = (None, None) if scene is None else (product(scene, "dsm"), product(scene, "difference"))
        if dsm is not None:
            heights, grid = read_overview(dsm)
            figure = picture(heights[0], grid, name, vertical_datum(dsm))
            section.parts.append(Picture(figure, f"Heights of {name}", f"{name}: surface model, heights in metres."))
        if scored is not None:
            difference, grid = read_overview(scored)
            caption = f"{name}: registered surface minus reference [m], blue too low, red too high, grey not scored."
            section.parts.append(Picture(difference_figure(difference[0], grid, name), f"Errors of {name}", caption))
    if len(done) > SHOWN:
        section.parts.append(f"The first {SHOWN} of {len(done)} runs are shown.")
    return section


def _commands(folder: Path, rows: list[JsonObject]) -> Section:
    section = Section("How it was made")
    for name in dict.fromkeys(row["configuration"] for row in rows):
        scene = next((r["scene"] for r in rows if r["configuration"] == name and r["status"] == "done"), None)
        if scene is None:
            continue
        root = folder / "runs" / name / scene
        config = _read(root / "config.toml")
        if config:
            section.parts.append(Code(config, f"Options of {name} that are not the defaults:"))
        calls = _last_calls([line[2:] for line in _read(root / "log.txt").splitlines() if line.startswith("$ ")])
        if calls:
            section.parts.append(Code("\n".join(dict.fromkeys(calls)), f"Commands of {scene}, {name}:"))
    return section


def _last_calls(calls: Sequence[str]) -> list[str]:
    """Of the command lines of all runs in a folder those of the last one: as far back as they follow the pipe."""
    kept: list[str] = []
    for call in reversed(calls):
        before = next((_BEFORE[part] for part in _BEFORE if kept and _is_part(kept[0], part)), None)
        if before is not None:
            if not _is_part(call, before):  # the tiles that a run goes on with may be those of an earlier one
                continue
        elif kept and _place(call) > _place(kept[0]):
            break
        kept.insert(0, call)
    return kept


def _is_part(call: str, part: str) -> bool:
    return f" --part {part} " in f"{call} "


def _place(call: str) -> int:
    """Where a line's command stands in the pipe."""
    return next((COMMANDS.index(word) for word in call.split() if word in COMMANDS), 0)


def _read(path: Path) -> str:
    return path.read_text(encoding="utf-8", errors="replace") if path.is_file() else ""


def _text(name: str, value: Any) -> str:
    if value is None:
        return ""
    return f"{value:.{1 if name == 'seconds' else 0 if name == 'peak_memory_mb' else 3}f}" if name in NUMBERS else value


__all__ = ["batch_page", "read_rows"]
