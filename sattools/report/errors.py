"""The page's section about errors against a reference."""

from __future__ import annotations

from typing import Any

from sattools.report.figures import error_over_time, errors_by
from sattools.report.page import Picture, Section, Table
from sattools.report.parts import number, product, trace_rows
from sattools.scene.dependencies import PRIOR_SECONDS, in_force
from sattools.scene.document import Scene
from sattools.scene.jsonio import JsonObject, read_json
from sattools.scene.schema import Items, Maybe, Number, Text
from sattools.scene.schema import Table as Members

_LENGTH = Maybe(Number())
_SLOPE = ("from_deg", "to_deg", "mae", "median", "n")
_PLACE = Maybe(Members(dict.fromkeys(("signed", "absolute", "share"), _LENGTH)))
_FIGURES: dict[str, Any] = dict.fromkeys(("mae", "median", "rmse", "nmad", "completeness", "within_1m", "n"), _LENGTH)
_FIGURES |= {"mae_centred": _LENGTH, "mae_capped_5m": _LENGTH, "near_steps": _PLACE, "away_from_steps": _PLACE}
_ERRORS = Members(
    {
        **_FIGURES,
        "completeness": Number(),
        "within_1m": Number(),
        "cells": Maybe(Number(0)),
        "classes": Maybe(Members(other=Members(_FIGURES))),
        "shift_m": Items(Number(), 3, 3),
        "slopes": Maybe(Items(Members(dict.fromkeys(_SLOPE, Number()), _SLOPE))),
        "protocol": Text(),
        "reference": Text(),
        "mask": Text(empty=True),
    },
    ("shift_m", "protocol", "reference", "mask", "completeness", "within_1m"),
)


def errors_section(scene: Scene) -> Section:
    """What `compare` has found; empty where the scene has not been compared."""
    section = Section("Errors")
    path = product(scene, "errors")
    if path is None:
        return section
    figures = read_json(path, "a table of `sattools compare`")
    _ERRORS.check(figures, str(path))
    rows = [_error_row("all", figures, figures.get("cells"))]
    rows += [_error_row(name, own, own["n"]) for name, own in (figures.get("classes") or {}).items() if own.get("n")]
    east, north, up = figures["shift_m"]
    caption = (
        f"Protocol {figures['protocol']}, reference {figures['reference']}; scored: {figures['mask']}. "
        f"Registered by {east:+.2f} m east, {north:+.2f} m north, {up:+.2f} m up. "
        f"Completeness {100 * figures['completeness']:.2f} %, within 1 m {100 * figures['within_1m']:.1f} %."
    )
    section.parts.append(Table(["cells", "MAE [m]", "median [m]", "RMSE [m]", "NMAD [m]", "n"], rows, caption))
    if "near_steps" in figures:
        section.parts.append(_step_table(figures))
    section.parts.append(_bars(figures))
    section.parts.append(_over_time(scene, figures))
    return section


def _step_table(figures: JsonObject) -> Table:
    """Errors beside height steps and away from them."""
    rows = []
    for name, own in {"all": figures, **(figures.get("classes") or {})}.items():
        near, away = own.get("near_steps") or {}, own.get("away_from_steps") or {}
        shown = [own.get("mae_centred"), own.get("mae_capped_5m"), near.get("share"), near.get("signed")]
        shown += [near.get("absolute"), away.get("signed"), away.get("absolute")]
        if own.get("mae_centred") is not None:
            rows.append([name, *(number(value, 3) for value in shown)])
    names = ["cells", "MAE [m]", "each at most 5 m [m]", "share beside steps", "signed there [m]", "absolute there [m]"]
    caption = "Errors about the median; beside steps: within 2 m of a step of more than 3 m in the reference."
    return Table([*names, "signed elsewhere [m]", "absolute elsewhere [m]"], rows, caption)


def _error_row(name: str, figures: JsonObject, cells: int | None) -> list[str]:
    return [name, *(number(figures.get(key), 3) for key in ("mae", "median", "rmse", "nmad")), str(cells or "")]


def _bars(figures: JsonObject) -> Picture | str:
    """Errors by class and by slope."""
    groups: dict[str, list[tuple[str, float, float, int]]] = {}
    classes = [(name, own) for name, own in (figures.get("classes") or {}).items() if own.get("n")]
    if classes:
        groups["class"] = [(name, own["mae"], own["median"], int(own["n"])) for name, own in classes]
    if figures.get("slopes"):
        groups["slope of the reference [degrees]"] = [
            (f"{row['from_deg']:g}-{row['to_deg']:g}", row["mae"], row["median"], int(row["n"]))
            for row in figures["slopes"]
        ]
    if not groups:
        return "This table of errors says nothing of slopes or classes: run `sattools compare` again."
    caption = f"Mean and median of the absolute error by {' and by '.join(groups)}; below: how many cells."
    return Picture(errors_by(groups), "Errors by class and slope", caption)


def _over_time(scene: Scene, figures: JsonObject) -> Picture:
    """Error against time: of the fit's passes, where it was watched, and of the surface as it was exported."""
    spent, start = 0.0, 0.0
    for entry in in_force(scene.history):
        if entry["command"] == "fit":
            start = spent + float(entry.get(PRIOR_SECONDS) or 0.0)  # which is made before the first pass
        if entry["command"] in ("prep", "normalise", "prior", "fit", "export"):
            spent += float(entry.get("seconds") or 0.0)
    points = [("passes of the fit", start + r["seconds"], r["mae_m"]) for r in trace_rows(scene) if "mae_m" in r]
    watched = bool(points)
    points.append(("exported surface", spent, float(figures["mae"])))
    caption = "Error against the seconds since the images; rings: nothing else was both faster and better."
    if not watched:
        caption += " `fit --reference DSM` watches the error during the fit, too."
    return Picture(error_over_time(points), "Error against time", caption)


__all__ = ["errors_section"]
