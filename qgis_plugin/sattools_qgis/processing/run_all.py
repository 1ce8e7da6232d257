# SPDX-License-Identifier: GPL-2.0-or-later
"""From images to a scored surface model in one algorithm."""

import json
from typing import Any

from qgis.core import QgsProcessingOutputFile, QgsProcessingOutputNumber, QgsProcessingOutputRasterLayer

from ..forms import ALGORITHMS, arguments, fields, products, read_scene, scene_of
from .base import VECTORS, Base
from .parameters import images_parameter, parameter_of, read

# command -> percent of the whole at which it ends, as measured on seventeen 2-megapixel images
ENDS = {"prep": 25.0, "fit": 95.0, "export": 98.0, "compare": 100.0}
# what of each step's form is asked for, and what it is called where the step's own name says too little
ASKED = {
    "prep": ("metadata", "aoi", "bounds", "crs", "cell-size", "mask", "id", "out", "overwrite"),
    "fit": ("preset", "tile", "budget"),
    "export": ("vertical", "products"),
    "compare": ("dsm", "classes"),
}
LABELS = {"cell-size": "Resolution (cell size) [m]", "vertical": "Vertical datum", "dsm": "Reference DSM"}
LABELS.update({"classes": "Class map of the reference", "budget": "Budget of the fit [s]"})
ADVANCED = ("mask", "preset", "tile", "budget", "classes")


class RunAllAlgorithm(Base):
    """prep, fit, export and, with a reference, compare; what is not asked for at its defaults."""

    def __init__(self, usage: Any, executable: Any) -> None:
        super().__init__(executable)
        self.usage = usage
        self.forms = {step: asked(step, usage["commands"][step]) for step in ASKED}

    def createInstance(self) -> Any:
        return RunAllAlgorithm(self.usage, self.executable)

    def name(self) -> Any:
        return "runall"

    def displayName(self) -> Any:
        return "Run all"

    def group(self) -> Any:
        return "All in one"

    def shortHelpString(self) -> Any:
        return (
            "Adjusts the cameras, matches the images, fits the surface and exports the maps, every step with its "
            "defaults; with a reference DSM the result is scored. A scene of the same name in the folder is replaced "
            "with Overwrite only. Use the single algorithms to change options."
        )

    def initAlgorithm(self, config: Any = None) -> None:
        self.addParameter(images_parameter())
        for form in self.forms.values():
            for field in form:
                self.addParameter(parameter_of(field))
        self.addOutput(QgsProcessingOutputFile("SCENE_DOCUMENT", "Scene document"))
        for product in ("dsm", "dsm_std", "albedo", "difference"):
            self.addOutput(QgsProcessingOutputRasterLayer(product.upper(), product))
        self.addOutput(QgsProcessingOutputNumber("MAE", "mae"))

    def processAlgorithm(self, parameters: Any, context: Any, feedback: Any) -> Any:
        given = {}
        for step, form in self.forms.items():
            values = {field["key"]: read(self, field, parameters, context, feedback) for field in form}
            given[step] = arguments(form, values)
        if "--overwrite" in given["prep"]:  # asked for once, for all steps
            for step in ("fit", "export", "compare"):
                given[step].append("--overwrite")
        given["prep"][:0] = self.parameterAsFileList(parameters, "IMAGES", context)
        if "--dsm" not in given["compare"]:
            del given["compare"]
        path, start, results = None, 0.0, {}
        for command, options in given.items():
            source = [path] if path else []
            output = self.call([command, *source, *options], feedback, start, ENDS[command])
            start = ENDS[command]
            if command == "compare":
                results["MAE"] = json.loads(output.splitlines()[-1])["mae"]
            else:
                _, path = scene_of(output)
        scene = read_scene(path)
        found = products(scene, (*ALGORITHMS["prep"][2], *ALGORITHMS["export"][2], "difference"))
        self.load({"footprints": path, **found}, context, scene["id"])
        results.update({name.upper(): file for name, file in found.items() if name not in VECTORS})
        return {"SCENE_DOCUMENT": path, **results}


def asked(step: Any, command: Any) -> Any:
    """Those fields of a step's form that are asked for here."""
    found = []
    for field in fields(step, command):
        name = field["flag"].lstrip("-")
        if name in ASKED[step]:
            field.update({"label": LABELS.get(name, field["label"]), "advanced": name in ADVANCED})
            found.append(field)
    return found
