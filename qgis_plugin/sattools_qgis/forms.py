# SPDX-License-Identifier: GPL-2.0-or-later
"""From the command line's description of itself to fields of a form, and back to arguments. Knows nothing of QGIS."""

import json
import os
import re
from typing import Any

PARAMETERS = ("w", "b", "c", "theta", "rho0", "k", "asymmetry", "rhoc")
MATERIAL = ("reflectance", *PARAMETERS, "identifiable", *(f"{name}_std" for name in PARAMETERS))
MATERIAL += ("lambert_share", "normal", "normal_std")
# commands in the order of work: name -> (title, group, products that are loaded afterwards)
ALGORITHMS = {
    "prep": ("Prepare images", "Steps", ("footprints", "tie_points")),
    "normalise": ("Normalise radiance", "Steps", ()),
    "prior": ("Match images (prior)", "Steps", ("prior_dsm", "prior_confidence", "prior_probability")),
    "fit": ("Fit scene", "Steps", ()),
    "export": (
        "Export maps",
        "Steps",
        (
            "dsm",
            "dsm_std",
            "dsm_error95",
            "probability",
            "validity",
            "albedo",
            "ortho",
            "contours",
            "dtm",
            "dtm_validity",
            "ndsm",
            "relit",
            *MATERIAL,
        ),
    ),
    "align": ("Align with a reference", "References", ("dsm",)),
    "compare": ("Compare with a reference", "References", ("difference",)),
    "change": ("Compare two dates", "References", ("changes", "height_change", "significance")),
    "simulate": ("Simulate scene", "Simulation", ()),
}
# options that show at once, in this order; all others fold away as advanced
PLAIN = {
    "prep": ("metadata", "aoi", "bounds", "crs", "cell-size", "mask", "id", "out"),
    "normalise": ("quantity", "scale", "offset", "bits", "atmosphere"),
    "prior": ("resolution", "memory"),
    "fit": ("preset", "resolution", "brdf", "shadow", "tile", "budget", "reference"),
    "export": ("vertical", "products", "contours", "fill"),
    "align": ("to", "method", "tilt"),
    "compare": ("dsm", "classes", "register", "region"),
    "change": ("polygons", "register", "min-height", "min-area", "out"),
    "simulate": ("terrain", "size", "views", "dates", "id", "out"),
}
# what a form has no field for: other inputs than the images or the scene that it asks for
ASIDE = {"prep": ("dfc2019",), "compare": ("predicted", "fit", "out")}
# a source makes a scene below --out, all others work on the scene document that they are given
SOURCES = ("prep", "simulate")
KINDS = {
    "metadata": "folder",
    "truth": "folder",
    "out": "folder",
    "colours": "folder",
    "bounds": "extent",
    "crs": "crs",
}
KINDS.update(dict.fromkeys(("dsm", "classes", "predicted", "reference"), "raster"))
KINDS.update({"aoi": "polygons", "polygons": "polygons", "mask": "several polygons", "points": "file", "to": "file"})
PRODUCTS = ("laz", "ply", "contours", "dtm", "ortho", "mesh", "obj", "tiles")  # of `export --products`
SWITCH = ("yes", "no")
QUOTES = " Several with blanks between them, in double quotes what holds blanks itself."
ABBREVIATIONS = {"Dsm": "DSM", "Aoi": "Area of interest", "Crs": "CRS", "Id": "Name of the scene", "Brdf": "BRDF"}
ABBREVIATIONS.update({"Bounds": "Extent", "Out": "Folder for the scene", "To": "Reference"})


def key(flag: Any) -> Any:
    """Name of a form's field: `--prior-weight` -> `PRIOR_WEIGHT`."""
    return flag.lstrip("-").replace("-", "_").upper()


def title(flag: Any, group: Any = None) -> Any:
    """What a form shows beside a field: `--prior-weight` -> `Prior weight`, with the group of the command's help."""
    words = flag.lstrip("-").replace("-", " ").capitalize()
    words = ABBREVIATIONS.get(words, words)
    return f"{group}: {words}" if group else words


def kind_of(option: Any, name: Any) -> Any:
    """How a value is asked for: bool, switch, int, float, choice, choices, list, text or one of `KINDS`."""
    if name == "products":
        return "choices"
    if option["kind"] == "bool" and option["off"] and (option["default"] is None or option.get("by_preset")):
        return "switch"  # on, off, or left to the command
    if option["choices"]:
        return "choice"
    if name in KINDS and option["kind"] in ("str", "float") and (option["values"] == 1 or name == "bounds"):
        return KINDS[name]
    if option["multiple"] or option["values"] != 1:
        return "list"
    # a field for numbers takes no word such as auto
    return "text" if option["kind"] == "str" or option.get("words") else option["kind"]


def paragraphs(text: Any) -> Any:
    """A command's help with one line a paragraph: QGIS takes every line for one."""
    return "\n".join(" ".join(part.split()) for part in text.split("\n\n"))


def fields(name: Any, command: Any) -> Any:
    """The fields of a command's form, one dictionary per option: what everybody needs first.

    Keys: `key`, `flag`, `off`, `type` (see `kind_of`), `label`, `help`, `default`, `minimum`, `maximum`, `choices`,
    `optional`, `advanced`, `multiple`.
    """
    found, plain = [], PLAIN.get(name, ())
    for option in command["options"]:
        own = option["name"].lstrip("-")
        if own in ASIDE.get(name, ()):
            continue
        kind = kind_of(option, own)
        if name == "compare" and own == "aoi":
            kind = "text"  # a name, not a file
        default = option["default"]
        help_text = option["help"] + (QUOTES if kind == "list" and option["kind"] == "str" else "")
        if option.get("by_preset"):
            # a value that the form shows and does not pass on would not be the one of a preset that is chosen beside it
            help_text += f" Left empty: {_shown(default)}, or what the preset says."
            default = None
        if kind == "list":
            default = " ".join(str(v) for v in default or ())
        if own == "overwrite":
            # in a form, running again means to replace; but what makes a scene may meet one of other images
            default = name not in SOURCES
        found.append(
            {
                "key": key(option["name"]),
                "flag": option["name"],
                "off": option["off"],
                "multiple": option["multiple"],
                "type": kind,
                "label": title(option["name"], option.get("group") if own not in plain else None),
                "help": help_text,
                "default": default if default not in ([], ()) else None,
                "minimum": option["minimum"],
                "maximum": option["maximum"],
                "choices": {"choices": list(PRODUCTS), "switch": list(SWITCH)}.get(kind, option["choices"]),
                "optional": kind != "bool" and not (own == "out" and name in SOURCES),
                "advanced": own not in plain,
            }
        )
    order = {flag: number for number, flag in enumerate(plain)}
    groups = list(dict.fromkeys(option.get("group") for option in command["options"]))
    place = {option["name"]: groups.index(option.get("group")) for option in command["options"]}
    return sorted(found, key=lambda f: (order.get(f["flag"].lstrip("-"), len(order)), place[f["flag"]]))


def arguments(fields: Any, values: Any) -> Any:
    """Command-line arguments from the form's values (key -> value); fields without a value are left out."""
    found = []
    for field in fields:
        value = values.get(field["key"])
        if field["type"] == "bool":
            if (value is not None and bool(value) != bool(field["default"])) or field["flag"] == "--overwrite":
                flag = field["flag"] if value else field["off"]
                found += [flag] if flag else []
            continue
        if value is None or value in ("", [], [""]) or value == field["default"]:
            continue
        if field["type"] == "switch":
            found.append(field["flag"] if value == SWITCH[0] else field["off"])
            continue
        parts = value if isinstance(value, list) else parts_of(str(value)) if _several(field) else [value]
        if field["multiple"]:
            for part in parts:
                found += [field["flag"], str(part)]
        else:
            found += [field["flag"], *map(str, parts)]
    return found


def parts_of(text: Any) -> Any:
    """What a text has between its blanks; within double quotes blanks are part of it: `w="my maps/w.tif" b=b.tif`."""
    return [part.replace('"', "") for part in re.findall(r'(?:[^\s"]|"[^"]*")+', text)]


def _several(field: Any) -> Any:
    return field["type"] in ("list", "extent")


def _shown(value: Any) -> Any:
    """A default as the help of a field says it."""
    if isinstance(value, bool):
        return SWITCH[0 if value else 1]
    return f"{value:.6g}" if isinstance(value, float) else value


def scene_of(output: Any) -> Any:
    """(document, path of the document's file) from the last line that a command printed."""
    lines = [line for line in output.splitlines() if line.strip()]
    scene = json.loads(lines[-1])
    return scene, os.path.join(scene["sattools"]["root"], "scene.json")


def read_scene(path: Any) -> Any:
    """A scene document; its own folder is the root, wherever it has been moved to.

    What a pipe has left in a file elsewhere names another folder. The `scene.json` there is read in its place: it has
    what commands have added since.
    """
    with open(path, encoding="utf-8") as file:
        scene = json.load(file)
    folder, named = os.path.dirname(os.path.abspath(path)), os.path.join(scene["sattools"]["root"], "scene.json")
    if not os.path.exists(os.path.join(folder, "scene.json")) and os.path.isabs(named) and os.path.exists(named):
        return read_scene(named)
    scene["sattools"]["root"] = folder
    return scene


def document_of(scene: Any, path: Any) -> Any:
    """Path of the `scene.json` in a scene's folder, or where there is none of the document that was read."""
    own = os.path.join(scene["sattools"]["root"], "scene.json")
    return own if os.path.exists(own) else path


def products(scene: Any, names: Any) -> Any:
    """Name -> absolute path of those of the scene's products that exist."""
    root = scene["sattools"]["root"]
    hrefs = scene["sattools"].get("products", {})
    paths = {name: os.path.join(root, hrefs[name]) for name in names if name in hrefs}
    return {name: path for name, path in paths.items() if os.path.exists(path)}
