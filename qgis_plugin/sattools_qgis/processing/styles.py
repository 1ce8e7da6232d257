# SPDX-License-Identifier: GPL-2.0-or-later
"""How the products look: one ramp per quantity, the same in every project."""

from typing import Any

from qgis.core import (
    QgsColorRampShader,
    QgsContrastEnhancement,
    QgsFillSymbol,
    QgsGradientColorRamp,
    QgsGradientStop,
    QgsHillshadeRenderer,
    QgsLineSymbol,
    QgsMarkerSymbol,
    QgsMultiBandColorRenderer,
    QgsPalettedRasterRenderer,
    QgsProcessingLayerPostProcessorInterface,
    QgsProject,
    QgsRasterLayer,
    QgsRasterShader,
    QgsSingleBandPseudoColorRenderer,
    QgsSingleSymbolRenderer,
    QgsStyle,
)
from qgis.PyQt.QtGui import QColor, QPainter

from ..colours import shown_bands
from ..forms import PARAMETERS
from .layers import place

# product -> (ramp, lowest, highest); None = from the data, without the outermost hundredths
RAMPS = {
    "dsm": ("Viridis", None, None),
    "prior_dsm": ("Viridis", None, None),
    "dtm": ("Viridis", None, None),
    "ndsm": ("YlGn", 0.0, None),
    "dsm_std": ("Magma", 0.0, None),
    "dsm_error95": ("Magma", 0.0, None),
    "prior_confidence": ("Cividis", 0.0, 1.0),
    "prior_probability": ("Cividis", 0.0, 1.0),
    "probability": ("Cividis", 0.0, 1.0),
    "w": ("Viridis", 0.0, 0.8),
    "b": ("Plasma", 0.0, 1.0),
    "c": ("Plasma", 0.0, 1.0),
    "theta": ("Inferno", 0.0, 60.0),
    "rho0": ("Viridis", 0.0, None),
    "k": ("Plasma", None, None),
    "asymmetry": ("Plasma", -0.6, 0.6),
    "rhoc": ("Plasma", None, None),
    "identifiable": ("Cividis", 0.0, 1.0),
    "lambert_share": ("Cividis", 0.0, 1.0),
}
RAMPS.update({f"{name}_std": ("Magma", 0.0, None) for name in (*PARAMETERS, "normal")})
SURFACES = ("dsm", "dtm", "prior_dsm")
COLOURS = ("albedo", "ortho", "reflectance", "relit", "normal")
VALIDITY = (
    (0, "#d9d9d9", "unseen"), (1, "#1a9850", "measured"), (2, "#fdae61", "filled"), (3, "#f7f7f7", "outside"),
    (4, "#4393c3", "water, level assumed"),
)  # fmt: skip
LINES = {
    "footprints": lambda: QgsFillSymbol.createSimple(
        {"style": "no", "outline_color": "#ff7f0e", "outline_width": "0.4"}
    ),
    "tie_points": lambda: QgsMarkerSymbol.createSimple({"color": "#e7298a", "size": "1.2", "outline_style": "no"}),
    "changes": lambda: QgsFillSymbol.createSimple({"style": "no", "outline_color": "#000000", "outline_width": "0.5"}),
    "contours": lambda: QgsLineSymbol.createSimple({"color": "#5c4033", "width": "0.15"}),
}
GROUND = ((0, "#d9d9d9", "unseen"), (1, "#1a9850", "seen"), (2, "#fdae61", "interpolated"), (3, "#f7f7f7", "outside"))
SIGNED = {"difference": 5.0, "height_change": 5.0, "significance": 5.0}  # end of the blue-red ramp [m or deviations]
CUT = (0.02, 0.98)  # shares of the cells between which a ramp spans
SAMPLE = 250_000  # cells are enough for that


class Styler(QgsProcessingLayerPostProcessorInterface):
    """Colours a layer, and puts it in its place."""

    def __init__(self, name: Any, scene: Any) -> None:
        super().__init__()
        self.name, self.scene = name, scene

    def postProcessLayer(self, layer: Any, context: Any, feedback: Any) -> None:
        project = context.project() or QgsProject.instance()
        dress(layer, self.name)
        place(project, layer, self.scene)
        if self.name in SURFACES:
            place(project, shaded(layer, project), self.scene)


def dress(layer: Any, name: Any) -> None:
    """Give a layer its product's look; unknown products keep QGIS's own."""
    if name in LINES:
        layer.setRenderer(QgsSingleSymbolRenderer(LINES[name]()))
    elif name in SIGNED:
        middle = [QgsGradientStop(0.5, QColor("#f7f7f7"))]
        colour(
            layer,
            QgsGradientColorRamp(QColor("#2166ac"), QColor("#b2182b"), False, middle),
            -SIGNED[name],
            SIGNED[name],
        )
    elif name in ("validity", "dtm_validity"):
        shades = VALIDITY if name == "validity" else GROUND
        classes = [QgsPalettedRasterRenderer.Class(value, QColor(shade), text) for value, shade, text in shades]
        layer.setRenderer(QgsPalettedRasterRenderer(layer.dataProvider(), 1, classes))
    elif name in COLOURS:
        natural(layer)
    elif name in RAMPS:
        ramp_name, low, high = RAMPS[name]
        least, most = robust(layer, 1)
        ramp = QgsStyle.defaultStyle().colorRamp(ramp_name)
        ramp = ramp or QgsGradientColorRamp(QColor("#440154"), QColor("#fde725"))
        colour(layer, ramp, least if low is None else low, most if high is None else high)


def robust(layer: Any, band: Any) -> Any:
    """(low, high) between which all but the outermost cells lie: one cell of 300 m makes no map black."""
    provider = layer.dataProvider()
    low, high = provider.cumulativeCut(band, *CUT, layer.extent(), SAMPLE)
    return (low, high) if high > low else (low, low + 1e-6)


def colour(layer: Any, ramp: Any, low: Any, high: Any) -> None:
    """Pseudo-colours between two values."""
    function = QgsColorRampShader(low, max(high, low + 1e-6), ramp, QgsColorRampShader.Interpolated)
    function.classifyColorRamp(9, 1, layer.extent(), layer.dataProvider())
    shader = QgsRasterShader()
    shader.setRasterShaderFunction(function)
    renderer = QgsSingleBandPseudoColorRenderer(layer.dataProvider(), 1, None)
    renderer.setShader(shader)
    renderer.setClassificationMin(low)
    renderer.setClassificationMax(high)
    layer.setRenderer(renderer)
    layer.triggerRepaint()


def natural(layer: Any) -> None:
    """Red, green and blue in one stretch, so that colours stay colours; a single band in grey as QGIS has it."""
    if layer.bandCount() < 3:
        return
    provider = layer.dataProvider()
    bands = shown_bands([layer.bandName(band) for band in range(1, layer.bandCount() + 1)])
    limits = [robust(layer, band) for band in bands]
    low, high = min(pair[0] for pair in limits), max(pair[1] for pair in limits)
    renderer = QgsMultiBandColorRenderer(provider, *bands)
    setters = (renderer.setRedContrastEnhancement, renderer.setGreenContrastEnhancement,
               renderer.setBlueContrastEnhancement)  # fmt: skip
    for band, setter in zip(bands, setters):
        enhancement = QgsContrastEnhancement(provider.dataType(band))
        enhancement.setContrastEnhancementAlgorithm(QgsContrastEnhancement.StretchToMinimumMaximum)
        enhancement.setMinimumValue(low)
        enhancement.setMaximumValue(high)
        setter(enhancement)
    layer.setRenderer(renderer)


def shaded(layer: Any, project: Any) -> Any:
    """A hillshade of the same file, for below the layer, which is multiplied onto it."""
    below = QgsRasterLayer(layer.source(), f"{layer.name()} hillshade")
    renderer = QgsHillshadeRenderer(below.dataProvider(), 1, 315, 40)
    renderer.setMultiDirectional(True)
    renderer.setZFactor(0.4)  # walls of a city would be black otherwise
    below.setRenderer(renderer)
    layer.setBlendMode(QPainter.CompositionMode.CompositionMode_Multiply)
    project.addMapLayer(below, False)
    return below


# QGIS calls a post-processor after the algorithm is gone, keeps no reference to it, and may delete it afterwards
_STYLERS = []


def styler(name: Any, scene: Any) -> Any:
    """A post-processor for one layer: a product of a scene."""
    _STYLERS.append(Styler(name, scene))
    return _STYLERS[-1]
