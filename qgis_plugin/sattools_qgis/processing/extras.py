# SPDX-License-Identifier: GPL-2.0-or-later
"""Algorithms beside the work itself: the report, and what stands in the toolbox where the executable is missing."""

from typing import Any

from processing.core.ProcessingConfig import ProcessingConfig
from qgis import utils
from qgis.core import (
    QgsApplication,
    QgsProcessingAlgorithm,
    QgsProcessingException,
    QgsProcessingOutputHtml,
    QgsProcessingParameterBoolean,
    QgsProcessingParameterFile,
)
from qgis.PyQt.QtCore import QUrl
from qgis.PyQt.QtGui import QDesktopServices

from ..runner import CommandFailed, find_executable, usage_of
from .base import Base

SETTING = "SATTOOLS_EXECUTABLE"


class ReportAlgorithm(Base):
    """Writes a scene's page and opens it in the browser."""

    page = None

    def createInstance(self) -> Any:
        return ReportAlgorithm(self.executable)

    def name(self) -> Any:
        return "report"

    def displayName(self) -> Any:
        return "Open report"

    def group(self) -> Any:
        return "All in one"

    def shortHelpString(self) -> Any:
        return "Writes a page about a scene - images, cameras, surface, errors, maps - and opens it in the browser."

    def initAlgorithm(self, config: Any = None) -> None:
        self.addParameter(QgsProcessingParameterFile("SCENE", "Scene document (scene.json)", extension="json"))
        self.addParameter(QgsProcessingParameterBoolean("OPEN", "Open it in the browser", defaultValue=True))
        self.addOutput(QgsProcessingOutputHtml("REPORT", "Report"))

    def processAlgorithm(self, parameters: Any, context: Any, feedback: Any) -> Any:
        scene = self.parameterAsFile(parameters, "SCENE", context)
        path = self.call(["report", scene, "--overwrite"], feedback).splitlines()[-1]
        if self.parameterAsBool(parameters, "OPEN", context):
            self.page = path
        return {"REPORT": path}

    def postProcessAlgorithm(self, context: Any, feedback: Any) -> Any:
        """Runs in the main thread, where windows may be opened; without a window nothing is."""
        if self.page and utils.iface is not None:
            QDesktopServices.openUrl(QUrl.fromLocalFile(self.page))
        return {}


class SetUpAlgorithm(QgsProcessingAlgorithm):
    """Stands in the toolbox in place of all others where the executable is missing, and asks for it."""

    def __init__(self, problem: Any) -> None:
        super().__init__()
        self.problem = problem

    def createInstance(self) -> Any:
        return SetUpAlgorithm(self.problem)

    def flags(self) -> Any:
        return super().flags() | QgsProcessingAlgorithm.FlagNoThreading  # it changes the toolbox

    def name(self) -> Any:
        return "setup"

    def displayName(self) -> Any:
        return "Set up: the sattools executable is missing"

    def shortHelpString(self) -> Any:
        return f"{self.problem}.\n\nOr choose the executable here and run: the other algorithms appear then."

    def initAlgorithm(self, config: Any = None) -> None:
        self.addParameter(QgsProcessingParameterFile("EXECUTABLE", "The sattools executable", optional=True))

    def processAlgorithm(self, parameters: Any, context: Any, feedback: Any) -> Any:
        chosen = self.parameterAsFile(parameters, "EXECUTABLE", context)
        path = find_executable(chosen)
        if path is None:
            raise QgsProcessingException(f"{chosen}: is no executable file" if chosen else self.problem)
        try:
            version = usage_of(path)["version"]
        except CommandFailed as error:
            raise QgsProcessingException(str(error)) from None
        ProcessingConfig.setSettingValue(SETTING, path)
        feedback.pushInfo(f"{path}: sattools {version}")
        return {}

    def postProcessAlgorithm(self, context: Any, feedback: Any) -> Any:
        provider = QgsApplication.processingRegistry().providerById("sattools")
        if provider is not None and utils.iface is not None:
            # not now: this algorithm belongs to the provider and would be deleted under its own feet
            from qgis.PyQt.QtCore import QTimer

            QTimer.singleShot(0, provider.refreshAlgorithms)
        return {}
