"""Several fits of one place side by side: the tables and figures of a paper about reflectance."""

from __future__ import annotations

import csv
import io
import logging
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from sattools.compare.brdf import AMPLITUDE, PLAIN, SHAPE, brdf_figure, errors, place_in, place_of, unit_vector
from sattools.compare.gate import check_scene
from sattools.compare.images import FIGURES
from sattools.compare.options import CompareOptions, name_and_file
from sattools.compare.points import Point, Values, band_of, compare_points, filed, read_points, sampled, with_values_of
from sattools.compare.stage import score
from sattools.compare.text import to_json
from sattools.errors import InputError
from sattools.progress import Progress, silent
from sattools.scene.dependencies import PRIOR_SECONDS, files_of
from sattools.scene.document import Scene
from sattools.scene.files import all_or_nothing, check_outputs, write_figure, write_text
from sattools.scene.jsonio import JsonObject

log = logging.getLogger(__name__)
EVALUATION, TABLES = "evaluation.json", ("views.csv", "maps.csv", "points.csv")
VIEW_COLUMNS = ("fit", *FIGURES, "dsm_mae_m", "dsm_median_m", "fit_seconds", "fit_prior_seconds")
MAP_COLUMNS = ("fit", "map", "product", "nrmse", "nrmse_constant", "nrmse_scaled", "correlation", "rmse", "n")
POINT_COLUMNS = ("fit", "point", "value", "product", "map", "sample", "difference", "nrmse")
TRUTH = "truth"


def evaluate(options: CompareOptions, overwrite: bool = False, progress: Progress = silent) -> JsonObject:
    """Score the exported scenes `options.fit` and write the tables and figures of all below `options.out`.

    The scenes are only read. A map that a model has not is left out of its rows; where the reference is Hapke's w or
    RPV's rho0, the other model's amplitude takes its place, and `product` says so, at sample points, too. Sample
    points without values of their own get those of the reference maps.

    Args:
        options: of the stage; those of a registration hold for every fit.
        overwrite: replace outputs that are there.
        progress: told the share done and what is being done.

    Returns:
        What `evaluation.json` holds: `fits` (figures by name), `points` (NRMSE by point and map), `brdf`.

    Raises:
        InputError: no name twice, no reserved one; unreadable scenes or references.
    """
    scenes, references, truth, points, outputs = check_fits(options, overwrite)
    result: dict[str, Any] = {"fits": {}, "points": {}, "brdf": _light(scenes, points)}
    for number, (name, scene) in enumerate(scenes.items()):
        progress(0.8 * number / len(scenes), name)
        result["fits"][name] = _scored(options, scene, references, points)
    result["points"] = {
        name: {point: _point_nrmse(rows, truth) for point, rows in _by_name(figures["points"]).items()}
        for name, figures in result["fits"].items()
        if "points" in figures
    }
    _add_places(result, scenes, points, truth)
    progress(0.8, "tables and figures")
    with all_or_nothing():
        _write(result, outputs, [point.name for point in points])
    progress(1.0, "done")
    return result


class Plan(NamedTuple):
    """What `evaluate` is about to do.

    Attributes:
        scenes: by the names of their fits.
        references: files of reference maps by name; truth: what they hold.
        points: samples.
        outputs: files to write, by href.
    """

    scenes: dict[str, Scene]
    references: dict[str, Path]
    truth: dict[str, Values]
    points: list[Point]
    outputs: dict[str, Path]


def check_fits(options: CompareOptions, overwrite: bool = False) -> Plan:
    """What `evaluate` looks at before its work; arguments and errors as of `evaluate`.

    Args:
        options: of the stage.
        overwrite: replace outputs that are there.
    """
    assert options.out is not None  # the command has looked
    scenes = {name: Scene.from_file(path) for name, path in name_and_file(options.fit, "--fit").items()}
    if TRUTH in scenes:
        raise InputError(f"--fit: found the name {TRUTH!r}, expected another one: the reference has it")
    for scene in scenes.values():
        check_scene(scene)
    references = name_and_file(options.map, "--map")
    truth = {name: filed(path) for name, path in references.items()}
    points = read_points(Path(options.points), values_needed=not truth) if options.points else []
    points = with_values_of(points, truth)
    for point in points:
        if not point.values:  # a place in another CRS, mostly: the tables would be short of it without a word
            log.warning(
                "%s: %s has no value of its own, nor a reference map there: left out", options.points, point.name
            )
    files = [EVALUATION, "evaluation.md", *TABLES, *(_figure_href(k) for k in range(len(points)))]
    outputs = {href: Path(options.out) / href for href in files}
    given = [options.dsm, options.classes, options.points, *options.lpips_weights, *references.values()]
    read = [path for scene in scenes.values() for path in (scene.origin, *files_of(scene)) if path]
    check_outputs(outputs.values(), [*read, *(Path(path) for path in given if path)], overwrite)

    return Plan(scenes, references, truth, points, outputs)


def _figure_href(number: int) -> str:
    return f"brdf_{number + 1:02d}.png"


def _product_of(scene: Scene, name: str) -> str | None:
    """The scene's product that a reference map of that name is compared with; None where it has none.

    Args:
        scene: an exported one.
        name: of the reference; an amplitude (w, rho0) stands for that of any reflectance model.
    """
    if name in scene.products:
        return name
    if name in (AMPLITUDE["hapke"], AMPLITUDE["rpv"]):
        return next((own for own in (AMPLITUDE["hapke"], AMPLITUDE["rpv"]) if own in scene.products), None)
    return None


def _scored(
    options: CompareOptions, scene: Scene, references: Mapping[str, Path], points: Sequence[Point]
) -> JsonObject:
    products = {name: _product_of(scene, name) for name in references}
    maps = [f"{own}={references[name]}" for name, own in products.items() if own is not None]
    scored = score(replace(options, map=maps, points=None), scene)
    figures = dict(scored.figures)
    found = figures.pop("parameters", {})
    figures["parameters"] = {name: {"product": own, **found[own]} for name, own in products.items() if own is not None}
    east, north, _ = scored.surface.registration.metres(scored.surface.grid.cell_size)
    if points:
        wanted = {key for point in points for key in point.values} | {f"{n}_1" for n in references} | set(references)
        names = wanted | {key.rpartition("_")[0] for key in wanted}
        own = {name: product for name in sorted(names) if (product := _product_of(scene, name)) is not None}
        own_maps = {name: filed(scene.path(scene.products[product])) for name, product in own.items()}
        figures["points"] = compare_points(list(points), own_maps, (east, north))
        for row in figures["points"]:
            for key, value in row["values"].items():
                value["product"] = own[str(band_of(key, own_maps)[0])]
    done: JsonObject = next((e for e in reversed(scene.history) if e["command"] == "fit"), {})
    # all of the command, and those of them in which it made the prior that nobody had made before
    figures |= {"fit_seconds": done.get("seconds"), "fit_prior_seconds": done.get(PRIOR_SECONDS)}
    return figures


def _by_name(rows: Sequence[Mapping[str, Any]]) -> dict[str, Mapping[str, Any]]:
    return {row["name"]: row["values"] for row in rows}


def _point_nrmse(values: Mapping[str, Any], truth: Mapping[str, Values]) -> dict[str, float]:
    """Per map the RMSE of a point's bands over the mean of the samples; only where all bands are known."""
    groups: dict[str, list[tuple[float, float]]] = {}
    for key, value in values.items():
        stem, _, number = key.rpartition("_")
        name = band_of(key, truth)[0] or (stem if number.isdigit() else key)
        groups.setdefault(name, []).append((value["map"], value["sample"]))
    result = {}
    for name, pairs in groups.items():
        if any(found is None for found, _ in pairs):
            continue
        found, sample = np.array(pairs, float).T
        if sample.mean() > 0:
            result[name] = float(np.sqrt(((found - sample) ** 2).mean()) / sample.mean())
    return result


# ---- reflectance in all directions ----------------------------------------------------------------------------


def _light(scenes: Mapping[str, Scene], points: Sequence[Point]) -> JsonObject:
    """Mean sun and the images' directions as (azimuth, zenith) [degrees], of the images that were fitted."""
    items = [item for item in next(iter(scenes.values())).items if not item.held_out]
    suns = [unit_vector(item.sun[0], 90 - item.sun[1]) for item in items if item.sun is not None]
    angles = [(item.properties.get("view:azimuth"), _tilt(item.properties)) for item in items]
    views = [[float(a), float(z)] for a, z in angles if a is not None and z is not None]
    light: dict[str, Any] = {"sun": None, "views": views, "points": {}, "errors": {}}
    if suns and points:
        east, north, up = np.mean(suns, axis=0)
        light["sun"] = [
            float(np.degrees(np.arctan2(east, north)) % 360), float(np.degrees(np.arctan2(np.hypot(east, north), up)))
        ]  # fmt: skip
    return light


def _tilt(properties: Mapping[str, Any]) -> float | None:
    tilt = properties.get("view:incidence_angle")
    return properties.get("view:off_nadir") if tilt is None else tilt


def _add_places(
    result: JsonObject, scenes: Mapping[str, Scene], points: Sequence[Point], truth: Mapping[str, Values]
) -> None:
    """Reflectance parameters of every fit at every point, of the truth where its maps are given, and their errors."""
    light = result["brdf"]
    if light["sun"] is None:
        return
    sun, views = unit_vector(*light["sun"]), [unit_vector(*view) for view in light["views"]]
    bands = [array.shape[0] for name, (array, _) in truth.items() if name in AMPLITUDE.values()]
    light["band"] = band = (max(bands, default=3) - 1) // 2  # the green one of three
    for point in points:
        places = {}
        values = {name: there for name, m in truth.items() if (there := sampled(*m, point)) is not None}
        if (place := place_in(values, band)) is not None:
            places[TRUTH] = place
        for name, scene in scenes.items():
            if (place := _place(scene, point, result["fits"][name]["shift_m"], band)) is not None:
                places[name] = place
        light["points"][point.name] = {name: place.to_json() for name, place in places.items()}
        if TRUTH in places:
            light["errors"][point.name] = {
                name: errors(place, places[TRUTH], sun, views) for name, place in places.items() if name != TRUTH
            }


def _place(scene: Scene, point: Point, shift: Sequence[float], band: int) -> Any:
    wanted = {name for model, amplitude in AMPLITUDE.items() for name in (amplitude, *SHAPE[model])} | {PLAIN}
    values = {}
    for name in wanted & scene.products.keys():
        there = sampled(*filed(scene.path(scene.products[name])), point, (shift[0], shift[1]))
        if there is not None:
            values[name] = there
    place = place_in(values, band)
    if place is None or place.model != "lambert" or PLAIN in values:
        return place
    # a colour holds the light that falls on level ground, where the numbers are those of the sun's own beam
    item = next(item for item in scene.items if not item.held_out)
    if item.properties.get("sattools:radiance") != "reflectance_factor" or item.sun is None:
        return place
    return replace(place, amplitude=place.amplitude / max(float(np.sin(np.radians(item.sun[1]))), 0.02))


# ---- files ----------------------------------------------------------------------------------------------------


def view_rows(result: JsonObject) -> list[dict[str, Any]]:
    """Rows of the table of images and surfaces, columns `VIEW_COLUMNS`; None where there is nothing."""
    return [
        {"fit": name, **{key: figures.get(key) for key in FIGURES}, "dsm_mae_m": figures["mae"],
         "dsm_median_m": figures["median"], **{key: figures.get(key) for key in ("fit_seconds", "fit_prior_seconds")}}
        for name, figures in result["fits"].items()
    ]  # fmt: skip


def map_rows(result: JsonObject) -> list[dict[str, Any]]:
    """Rows of the table of parameter maps, columns `MAP_COLUMNS`."""
    return [
        {"fit": name, "map": key, **{k: own.get(k) for k in MAP_COLUMNS[2:]}}
        for name, figures in result["fits"].items()
        for key, own in figures["parameters"].items()
    ]


def point_rows(result: JsonObject) -> list[dict[str, Any]]:
    """Rows of the table of sample points, columns `POINT_COLUMNS`; `nrmse` is over all bands of a value's map."""
    rows = []
    for name, figures in result["fits"].items():
        for row in figures.get("points", []):
            own = result["points"][name][row["name"]]
            for key, value in row["values"].items():
                stem, _, number = key.rpartition("_")
                nrmse = own.get(key, own.get(stem) if number.isdigit() else None)
                rows.append({"fit": name, "point": row["name"], "value": key, "product": None, **value, "nrmse": nrmse})
    return rows


def _write(result: JsonObject, outputs: Mapping[str, Path], names: Sequence[str]) -> None:
    tables = [
        (VIEW_COLUMNS, view_rows(result)), (MAP_COLUMNS, map_rows(result)), (POINT_COLUMNS, point_rows(result))
    ]  # fmt: skip
    write_text(outputs[EVALUATION], to_json(result, indent=1) + "\n")
    for href, (columns, rows) in zip(TABLES, tables, strict=True):
        stream = io.StringIO()
        writer = csv.DictWriter(stream, columns, lineterminator="\n")
        writer.writeheader()
        writer.writerows(rows)
        write_text(outputs[href], stream.getvalue())
    titles = ("Views and surface", "Parameter maps", "Sample points")
    parts = [f"## {title}\n\n{markdown(*table)}" for title, table in zip(titles, tables, strict=True) if table[1]]
    write_text(outputs["evaluation.md"], "\n".join(parts))
    for number, point in enumerate(names):
        figure = place_figure(result["brdf"], point)
        if figure is not None:
            write_figure(outputs[_figure_href(number)], figure)


def place_figure(light: JsonObject, point: str) -> Any:
    """Matplotlib figure of a point's reflectance, of `evaluation.json`'s member `brdf`; None where nothing is known."""
    found = light["points"].get(point) if light.get("sun") else None
    if not found:
        return None
    places = {name: place_of(own, f"{point}, {name}") for name, own in found.items()}
    sun, views = light["sun"], [(a, z) for a, z in light["views"]]
    return brdf_figure(places, (sun[0], sun[1]), views, f"{point}: BRF of level ground, band {light['band'] + 1}")


def markdown(columns: Sequence[str], rows: Sequence[Mapping[str, Any]]) -> str:
    """A table as Markdown; numbers with three digits, nothing where nothing is known."""
    lines = ["| " + " | ".join(columns) + " |", "|" + "---|" * len(columns)]
    lines += ["| " + " | ".join(text(row[key]) for key in columns) + " |" for row in rows]
    return "\n".join(lines) + "\n"


def text(value: Any) -> str:
    """A cell of a table."""
    if value is None:
        return ""
    return f"{value:.3f}" if isinstance(value, float) else str(value).replace("|", "/")


__all__ = [
    "EVALUATION", "MAP_COLUMNS", "POINT_COLUMNS", "VIEW_COLUMNS", "check_fits", "evaluate", "map_rows",
    "markdown", "place_figure", "point_rows", "text", "view_rows",
]  # fmt: skip
