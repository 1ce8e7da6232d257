# SPDX-License-Identifier: GPL-2.0-or-later
"""From images to a scored surface model in one algorithm."""

import json
from typing import Any

from qgis.core import (
    QgsProcessing,
    QgsProcessingOutputFile,
    QgsProcessingOutputNumber,
    QgsProcessingOutputRasterLayer,
    QgsProcessingParameterFile,
    QgsProcessingParameterMultipleLayers,
    QgsProcessingParameterString,
)

from ..forms import ALGORITHMS, products, scene_of
from .base import Base

# command -> percent of the whole at which it ends, as measured on seventeen 2-megapixel images
ENDS = {"prep": 25.0, "fit": 95.0, "export": 98.0, "compare": 100.0}


class RunAllAlgorithm(Base):
    """prep, fit, export and, with a reference, compare; every step at its defaults."""

    def createInstance(self) -> Any:
        return RunAllAlgorithm(self.executable)

    def name(self) -> Any:
        return "runall"

    def displayName(self) -> Any:
        return "Run all"

    def shortHelpString(self) -> Any:
        return (
            "Adjusts the cameras, matches the images, fits the surface and exports the maps, every step with its "
            "defaults; with a reference DSM the result is scored. Use the single algorithms to change options."
        )

    def initAlgorithm(self, config: Any = None) -> None:
        images = QgsProcessingParameterMultipleLayers("IMAGES", "Images with RPC cameras", QgsProcessing.TypeFile)
        self.addParameter(images)
        folder = QgsProcessingParameterFile.Folder
        self.addParameter(QgsProcessingParameterFile("METADATA", "Folder of metadata files", folder, optional=True))
        self.addParameter(QgsProcessingParameterString("ID", "Name of the scene", optional=True))
        self.addParameter(QgsProcessingParameterFile("OUT", "Folder for the scene's folder", folder))
        self.addParameter(QgsProcessingParameterFile("DSM", "Reference DSM", optional=True))
        self.addParameter(QgsProcessingParameterFile("CLASSES", "Class map of the reference", optional=True))
        self.addOutput(QgsProcessingOutputFile("SCENE_DOCUMENT", "Scene document"))
        for product in ("dsm", "dsm_std", "albedo", "difference"):
            self.addOutput(QgsProcessingOutputRasterLayer(product.upper(), product))
        self.addOutput(QgsProcessingOutputNumber("MAE", "mae"))

    def processAlgorithm(self, parameters: Any, context: Any, feedback: Any) -> Any:
        def given(key: Any) -> Any:
            value = self.parameterAsString(parameters, key, context)
            return [f"--{key.lower()}", value] if value else []

        images = self.parameterAsFileList(parameters, "IMAGES", context)
        steps = [("prep", [*images, *given("METADATA"), *given("ID"), *given("OUT")]), ("fit", []), ("export", [])]
        if given("DSM"):
            steps.append(("compare", [*given("DSM"), *given("CLASSES")]))
        path, start, results = None, 0.0, {}
        for command, options in steps:
            source = [path] if path else []
            output = self.call([command, *source, *options, "--overwrite"], feedback, start, ENDS[command])
            start = ENDS[command]
            if command == "compare":
                results["MAE"] = json.loads(output.splitlines()[-1])["mae"]
            else:
                _, path = scene_of(output)
        with open(path, encoding="utf-8") as file:
            scene = json.load(file)
        found = products(scene, (*ALGORITHMS["prep"][1], *ALGORITHMS["export"][1], "difference"))
        self.load({"footprints": path, **found}, context)
        results |= {name.upper(): file for name, file in found.items() if name != "tie_points"}
        return {"SCENE_DOCUMENT": path, **results}
