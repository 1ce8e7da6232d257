# SPDX-License-Identifier: GPL-2.0-or-later
"""Fields of a form as QGIS parameters, and their values as what the command line takes."""

from typing import Any

from qgis.core import (
    QgsCoordinateReferenceSystem,
    QgsProcessing,
    QgsProcessingException,
    QgsProcessingParameterBoolean,
    QgsProcessingParameterCrs,
    QgsProcessingParameterDefinition,
    QgsProcessingParameterEnum,
    QgsProcessingParameterExtent,
    QgsProcessingParameterFile,
    QgsProcessingParameterMultipleLayers,
    QgsProcessingParameterNumber,
    QgsProcessingParameterRasterLayer,
    QgsProcessingParameterString,
    QgsProcessingParameterVectorLayer,
    QgsProcessingUtils,
)

FORMATS = ["geojson", "json", "gpkg", "shp", "fgb"]  # vector files that the command line reads
POLYGONS = QgsProcessing.TypeVectorPolygon


def images_parameter() -> Any:
    """Where images are chosen: files, as QGIS cannot place images in sensor geometry."""
    return QgsProcessingParameterMultipleLayers("IMAGES", "Images with RPC cameras", QgsProcessing.TypeFile)


def parameter_of(field: Any) -> Any:
    """The QGIS parameter of a form's field, with its help and its place."""
    parameter = _parameter(field)
    parameter.setHelp(field["help"])
    if field["advanced"] and field["key"] != "OVERWRITE":
        parameter.setFlags(parameter.flags() | QgsProcessingParameterDefinition.FlagAdvanced)
    return parameter


def _parameter(field: Any) -> Any:
    key, label, default, kind = field["key"], field["label"], field["default"], field["type"]
    if kind == "bool":
        return QgsProcessingParameterBoolean(key, label, defaultValue=bool(default))
    if kind in ("choice", "choices", "switch"):
        return QgsProcessingParameterEnum(
            key, label, options=field["choices"], allowMultiple=kind == "choices", defaultValue=default, optional=True,
            usesStaticStrings=True,
        )  # fmt: skip
    if kind in ("int", "float"):
        number = QgsProcessingParameterNumber.Integer if kind == "int" else QgsProcessingParameterNumber.Double
        limits = {"minValue": field["minimum"], "maxValue": field["maximum"]}
        limits = {name: limit for name, limit in limits.items() if limit is not None}
        return QgsProcessingParameterNumber(key, label, type=number, defaultValue=default, optional=True, **limits)
    if kind in ("file", "folder"):
        behaviour = QgsProcessingParameterFile.Folder if kind == "folder" else QgsProcessingParameterFile.File
        default = None if default in (None, ".") else default
        return QgsProcessingParameterFile(
            key, label, behavior=behaviour, defaultValue=default, optional=field["optional"]
        )
    layers: Any = {
        "extent": lambda: QgsProcessingParameterExtent(key, label, optional=True),
        "crs": lambda: QgsProcessingParameterCrs(key, label, optional=True),
        "raster": lambda: QgsProcessingParameterRasterLayer(key, label, optional=True),
        "polygons": lambda: QgsProcessingParameterVectorLayer(key, label, types=[POLYGONS], optional=True),
        "several polygons": lambda: QgsProcessingParameterMultipleLayers(key, label, POLYGONS, optional=True),
    }
    if kind in layers:
        return layers[kind]()
    return QgsProcessingParameterString(key, label, defaultValue=default, optional=True)


def read(algorithm: Any, field: Any, parameters: Any, context: Any, feedback: Any) -> Any:
    """Value of a field as the command line takes it, None if it was left empty."""
    key, kind = field["key"], field["type"]
    if kind == "bool":
        return algorithm.parameterAsBool(parameters, key, context)
    if parameters.get(key) in (None, ""):
        return None
    simple = {
        "choice": algorithm.parameterAsEnumString,
        "switch": algorithm.parameterAsEnumString,
        "choices": algorithm.parameterAsEnumStrings,
        "int": algorithm.parameterAsInt,
        "float": algorithm.parameterAsDouble,
        "file": algorithm.parameterAsFile,
        "folder": algorithm.parameterAsFile,
    }
    if kind in simple:
        return simple[kind](parameters, key, context)
    if kind == "extent":
        return extent(algorithm, key, parameters, context)
    if kind == "crs":
        return name_of(algorithm.parameterAsCrs(parameters, key, context))
    if kind == "raster":
        layer = algorithm.parameterAsRasterLayer(parameters, key, context)
        return layer.source() if layer is not None else algorithm.parameterAsString(parameters, key, context)
    if kind == "polygons":
        return _file_of(algorithm.parameterAsVectorLayer(parameters, key, context), key, context, feedback)
    if kind == "several polygons":
        layers = algorithm.parameterAsLayerList(parameters, key, context)
        given = parameters[key] if isinstance(parameters[key], (list, tuple)) else [parameters[key]]
        layers += [None] * (len(given) - len(layers))  # QGIS leaves out what it cannot open
        return [_file_of(layer, key, context, feedback) for layer in layers]
    return algorithm.parameterAsString(parameters, key, context)


def extent(algorithm: Any, key: Any, parameters: Any, context: Any) -> Any:
    """West, south, east, north in the form's CRS, or in degrees where it has none: what --bounds takes."""
    crs = algorithm.parameterAsCrs(parameters, "CRS", context) if parameters.get("CRS") else None
    if crs is None or not crs.isValid():
        crs = QgsCoordinateReferenceSystem("EPSG:4326")
    box = algorithm.parameterAsExtent(parameters, key, context, crs)
    if box.isNull() or box.isEmpty():
        return None
    return [f"{value:.10g}" for value in (box.xMinimum(), box.yMinimum(), box.xMaximum(), box.yMaximum())]


def name_of(crs: Any) -> Any:
    """`EPSG:32631`, or WKT for a CRS without a name; None for none."""
    if not crs.isValid():
        return None
    return crs.authid() if crs.authid().split(":")[0] in ("EPSG", "ESRI") else crs.toWkt()


def _file_of(layer: Any, key: Any, context: Any, feedback: Any) -> Any:
    """A file with the layer's features: its own, or a copy where it lies in memory, a database or beside others.

    Raises QgsProcessingException where QGIS could not open it: without it another area would be worked on.
    """
    if layer is None:
        raise QgsProcessingException(f"{key}: found no vector layer that can be opened, expected one of polygons")
    return QgsProcessingUtils.convertToCompatibleFormat(
        layer, False, f"sattools_{key.lower()}", FORMATS, "gpkg", context, feedback
    )
