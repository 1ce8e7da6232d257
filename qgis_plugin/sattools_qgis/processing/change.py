# SPDX-License-Identifier: GPL-2.0-or-later
"""Two dates of one place as an algorithm."""

import json
import os
from typing import Any

from qgis.core import (
    QgsProcessingException,
    QgsProcessingOutputFile,
    QgsProcessingOutputNumber,
    QgsProcessingOutputRasterLayer,
    QgsProcessingParameterFile,
)

from ..forms import arguments
from .algorithm import CommandAlgorithm
from .parameters import parameter_of, read

FILES = {"changes": "changes.gpkg", "height_change": "height_change.tif", "significance": "significance.tif"}
DATES = {"BEFORE": "Earlier date", "AFTER": "Later date"}
FILTER = "Scene documents and rasters of heights (*.json *.tif *.tiff)"


class ChangeAlgorithm(CommandAlgorithm):
    """Takes two scenes or rasters instead of one scene, and leaves maps and polygons in a folder."""

    def __init__(self, command: Any, usage: Any, executable: Any) -> None:
        super().__init__(command, usage, executable)
        # beside the earlier date: the folder that QGIS was started in is nobody's choice
        self.form = [{**field, "default": None} if field["key"] == "OUT" else field for field in self.form]

    def createInstance(self) -> Any:
        return ChangeAlgorithm(self.command, self.usage, self.executable)

    def initAlgorithm(self, config: Any = None) -> None:
        for key, label in DATES.items():
            text = f"{label}: scene document (scene.json) or raster of heights"
            self.addParameter(QgsProcessingParameterFile(key, text, fileFilter=FILTER))
        for field in self.form:
            self.addParameter(parameter_of(field))
        self.addOutput(QgsProcessingOutputFile("CHANGES", "Polygons of what has changed"))
        for name in ("height_change", "significance"):
            self.addOutput(QgsProcessingOutputRasterLayer(name.upper(), name))
        self.addOutput(QgsProcessingOutputNumber("REGIONS", "Number of regions that have changed"))

    def processAlgorithm(self, parameters: Any, context: Any, feedback: Any) -> Any:
        values = {field["key"]: read(self, field, parameters, context, feedback) for field in self.form}
        dates = [self.parameterAsFile(parameters, key, context) for key in DATES]
        values["OUT"] = values.get("OUT") or os.path.join(os.path.dirname(os.path.abspath(dates[0])), "change")
        output = self.call([self.command, *dates, *arguments(self.form, values)], feedback)
        try:
            regions = len(json.loads(output.splitlines()[-1])["regions"])
        except (ValueError, KeyError, IndexError) as error:
            raise QgsProcessingException(f"sattools {self.command}: unexpected output ({error})") from None
        found = {name: os.path.join(values["OUT"], file) for name, file in FILES.items()}
        self.load(found, context, "change")
        return {**{name.upper(): path for name, path in found.items()}, "REGIONS": regions, "OUT": values["OUT"]}
