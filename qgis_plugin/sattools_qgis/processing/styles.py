# SPDX-License-Identifier: GPL-2.0-or-later
"""How the products look: one ramp per quantity, the same in every project."""

from typing import Any

from qgis.core import (
    QgsColorRampShader,
    QgsGradientColorRamp,
    QgsGradientStop,
    QgsHillshadeRenderer,
    QgsProcessingLayerPostProcessorInterface,
    QgsProject,
    QgsRasterBandStats,
    QgsRasterLayer,
    QgsSingleBandPseudoColorRenderer,
    QgsStyle,
)
from qgis.PyQt.QtGui import QColor, QPainter

# product -> (ramp, lowest, highest); None = from the data
RAMPS = {
    "dsm": ("Viridis", None, None),
    "prior_dsm": ("Viridis", None, None),
    "dsm_std": ("Magma", 0.0, None),
    "prior_confidence": ("Cividis", 0.0, 1.0),
    "prior_probability": ("Cividis", 0.0, 1.0),
    "probability": ("Cividis", 0.0, 1.0),
    "w": ("Viridis", 0.0, 0.8),
    "b": ("Plasma", 0.0, 1.0),
    "c": ("Plasma", 0.0, 1.0),
    "theta": ("Inferno", 0.0, 60.0),
}
DIFFERENCE_M = 5.0  # end of the blue-red ramp


class Styler(QgsProcessingLayerPostProcessorInterface):
    """Colours a raster layer."""

    def __init__(self, name: Any) -> None:
        super().__init__()
        self.name = name

    def postProcessLayer(self, layer: Any, context: Any, feedback: Any) -> None:
        if self.name == "difference":
            ramp = QgsGradientColorRamp(
                QColor("#2166ac"), QColor("#b2182b"), False, [QgsGradientStop(0.5, QColor("#f7f7f7"))]
            )
            colour(layer, ramp, -DIFFERENCE_M, DIFFERENCE_M)
            return
        ramp_name, low, high = RAMPS[self.name]
        stats = layer.dataProvider().bandStatistics(
            1, QgsRasterBandStats.Min | QgsRasterBandStats.Max, layer.extent(), 250000
        )
        ramp = QgsStyle.defaultStyle().colorRamp(ramp_name) or QgsGradientColorRamp(
            QColor("#440154"), QColor("#fde725")
        )
        colour(layer, ramp, stats.minimumValue if low is None else low, stats.maximumValue if high is None else high)
        if self.name in ("dsm", "prior_dsm"):
            shade(layer)


def colour(layer: Any, ramp: Any, low: Any, high: Any) -> None:
    """Pseudo-colours between two values."""
    shader = QgsColorRampShader(low, high, ramp, QgsColorRampShader.Interpolated)
    shader.classifyColorRamp(9, 1, layer.extent(), layer.dataProvider())
    renderer = QgsSingleBandPseudoColorRenderer(layer.dataProvider(), 1, None)
    renderer.setShader(raster_shader(shader))
    renderer.setClassificationMin(low)
    renderer.setClassificationMax(high)
    layer.setRenderer(renderer)
    layer.triggerRepaint()


def raster_shader(function: Any) -> Any:
    """A QgsRasterShader around a colour ramp."""
    from qgis.core import QgsRasterShader

    shader = QgsRasterShader()
    shader.setRasterShaderFunction(function)
    return shader


def shade(layer: Any) -> None:
    """A hillshade of the same file below the layer, which is multiplied onto it."""
    below = QgsRasterLayer(layer.source(), f"{layer.name()} hillshade")
    renderer = QgsHillshadeRenderer(below.dataProvider(), 1, 315, 40)
    renderer.setMultiDirectional(True)
    renderer.setZFactor(0.4)  # walls of a city would be black otherwise
    below.setRenderer(renderer)
    layer.setBlendMode(QPainter.CompositionMode_Multiply)
    project = QgsProject.instance()
    project.addMapLayer(below, False)
    node = project.layerTreeRoot().findLayer(layer.id())
    parent, place = (node.parent(), node.parent().children().index(node)) if node else (project.layerTreeRoot(), -1)
    parent.insertLayer(place + 1, below)


# QGIS calls a post-processor after the algorithm is gone and does not own it
_STYLERS = {}


def styler(name: Any) -> Any:
    """The post-processor of a product, or None for layers that QGIS shows well as they are."""
    if name not in RAMPS and name != "difference":
        return None
    return _STYLERS.setdefault(name, Styler(name))
