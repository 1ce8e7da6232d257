# SPDX-License-Identifier: GPL-2.0-or-later
"""One command of the suite as an algorithm."""

import json
from typing import Any

from qgis.core import (
    QgsProcessingException,
    QgsProcessingOutputFile,
    QgsProcessingOutputNumber,
    QgsProcessingOutputRasterLayer,
    QgsProcessingParameterFile,
)

from ..forms import ALGORITHMS, SOURCES, arguments, document_of, fields, paragraphs, products, read_scene, scene_of
from .base import VECTORS, Base
from .parameters import images_parameter, parameter_of, read

FIGURES = ("mae", "median", "completeness")


class CommandAlgorithm(Base):
    """Made from the command's own description, so that form and command line cannot drift apart."""

    def __init__(self, command: Any, usage: Any, executable: Any) -> None:
        super().__init__(executable)
        self.command, self.usage = command, usage
        self.form = fields(command, usage)

    def createInstance(self) -> Any:
        return CommandAlgorithm(self.command, self.usage, self.executable)

    def name(self) -> Any:
        return self.command

    def displayName(self) -> Any:
        return ALGORITHMS[self.command][0]

    def group(self) -> Any:
        return ALGORITHMS[self.command][1]

    def shortHelpString(self) -> Any:
        return paragraphs(self.usage["help"])

    def initAlgorithm(self, config: Any = None) -> None:
        if self.command == "prep":
            self.addParameter(images_parameter())
        elif self.command not in SOURCES:
            self.addParameter(QgsProcessingParameterFile("SCENE", "Scene document (scene.json)", extension="json"))
        for field in self.form:
            self.addParameter(parameter_of(field))
        self.addOutput(QgsProcessingOutputFile("SCENE_DOCUMENT", "Scene document"))
        for product in ALGORITHMS[self.command][2]:
            if product not in VECTORS:
                self.addOutput(QgsProcessingOutputRasterLayer(product.upper(), product))
        if self.command == "compare":
            for figure in FIGURES:
                self.addOutput(QgsProcessingOutputNumber(figure.upper(), figure))

    def processAlgorithm(self, parameters: Any, context: Any, feedback: Any) -> Any:
        values = {f["key"]: read(self, f, parameters, context, feedback) for f in self.form}
        options = arguments(self.form, values)
        scene_path = None
        if self.command == "prep":
            options = [*self.parameterAsFileList(parameters, "IMAGES", context), *options]
        elif self.command not in SOURCES:
            scene_path = self.parameterAsFile(parameters, "SCENE", context)
            options = [scene_path, *options]
        output = self.call([self.command, *options], feedback)
        try:
            results = {}
            if self.command == "compare":
                figures = json.loads(output.splitlines()[-1])
                results = {name.upper(): figures[name] for name in FIGURES}
                scene = read_scene(scene_path)
                scene_path = document_of(scene, scene_path)
            else:
                scene, scene_path = scene_of(output)
        except (ValueError, KeyError, IndexError, OSError) as error:
            raise QgsProcessingException(f"sattools {self.command}: unexpected output ({error})") from None
        found = products(scene, ALGORITHMS[self.command][2])
        if self.command == "prep":
            found = {"footprints": scene_path, **found}
        self.load(found, context, scene["id"])
        results.update({name.upper(): path for name, path in found.items() if name not in VECTORS})
        return {"SCENE_DOCUMENT": scene_path, **results}
