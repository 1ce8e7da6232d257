"""The table of a batch: one row a scene and configuration."""

from __future__ import annotations

import csv
import importlib.util
import io
import logging
from collections.abc import Collection, Sequence
from pathlib import Path
from typing import Any

from sattools.errors import InputError
from sattools.scene.dependencies import EARLIER_SECONDS, PRIOR_SECONDS, current_entry
from sattools.scene.document import Scene
from sattools.scene.files import write_bytes, write_text
from sattools.scene.jsonio import JsonObject, read_text

log = logging.getLogger(__name__)
Row = dict[str, Any]
TABLES = ("table.csv", "table.md", "table.parquet")
TIMED = ("prep", "normalise", "prior", "fit", "export")
ERRORS = ("mae", "median", "rmse", "nmad", "completeness", "within_1m", "within_2_5m", "mae_filled")
CLASSES = ("ground", "trees", "buildings")
COLUMNS = (
    *("scene", "configuration", "status"),
    *("mae_m", "median_m", "rmse_m", "nmad_m", "completeness", "within_1m", "within_2_5m", "mae_filled_m"),
    *(f"{name}_mae_m" for name in CLASSES),
    *("seconds", *(f"{name}_s" for name in TIMED), "fit_prior_s", "peak_memory_mb", "cells", "protocol"),
    *("sattools", "python", "numpy", "torch", "rasterio", "error"),
)
TEXTS = ("scene", "configuration", "status", "protocol", "sattools", "python", "numpy", "torch", "rasterio", "error")
# what a page has room for: column -> heading
SHORT = {
    "scene": "scene",
    "configuration": "configuration",
    "status": "status",
    "mae_m": "MAE [m]",
    "median_m": "median [m]",
    "completeness": "completeness",
    "ground_mae_m": "ground [m]",
    "trees_mae_m": "trees [m]",
    "buildings_mae_m": "buildings [m]",
    "seconds": "seconds",
    "peak_memory_mb": "memory [MB]",
    "sattools": "version",
    "error": "error",
}


def make_row(scene: str, configuration: str, path: Path) -> Row:
    """The row of a finished scene, from its history; seconds are those of the steps up to `export`.

    Args:
        scene: its id.
        configuration: its name.
        path: of the scene's document.
    """
    done = Scene.from_file(path)
    # what another fit left in the history, or scored, is not this run's
    last = {name: entry for name in (*TIMED, "compare") if (entry := current_entry(done, name)) is not None}
    steps = {name: last[name] for name in TIMED if name in last}
    row: Row = {"scene": scene, "configuration": configuration, "status": "done"}
    # a fit in tiles says what its parts took, each a command of its own
    parts = [entry["parts"] for entry in steps.values() if "parts" in entry]
    row |= {f"{name}_s": round(_seconds(entry), 3) for name, entry in steps.items()}
    row["seconds"] = round(sum(row[f"{name}_s"] for name in steps), 3)
    if "fit" in steps:  # of its seconds, where no `prior` went before it
        row["fit_prior_s"] = steps["fit"].get(PRIOR_SECONDS) or steps["fit"].get("parts", {}).get(PRIOR_SECONDS)
    row["peak_memory_mb"] = max((entry["peak_memory_mb"] for entry in [*steps.values(), *parts]), default=None)
    for entry in steps.values():
        row |= entry["versions"]
    figures = last.get("compare", {}).get("errors", {})
    for name in ERRORS:
        unit = "_m" if name in ("mae", "median", "rmse", "nmad", "mae_filled") else ""
        row[name + unit] = figures.get(name)
    for name in CLASSES:
        row[f"{name}_mae_m"] = figures.get("classes", {}).get(name, {}).get("mae")
    row |= {"cells": figures.get("cells"), "protocol": figures.get("protocol")}
    return row


def _seconds(entry: JsonObject) -> float:
    """What a step took, with what it went on with after an interruption."""
    before = float(entry.get(EARLIER_SECONDS) or 0.0)
    return float(entry["seconds"]) + float(entry.get("parts", {}).get("seconds", 0.0)) + before


def failed_row(scene: str, configuration: str, status: str, error: str) -> Row:
    """The row of a scene without a result.

    Args:
        scene: its id.
        configuration: its name.
        status: of the task.
        error: why.
    """
    return {"scene": scene, "configuration": configuration, "status": status, "error": error}


def earlier_rows(out: Path, pairs: Collection[tuple[str, str]]) -> list[Row]:
    """What the table of earlier calls in a folder says of runs that are still there, but for those of this call.

    Args:
        out: folder of the tables.
        pairs: (scene, configuration) of this call.
    """
    path = out / TABLES[0]
    if not path.exists():
        return []
    try:
        # of another origin, it is replaced as what it is
        found = [row for row in csv.DictReader(io.StringIO(read_text(path))) if row.keys() >= {*COLUMNS[:3]}]
        rows = [_parsed(row) for row in found]
    except (InputError, csv.Error, ValueError) as error:
        log.warning("%s: cannot be read (%s), the rows of earlier calls are left out", path, error)
        return []
    known = [row for row in rows if all(isinstance(row[name], str) for name in COLUMNS[:3])]
    others = [row for row in known if (row["scene"], row["configuration"]) not in pairs]
    return [row for row in others if (out / "runs" / row["configuration"] / row["scene"]).is_dir()]


def _parsed(row: dict[str, str]) -> Row:
    """A row of the table with numbers as numbers; ValueError where there is something else in their place."""
    return {name: _value(name, row[name]) if row.get(name) else None for name in COLUMNS}


def _value(name: str, text: str) -> str | float:
    if name in TEXTS:
        return text
    return int(text) if text.isdecimal() else float(text)


def write_tables(rows: Sequence[Row], out: Path) -> list[Path]:
    """`table.csv`, `table.md`, and `table.parquet` where pyarrow is installed; the files written."""
    written = [out / name for name in TABLES[:2]]
    write_text(written[0], to_csv(rows))
    write_text(written[1], to_markdown(rows))
    if importlib.util.find_spec("pyarrow"):
        import pyarrow
        from pyarrow.parquet import write_table

        # a column has its type even where no row has a value
        kinds = {name: pyarrow.string() if name in TEXTS else pyarrow.float64() for name in COLUMNS}
        columns = {name: pyarrow.array([row.get(name) for row in rows], kind) for name, kind in kinds.items()}
        written.append(out / TABLES[2])
        stream = io.BytesIO()
        write_table(pyarrow.table(columns), stream)
        write_bytes(written[-1], stream.getbuffer())
    return written


def to_csv(rows: Sequence[Row]) -> str:
    """All columns."""
    text = io.StringIO()
    writer = csv.DictWriter(text, list(COLUMNS), lineterminator="\n", extrasaction="ignore")
    writer.writeheader()
    writer.writerows(rows)
    return text.getvalue()


def to_markdown(rows: Sequence[Row]) -> str:
    """The columns of `SHORT` that have a value in some row."""
    shown = [name for name in SHORT if any(row.get(name) is not None for row in rows)]
    lines = ["| " + " | ".join(SHORT[name] for name in shown) + " |", "|" + "---|" * len(shown)]
    lines += ["| " + " | ".join(_text(name, row.get(name)) for name in shown) + " |" for row in rows]
    return "\n".join(lines) + "\n"


def _text(name: str, value: Any) -> str:
    if value is None:
        return ""
    if isinstance(value, float):
        digits = 1 if name == "seconds" else 0 if name == "peak_memory_mb" else 4 if name == "completeness" else 3
        return f"{value:.{digits}f}"
    return " ".join(str(value).split()).replace("|", "\\|")


__all__ = [
    "COLUMNS",
    "SHORT",
    "TABLES",
    "Row",
    "earlier_rows",
    "failed_row",
    "make_row",
    "to_csv",
    "to_markdown",
    "write_tables",
]
