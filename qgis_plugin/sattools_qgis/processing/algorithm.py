# SPDX-License-Identifier: GPL-2.0-or-later
"""One command of the suite as an algorithm."""

import json
from typing import Any

from qgis.core import (
    QgsProcessing,
    QgsProcessingException,
    QgsProcessingOutputFile,
    QgsProcessingOutputNumber,
    QgsProcessingOutputRasterLayer,
    QgsProcessingParameterBoolean,
    QgsProcessingParameterDefinition,
    QgsProcessingParameterEnum,
    QgsProcessingParameterFile,
    QgsProcessingParameterMultipleLayers,
    QgsProcessingParameterNumber,
    QgsProcessingParameterString,
)

from ..forms import ALGORITHMS, SOURCES, arguments, fields, products, scene_of
from .base import Base

PLAIN = 6  # options that show at once; the others fold away as advanced
FIGURES = ("mae", "median", "completeness")


class CommandAlgorithm(Base):
    """Made from the command's own description, so that form and command line cannot drift apart."""

    def __init__(self, command: Any, usage: Any, executable: Any) -> None:
        super().__init__(executable)
        self.command, self.usage = command, usage
        self.form = fields(usage)

    def createInstance(self) -> Any:
        return CommandAlgorithm(self.command, self.usage, self.executable)

    def name(self) -> Any:
        return self.command

    def displayName(self) -> Any:
        return ALGORITHMS[self.command][0]

    def shortHelpString(self) -> Any:
        return self.usage["help"]

    def initAlgorithm(self, config: Any = None) -> None:
        if self.command == "prep":
            images = QgsProcessingParameterMultipleLayers("IMAGES", "Images with RPC cameras", QgsProcessing.TypeFile)
            self.addParameter(images)
        elif self.command not in SOURCES:
            self.addParameter(QgsProcessingParameterFile("SCENE", "Scene document (scene.json)", extension="json"))
        for number, field in enumerate(self.form):
            parameter = parameter_of(field)
            if number >= PLAIN and field["key"] != "OVERWRITE":
                parameter.setFlags(parameter.flags() | QgsProcessingParameterDefinition.FlagAdvanced)
            self.addParameter(parameter)
        self.addOutput(QgsProcessingOutputFile("SCENE_DOCUMENT", "Scene document"))
        for product in ALGORITHMS[self.command][1]:
            if product not in ("footprints", "tie_points"):
                self.addOutput(QgsProcessingOutputRasterLayer(product.upper(), product))
        if self.command == "compare":
            for figure in FIGURES:
                self.addOutput(QgsProcessingOutputNumber(figure.upper(), figure))

    def processAlgorithm(self, parameters: Any, context: Any, feedback: Any) -> Any:
        values = {f["key"]: read(self, f, parameters, context) for f in self.form}
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
                with open(scene_path, encoding="utf-8") as file:
                    scene = json.load(file)
            else:
                scene, scene_path = scene_of(output)
        except (ValueError, KeyError, IndexError, OSError) as error:
            raise QgsProcessingException(f"sattools {self.command}: unexpected output ({error})") from None
        found = products(scene, ALGORITHMS[self.command][1])
        if self.command == "prep":
            found = {"footprints": scene_path, **found}
        self.load(found, context)
        results |= {name.upper(): path for name, path in found.items() if name not in ("footprints", "tie_points")}
        return {"SCENE_DOCUMENT": scene_path, **results}


def parameter_of(field: Any) -> Any:
    """The QGIS parameter of a form's field."""
    key, label, default = field["key"], field["label"], field["default"]
    if field["type"] == "bool":
        return QgsProcessingParameterBoolean(key, label, defaultValue=bool(default))
    if field["type"] == "choice":
        return QgsProcessingParameterEnum(
            key, label, options=field["choices"], defaultValue=default, optional=True, usesStaticStrings=True
        )
    if field["type"] in ("int", "float"):
        kind = QgsProcessingParameterNumber.Integer if field["type"] == "int" else QgsProcessingParameterNumber.Double
        limits = {}
        if field["minimum"] is not None:
            limits["minValue"] = field["minimum"]
        if field["maximum"] is not None:
            limits["maxValue"] = field["maximum"]
        return QgsProcessingParameterNumber(key, label, type=kind, defaultValue=default, optional=True, **limits)
    if field["type"] in ("file", "folder"):
        behaviour = QgsProcessingParameterFile.Folder if field["type"] == "folder" else QgsProcessingParameterFile.File
        default = None if default in (None, ".") else default
        return QgsProcessingParameterFile(key, label, behavior=behaviour, defaultValue=default, optional=True)
    return QgsProcessingParameterString(key, label, defaultValue=default, optional=True)


def read(algorithm: Any, field: Any, parameters: Any, context: Any) -> Any:
    """Value of a field, None if it was left empty."""
    key = field["key"]
    if parameters.get(key) is None and field["type"] != "bool":
        return None
    if field["type"] == "bool":
        return algorithm.parameterAsBool(parameters, key, context)
    if field["type"] == "choice":
        return algorithm.parameterAsEnumString(parameters, key, context)
    if field["type"] == "int":
        return algorithm.parameterAsInt(parameters, key, context)
    if field["type"] == "float":
        return algorithm.parameterAsDouble(parameters, key, context)
    if field["type"] in ("file", "folder"):
        return algorithm.parameterAsFile(parameters, key, context)
    return algorithm.parameterAsString(parameters, key, context)
