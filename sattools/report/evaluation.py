"""The page of several fits that `sattools compare --fit` has scored."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from sattools.compare.evaluation import (
    MAP_COLUMNS,
    POINT_COLUMNS,
    VIEW_COLUMNS,
    map_rows,
    place_figure,
    point_rows,
    text,
    view_rows,
)
from sattools.report.page import Picture, Section, Table, render
from sattools.scene.jsonio import JsonObject, read_json
from sattools.scene.schema import Items, Maybe, Number, Text
from sattools.scene.schema import Table as Members

_VALUE = Members(dict.fromkeys(("map", "difference"), Maybe(Number())) | {"sample": Number()}, ("map", "sample"))
_POINT = Members({"name": Text(), "values": Members(other=_VALUE)}, ("name", "values"))
_FIT = Members(
    {
        "mae": Number(),
        "median": Number(),
        "parameters": Members(other=Members()),
        "points": Items(_POINT),
    },
    ("mae", "median", "parameters"),
)
_PAIR = Items(Number(), 2, 2)
_BRDF = Members(
    {
        "sun": Maybe(_PAIR),
        "views": Items(_PAIR),
        "points": Members(other=Members(other=Members())),
        "errors": Members(other=Members(other=Members(other=Maybe(Number())))),
        "band": Number(0, whole=True),
    },
    ("sun", "views", "points", "errors"),
)
_EVALUATION = Members(
    {"fits": Members(other=_FIT), "points": Members(other=Members(other=Members(other=Number()))), "brdf": _BRDF},
    ("fits", "points", "brdf"),
)


def evaluation_page(path: Path) -> str:
    """HTML of an `evaluation.json`. Raises InputError where it is not one."""
    result = read_json(path, "a table of `sattools compare --fit`")
    _EVALUATION.check(result, str(path))
    sections = [_views(result), _maps(result), _points(result), _brdf(result)]
    return render(f"Fits {', '.join(result['fits'])}", sections)


def _table(columns: Sequence[str], rows: Sequence[Mapping[str, Any]], caption: str) -> list[Any]:
    return [Table(columns, [[text(row[key]) for key in columns] for row in rows], caption)] if rows else []


def _views(result: JsonObject) -> Section:
    caption = (
        "Held-out views (PSNR in dB; avg = (10^(-PSNR/10) + sqrt(1 - SSIM) + LPIPS) / 3 as papers print it, "
        "avg_geometric the geometric mean of the same three terms) and the surface against the reference [m]. Empty: "
        "not asked for, or no weights of LPIPS. fit_seconds: of the command `fit`; fit_prior_seconds: those of them in "
        "which it made the prior, where no `prior` went before it."
    )
    return Section("Views and surface", _table(VIEW_COLUMNS, view_rows(result), caption))


def _maps(result: JsonObject) -> Section:
    caption = (
        "NRMSE: RMSE over the mean of the reference; nrmse_constant: of a constant map, which knows nothing; "
        "nrmse_scaled: after the best common factor. Another model's amplitude is compared with w or rho0 where "
        "product says so: the two are defined differently."
    )
    return Section("Parameter maps", _table(MAP_COLUMNS, map_rows(result), caption))


def _points(result: JsonObject) -> Section:
    caption = "Maps at the sample points; nrmse: RMSE over all bands of the point, over the mean of its samples."
    return Section("Sample points", _table(POINT_COLUMNS, point_rows(result), caption))


def _brdf(result: JsonObject) -> Section:
    section = Section("Reflectance in all directions")
    light = result["brdf"]
    for point in light["points"]:
        figure = place_figure(light, point)
        if figure is None:
            continue
        said = "; ".join(
            f"{name} {text(own.get('nrmse'))} over all views up to 60 degrees, "
            f"{text(own.get('nrmse_near_views'))} near those of the images"
            for name, own in light["errors"].get(point, {}).items()
        )
        caption = f"{point}: bidirectional reflectance of level ground." + (f" NRMSE of {said}." if said else "")
        section.parts.append(Picture(figure, f"Polar plots of the reflectance of {point}", caption))
    return section


__all__ = ["evaluation_page"]
