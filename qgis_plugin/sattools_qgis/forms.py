# SPDX-License-Identifier: GPL-2.0-or-later
"""From the command line's description of itself to fields of a form, and back to arguments. Knows nothing of QGIS."""

import json
import os
from typing import Any

# commands in the order of work: name -> (title, products that are loaded afterwards)
ALGORITHMS = {
    "prep": ("Prepare images", ("footprints", "tie_points")),
    "normalise": ("Normalise radiance", ()),
    "prior": ("Match images (prior)", ("prior_dsm", "prior_confidence", "prior_probability")),
    "fit": ("Fit scene", ()),
    "export": ("Export maps", ("dsm", "dsm_std", "probability", "albedo", "w", "b", "c", "theta")),
    "compare": ("Compare with a reference", ("difference",)),
    "simulate": ("Simulate scene", ()),
}
# a source makes a scene below --out, all others work on the scene document that they are given
SOURCES = ("prep", "simulate")
FILES = {"metadata": "folder", "truth": "folder", "out": "folder", "dfc2019": "folder"}
FILES |= dict.fromkeys(("dsm", "classes", "predicted", "reference", "samples"), "file")


def key(flag: Any) -> Any:
    """Name of a form's field: `--prior-weight` -> `PRIOR_WEIGHT`."""
    return flag.lstrip("-").replace("-", "_").upper()


def fields(command: Any) -> Any:
    """The fields of a command's form, one dictionary per option.

    Keys: `key`, `flag`, `off`, `type` (bool, int, float, choice, text, file, folder, list), `label`, `default`,
    `minimum`, `maximum`, `choices`, `optional`.
    """
    found = []
    for option in command["options"]:
        kind, name = option["kind"], option["name"].lstrip("-")
        if option["choices"]:
            kind = "choice"
        elif option["multiple"] or option["values"] != 1:
            kind = "list"
        elif kind == "str":
            kind = FILES.get(name, "text")
        default = option["default"]
        if kind == "list":
            default = " ".join(str(v) for v in default or ())
        if name == "overwrite":
            default = True  # in a form, running again means to replace
        found.append(
            {
                "key": key(option["name"]),
                "flag": option["name"],
                "off": option["off"],
                "multiple": option["multiple"],
                "type": kind,
                "label": option["help"].rstrip("."),
                "default": default,
                "minimum": option["minimum"],
                "maximum": option["maximum"],
                "choices": option["choices"],
                "optional": kind != "bool",
            }
        )
    return found


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
        if value is None or value == "" or value == field["default"]:
            continue
        if field["type"] == "list":
            parts = str(value).split()
            if field["multiple"]:
                for part in parts:
                    found += [field["flag"], part]
            else:
                found += [field["flag"], *parts]
        else:
            found += [field["flag"], str(value)]
    return found


def scene_of(output: Any) -> Any:
    """(document, path of the document's file) from the last line that a command printed."""
    lines = [line for line in output.splitlines() if line.strip()]
    scene = json.loads(lines[-1])
    return scene, os.path.join(scene["sattools"]["root"], "scene.json")


def products(scene: Any, names: Any) -> Any:
    """Name -> absolute path of those of the scene's products that exist."""
    root = scene["sattools"]["root"]
    hrefs = scene["sattools"].get("products", {})
    paths = {name: os.path.join(root, hrefs[name]) for name in names if name in hrefs}
    return {name: path for name, path in paths.items() if os.path.exists(path)}
