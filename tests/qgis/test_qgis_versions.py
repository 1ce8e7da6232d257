"""What the plugin uses of QGIS is what these tables name; the QGIS at hand has it all.

Only one QGIS can be installed on a machine; the tables say what is held to be true of others. Checked so far: 3.22, by
the last test; parameters of numbers, in the reference of 3.38, where old names are aliases. The rest is to be confirmed
in https://qgis.org/pyqgis/3.40/ or by a run in 3.40. A name that the tables do not have fails the test.
"""

import ast
import json
import shutil
import subprocess
from pathlib import Path

import pytest
from patience import HANGING_S

PLUGIN = Path(__file__).parents[2] / "qgis_plugin" / "sattools_qgis"
OLDEST = "3.22"

# class -> version that documents it first; none of them is deprecated in 3.40
CLASSES = {
    "Qgis": "3.0", "QgsApplication": "3.0", "QgsColorRampShader": "3.0", "QgsContrastEnhancement": "3.0",
    "QgsCoordinateReferenceSystem": "3.0", "QgsFillSymbol": "3.0", "QgsGradientColorRamp": "3.0",
    "QgsGradientStop": "3.0", "QgsHillshadeRenderer": "3.0", "QgsLineSymbol": "3.0", "QgsMarkerSymbol": "3.0",
    "QgsMessageLog": "3.0", "QgsMultiBandColorRenderer": "3.0", "QgsPalettedRasterRenderer": "3.0",
    "QgsProcessing": "3.0", "QgsProcessingAlgorithm": "3.0", "QgsProcessingContext": "3.0",
    "QgsProcessingException": "3.0", "QgsProcessingLayerPostProcessorInterface": "3.2",
    "QgsProcessingOutputFile": "3.2", "QgsProcessingOutputHtml": "3.0", "QgsProcessingOutputNumber": "3.0",
    "QgsProcessingOutputRasterLayer": "3.0", "QgsProcessingParameterBoolean": "3.0",
    "QgsProcessingParameterCrs": "3.0", "QgsProcessingParameterDefinition": "3.0",
    "QgsProcessingParameterEnum": "3.0", "QgsProcessingParameterExtent": "3.0", "QgsProcessingParameterFile": "3.0",
    "QgsProcessingParameterMultipleLayers": "3.0", "QgsProcessingParameterNumber": "3.0",
    "QgsProcessingParameterRasterLayer": "3.0", "QgsProcessingParameterString": "3.0",
    "QgsProcessingParameterVectorLayer": "3.0", "QgsProcessingProvider": "3.0", "QgsProcessingUtils": "3.0",
    "QgsProject": "3.0", "QgsRasterLayer": "3.0", "QgsRasterShader": "3.0",
    "QgsSingleBandPseudoColorRenderer": "3.0", "QgsSingleSymbolRenderer": "3.0", "QgsStyle": "3.0",
    "QgsVectorLayer": "3.0",
}  # fmt: skip

# member of a class -> what it is called since 3.36 or 3.38, where the old name has become an alias of it; else None
MEMBERS = {
    "Qgis.Warning": "Qgis.MessageLevel.Warning",
    "QgsApplication.processingRegistry": None,
    "QgsColorRampShader.Interpolated": "Qgis.ShaderInterpolationMethod.Linear",
    "QgsContrastEnhancement.StretchToMinimumMaximum": None,
    "QgsFillSymbol.createSimple": None,
    "QgsLineSymbol.createSimple": None,
    "QgsMarkerSymbol.createSimple": None,
    "QgsMessageLog.logMessage": None,
    "QgsPalettedRasterRenderer.Class": None,
    "QgsProcessing.TypeFile": "Qgis.ProcessingSourceType.File",
    "QgsProcessing.TypeVectorPolygon": "Qgis.ProcessingSourceType.VectorPolygon",
    "QgsProcessingAlgorithm.FlagNoThreading": "Qgis.ProcessingAlgorithmFlag.NoThreading",
    "QgsProcessingContext.LayerDetails": None,
    "QgsProcessingParameterDefinition.FlagAdvanced": "Qgis.ProcessingParameterFlag.Advanced",
    "QgsProcessingParameterFile.File": "Qgis.ProcessingFileParameterBehavior.File",
    "QgsProcessingParameterFile.Folder": "Qgis.ProcessingFileParameterBehavior.Folder",
    "QgsProcessingParameterNumber.Double": "Qgis.ProcessingNumberParameterType.Double",
    "QgsProcessingParameterNumber.Integer": "Qgis.ProcessingNumberParameterType.Integer",
    "QgsProcessingUtils.convertToCompatibleFormat": None,
    "QgsProject.instance": None,
    "QgsStyle.defaultStyle": None,
}

# methods that 3.40's reference marks as deprecated, of classes that the plugin uses; all since 3.38
DEPRECATED = {
    *("band", "setBand", "grayBand", "setGrayBand"),  # of raster renderers: inputBand, setInputBand
    *("title", "setTitle", "abstract", "setAbstract"),  # of layers: serverProperties
}


def used() -> tuple[set[str], set[str], set[str]]:
    """Classes imported from QGIS, what is asked of these classes by name, and all attributes of anything."""
    classes, members, attributes = set(), set(), set()
    for path in PLUGIN.rglob("*.py"):
        tree = ast.parse(path.read_text(encoding="utf-8"))
        for node in ast.walk(tree):
            if isinstance(node, ast.ImportFrom) and node.module == "qgis.core":
                classes |= {alias.name for alias in node.names}
            if isinstance(node, ast.Attribute):
                attributes.add(node.attr)
                name = node.value.id if isinstance(node.value, ast.Name) else ""
                if name == "Qgis" or name.startswith("Qgs"):
                    members.add(f"{name}.{node.attr}")
    return classes, members, attributes


def test_every_class_and_member_is_documented_in_both_versions() -> None:
    classes, members, _ = used()
    assert classes - set(CLASSES) == set(), "look them up in the references of 3.22 and 3.40"
    assert members - set(MEMBERS) == set(), "look them up in the references of 3.22 and 3.40"
    assert {name for name, since in CLASSES.items() if tuple(map(int, since.split("."))) > (3, 22)} == set()
    assert set(CLASSES) - classes == set(), "no longer used"
    assert set(MEMBERS) - members == set(), "no longer used"


def test_nothing_that_3_40_marks_as_deprecated_is_called() -> None:
    assert used()[2] & DEPRECATED == set()


def test_nothing_is_asked_of_python_that_3_8_lacks() -> None:
    """QGIS 3.22 comes with Python 3.8 on macOS and Ubuntu 20.04, which unites no dictionaries by an operator."""
    numbers = ("flags()", "NEW_GROUP")
    for path in PLUGIN.rglob("*.py"):
        tree = ast.parse(path.read_text(encoding="utf-8"), feature_version=(3, 8))
        united = [n for n in ast.walk(tree) if isinstance(n, ast.AugAssign | ast.BinOp) and isinstance(n.op, ast.BitOr)]
        texts = [ast.unparse(node) for node in united]
        assert [(path.name, text) for text in texts if not any(name in text for name in numbers)] == []
    assert used()[2] & {"removeprefix", "removesuffix"} == set()


def test_the_plugin_names_the_oldest_version_it_was_looked_up_for() -> None:
    assert f"qgisMinimumVersion={OLDEST}" in (PLUGIN / "metadata.txt").read_text()


def test_the_version_at_hand_has_them_all() -> None:
    python = "/usr/bin/python3"  # QGIS comes with the system's
    look = """
import json, sys
import qgis.core
missing = []
for name in json.load(sys.stdin):
    thing = qgis.core
    for part in name.split("."):
        thing = getattr(thing, part, None)
    if thing is None:
        missing.append(name)
print(json.dumps(missing))
"""
    if shutil.which("qgis_process") is None or shutil.which(python) is None:
        pytest.skip("QGIS is not installed")
    names = json.dumps([*CLASSES, *MEMBERS])
    done = subprocess.run(
        [python, "-c", look], input=names, capture_output=True, text=True, timeout=HANGING_S, check=True
    )
    assert json.loads(done.stdout) == []
