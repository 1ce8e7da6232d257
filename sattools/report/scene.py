"""The page of one scene."""

from __future__ import annotations

import logging
from collections.abc import Callable
from pathlib import Path

import numpy as np

from sattools.errors import counted
from sattools.export.products.colours import rgb_bands
from sattools.report import figures
from sattools.report.alignment import alignment_section
from sattools.report.commands import pipeline
from sattools.report.errors import errors_section
from sattools.report.links import products_section
from sattools.report.page import Code, Picture, Section, Table, render
from sattools.report.parts import number, product, trace_rows
from sattools.scene.dependencies import ALBEDO_SECONDS, PRIOR_SECONDS, drop, in_force, stale
from sattools.scene.document import Scene
from sattools.scene.jsonio import JsonObject, read_json
from sattools.scene.opening import opened
from sattools.scene.raster import raster_grid, read_overview, read_some_pixels
from sattools.scene.schema import Items, Maybe, Number, Text
from sattools.scene.schema import Table as Members

log = logging.getLogger(__name__)
# product -> what it is, with its unit; shown where a scene has them
MAPS = {
    "dsm_std": "standard deviation of the height [m]",
    "dsm_error95": "95 % of the errors of the height are smaller [m]",
    "albedo": "albedo [1]",
    "reflectance": "reflectance [1]",
    "w": "single-scattering albedo w [1]",
    "b": "asymmetry b of the phase function [1]",
    "c": "backward share c of the phase function [1]",
    "theta": "macroscopic roughness theta [degrees]",
    "rho0": "amplitude rho0 [1]",
    "k": "bowl shape k [1]",
    "asymmetry": "asymmetry Theta of the phase function [1]",
    "rhoc": "hot spot rhoc [1]",
    "lambert_share": "share of the ground that is Lambert's [1]",
    "probability": "probability of less than 1 m of error [1]",
    "prior_confidence": "confidence of the prior [1]",
    "prior_probability": "probability that the prior is less than 1 m off [1]",
}
_LENGTH = Maybe(Number())
_PAIR = ("angle_deg", "tie_points", "before_px", "after_px")
_ADJUSTMENT = Members(
    {
        "views": Items(
            Members(
                {
                    "id": Text(),
                    "median_before_px": _LENGTH,
                    "median_after_px": _LENGTH,
                    "residuals": Items(Items(Number(), 4, 4)),
                },
                ("id",),
            ),
        ),
        "pairs": Items(Members({"images": Items(Text(), 2, 2), **dict.fromkeys(_PAIR, Number())}, ("images", *_PAIR))),
        **{name: Number() for name in ("observations", "ground_points", "median_before_px", "median_after_px")},
        "model": Text(),
    },
    ("observations", "ground_points", "median_before_px", "median_after_px", "model"),
)
_VECTORS, _PAIRS = 18, 15  # images and pairs of images that are shown
_PIXELS = 200_000  # of an image are enough for its histogram


def scene_page(scene: Scene) -> str:
    """HTML of everything that the scene has data for."""
    notes = _drop_stale(scene)
    makers: list[Callable[[Scene], Section]] = [
        *(_images, _adjustment, _radiometry, _surface, alignment_section, errors_section, _maps, _training),
        products_section,
    ]
    return render(f"Scene {scene.id}", [*notes, *(make(scene) for make in makers), _history(scene)])


def _drop_stale(scene: Scene) -> list[Section]:
    """What is out of date is left out, and the page says so."""
    for stage in ("normalise", "prior", "fit", "export", "compare"):
        reason = stale(scene, stage)
        if reason:
            gone = ", ".join(drop(scene, stage)) or f"what {stage} has made"
            log.warning("scene %s: %s; left out of the report: %s", scene.id, reason, gone)
            return [Section("Out of date", [f"Left out: {gone}. {reason[0].upper()}{reason[1:]}."])]
    return []


def _images(scene: Scene) -> Section:
    section = Section("Images")
    outlines = {
        item.id: [place[:2] for place in item.geometry["coordinates"][0]]  # some have a height
        for item in scene.items
        if item.geometry and item.geometry.get("type") == "Polygon"
    }
    if outlines:
        text = f"Footprints of {counted(len(outlines), 'images')}" + (
            " and the ground grid, shaded" if scene.grid else ""
        )
        section.parts.append(Picture(figures.footprints(outlines, _area(scene)), "Map of footprints", f"{text}."))
    suns = [(item.sun[0], 90 - item.sun[1]) for item in scene.items if item.sun]
    views = [
        (float(p["view:azimuth"]), float(p["view:off_nadir"]))
        for p in (item.properties for item in scene.items)
        if p.get("view:azimuth") is not None and p.get("view:off_nadir") is not None
    ]
    if suns or views:
        caption = "Where the sun and the sensors stand, seen from the ground: zenith in the middle, horizon at the rim."
        section.parts.append(Picture(figures.directions(suns, views), "Polar plot of suns and sensors", caption))
    if scene.items:
        section.parts.append(_item_table(scene))
    return section


def _item_table(scene: Scene) -> Table:
    rows = []
    for item in scene.items:
        p = item.properties
        sun = item.sun or (None, None)
        rows.append(
            [
                item.id,
                str(p.get("datetime") or "")[:16].replace("T", " "),
                *(number(value, 1) for value in (*sun, p.get("view:azimuth"), p.get("view:off_nadir"))),
                number(p.get("gsd"), 2),
                "test" if item.held_out and item.role == "train" else item.role,
            ]
        )
    names = ["image", "UTC", "sun azimuth [°]", "sun elevation [°]", "view azimuth [°]", "off nadir [°]", "pixel [m]"]
    caption = "Azimuths from true north; images of the role test are held out of the fit, unused ones are in no step."
    return Table([*names, "role"], rows, caption)


def _adjustment(scene: Scene) -> Section:
    section = Section("Camera adjustment")
    path = _beside_images(scene, "adjustment.json")
    if path is None:
        return section
    adjustment = read_json(path, "a report of `sattools prep`")
    _ADJUSTMENT.check(adjustment, str(path))
    views = [v for v in adjustment.get("views", []) if v.get("median_before_px") and v.get("median_after_px")]
    if views:
        figure = figures.residuals(
            [v["id"] for v in views], [v["median_before_px"] for v in views], [v["median_after_px"] for v in views]
        )
        caption = (
            f"Residuals of {adjustment['observations']} observations of {adjustment['ground_points']} ground points: "
            f"median {adjustment['median_before_px']:.2f} pixels before, "
            f"{adjustment['median_after_px']:.2f} after ({adjustment['model']})."
        )
        section.parts.append(Picture(figure, "Residuals of every image before and after", caption))
    if adjustment.get("pairs"):
        section.parts.append(_pair_table(adjustment["pairs"]))
    vectors = {v["id"]: np.array(v["residuals"], float) for v in adjustment.get("views", []) if v.get("residuals")}
    if vectors:
        shown = dict(list(vectors.items())[:_VECTORS])
        more = f" The first {_VECTORS} of {len(vectors)} images." if len(vectors) > _VECTORS else ""
        caption = f"Residuals that are left after the adjustment; a pattern would be an error of the camera.{more}"
        section.parts.append(
            Picture(figures.residual_vectors(shown), "Arrows of the residuals in every image", caption, len(shown) > 3)
        )
    return section


def _pair_table(pairs: list[JsonObject]) -> Table:
    rows = [
        [*row["images"], number(row["angle_deg"], 1), str(row["tie_points"]), number(row["before_px"], 2),
         number(row["after_px"], 2)]
        for row in pairs[:_PAIRS]
    ]  # fmt: skip
    caption = "Angle between the lines of sight; tie points that both images show, and the median of their residuals."
    if len(pairs) > _PAIRS:
        caption += f" The {_PAIRS} pairs with the most tie points, of {len(pairs)}."
    names = ["image", "image", "angle [°]", "tie points", "before [px]", "after [px]"]
    return Table(names, rows, caption)


def _radiometry(scene: Scene) -> Section:
    section = Section("Radiometry")
    name = "radiance" if any("radiance" in item.assets for item in scene.items) else "image"
    values = {}
    for item in scene.items:
        path = scene.path(item.assets[name].href) if name in item.assets else None
        if path is not None and path.is_file():
            array = read_some_pixels(path)
            gray = array.mean(axis=0).ravel()
            gray = gray[:: max(1, gray.size // _PIXELS)]
            values[item.id] = gray[np.isfinite(gray)]
    values = {name: own for name, own in values.items() if own.size}
    if values:
        label = f"{'linear radiance' if name == 'radiance' else 'digital number'}, mean of the bands [1]"
        figure = figures.histograms(values, label)
        section.parts.append(Picture(figure, "Histograms of the images", "Brightness: one line per image."))
    return section


def _surface(scene: Scene) -> Section:
    from sattools.compare.picture import difference_figure
    from sattools.export.datum import vertical_datum
    from sattools.export.hillshade import picture

    section = Section("Surface")
    path = product(scene, "dsm")
    if path is not None:
        heights, grid = read_overview(path)
        cell = raster_grid(path).cell_size
        cells = f"{cell:g} m" if grid.cell_size == cell else f"{cell:g} m, drawn as means over {grid.cell_size:g} m"
        caption = f"Surface model, colours over a hillshade lit from the north-west; cells of {cells}."
        figure = picture(heights[0], grid, scene.id, vertical_datum(path))
        section.parts.append(Picture(figure, "Map of the heights", caption))
    path = product(scene, "validity")
    if path is not None:
        codes, grid = read_overview(path)
        caption = "What the heights stand on: measured by two images or more, filled from neighbours, "
        caption += "laid level as water, or unseen."
        section.parts.append(Picture(figures.validity_figure(codes[0], grid), "Map of validity", caption))
    path = product(scene, "difference")
    if path is not None:
        difference, grid = read_overview(path)
        caption = "Registered surface minus reference: blue too low, red too high, grey not scored [m]."
        figure = difference_figure(difference[0], grid, "difference to the reference")
        section.parts.append(Picture(figure, "Map of the height differences", caption))
    return section


def _maps(scene: Scene) -> Section:
    section = Section("Maps")
    for name, label in MAPS.items():
        path = product(scene, name)
        if path is None:
            continue
        array, grid = read_overview(path)
        shown = array.astype(np.float32)
        shown = shown[list(rgb_bands(path))] if shown.shape[0] >= 3 else shown[:1]
        caption = f"{label[0].upper()}{label[1:]}, product {name}"
        with opened(path) as data:
            told = data.tags().get("DETERMINED")  # of what reflectance models have, in which share of the cells
        caption += f"; determined: {told}." if told else "."
        if np.isfinite(shown).any():
            section.parts.append(Picture(figures.map_figure(shown, grid, label), f"Map: {label}", caption))
        else:
            section.parts.append(f"{caption} No cell has a value.")
    return section


def _training(scene: Scene) -> Section:
    section = Section("Fit")
    rows = trace_rows(scene)
    if rows:
        caption = "Loss after every epoch; it jumps where a finer stage begins."
        section.parts.append(Picture(figures.training(rows), "Training curve", caption))
    return section


def _history(scene: Scene) -> Section:
    section = Section("How it was made")
    if not scene.history:
        return section
    rows = []
    for entry in scene.history:
        versions = ", ".join(f"{name} {value}" for name, value in entry.get("versions", {}).items())
        keys = (("seconds", 1), ("cpu_seconds", 1), ("peak_memory_mb", 0))
        taken = [number(entry.get(key), digits) for key, digits in keys]
        rows.append([entry["command"], *taken, versions])
    names = ["command", "time [s]", "CPU time [s]", "peak memory [MB]", "versions"]
    section.parts.append(Table(names, rows, "Every command that changed the scene."))
    text = "The same again; IMAGE... stands for the images above. Options that are not named have their defaults."
    section.parts.append(Code(pipeline(scene.history), text))
    # what is shown is of the last one of a command, and `align` has a section of its own
    told = {entry["command"]: entry for entry in in_force(scene.history) if entry["command"] != "align"}
    matching = told.get("fit", {}).get(PRIOR_SECONDS)
    if matching is not None:
        section.parts.append(f"fit: {number(matching, 1)} s of its time made the prior, which no command had made.")
    albedo = told.get("fit", {}).get(ALBEDO_SECONDS)
    if albedo is not None:
        section.parts.append(f"fit: {number(albedo, 1)} s of its time solved for the albedo once the heights stood.")
    notes = [f"{command}: {note}" for command, entry in told.items() for note in entry.get("notes", [])]
    section.parts.extend(notes)
    return section


def _area(scene: Scene) -> list[list[float]] | None:
    if scene.grid is None:
        return None
    from sattools.camera.ground import to_geographic

    west, south, east, north = scene.grid.bounds
    lon, lat = to_geographic(scene.grid.crs, [west, east, east, west], [south, south, north, north])
    return [[float(x), float(y)] for x, y in zip(lon, lat, strict=True)]


def _beside_images(scene: Scene, name: str) -> Path | None:
    """A report of `prep`: in the scene's root, or where its images lie."""
    images = [scene.path(item.assets["image"].href) for item in scene.items if "image" in item.assets]
    folders = [scene.root, *(image.parent.parent for image in images[:1])]
    return next((folder / name for folder in folders if (folder / name).is_file()), None)


__all__ = ["MAPS", "scene_page"]
