# SPDX-License-Identifier: GPL-2.0-or-later
"""The Processing provider: its algorithms are made from what the executable says of itself."""

import os
from typing import Any

from processing.core.ProcessingConfig import ProcessingConfig, Setting
from qgis import utils
from qgis.core import Qgis, QgsMessageLog, QgsProcessingProvider
from qgis.PyQt.QtGui import QIcon

from ..forms import ALGORITHMS
from ..runner import INSTALL, CommandFailed, find_executable, usage_of
from .algorithm import CommandAlgorithm
from .change import ChangeAlgorithm
from .extras import SETTING, ReportAlgorithm, SetUpAlgorithm
from .run_all import RunAllAlgorithm

NEWEST_MAJOR = 0  # of the executable, that this plugin knows


class SattoolsProvider(QgsProcessingProvider):
    """Algorithms `sattools:prep` ... and `sattools:runall`."""

    def __init__(self) -> None:
        super().__init__()
        self.usage = None
        self.problem = ""

    def id(self) -> Any:
        return "sattools"

    def name(self) -> Any:
        return "sattools"

    def longName(self) -> Any:
        return "sattools: surface models and reflectance from satellite images"

    def icon(self) -> Any:
        return QIcon(os.path.join(os.path.dirname(os.path.dirname(__file__)), "icon.svg"))

    def load(self) -> Any:
        ProcessingConfig.settingIcons[self.name()] = self.icon()
        ProcessingConfig.addSetting(
            Setting(self.name(), SETTING, "Path of the sattools executable (empty: the one on PATH)", "",
                    valuetype=Setting.FILE)
        )  # fmt: skip
        ProcessingConfig.readSettings()
        self.refreshAlgorithms()
        return True

    def unload(self) -> None:
        ProcessingConfig.removeSetting(SETTING)

    def executable(self) -> Any:
        """Path of the executable, or None."""
        return find_executable(ProcessingConfig.getSetting(SETTING) or "")

    def warningMessage(self) -> Any:
        return self.problem

    def loadAlgorithms(self) -> None:
        self.problem = ""
        path, setting = self.executable(), ProcessingConfig.getSetting(SETTING)
        if path is None:
            problem = f"{setting}: is no executable file; {INSTALL}" if setting else INSTALL
            self._complain(problem)
            self.addAlgorithm(SetUpAlgorithm(problem))
            return
        try:
            self.usage = usage_of(path)
        except CommandFailed as error:
            self._complain(str(error))
            self.addAlgorithm(SetUpAlgorithm(str(error)))
            return
        if int(self.usage["version"].split(".")[0]) > NEWEST_MAJOR:
            self._complain(f"sattools {self.usage['version']} is newer than this plugin: update the plugin")
        for name in ALGORITHMS:
            if name in self.usage["commands"]:
                make = ChangeAlgorithm if name == "change" else CommandAlgorithm
                self.addAlgorithm(make(name, self.usage["commands"][name], path))
        self.addAlgorithm(RunAllAlgorithm(self.usage, path))
        self.addAlgorithm(ReportAlgorithm(path))

    def _complain(self, text: Any) -> None:
        """Say it in the log, in the toolbox and, where QGIS has a window, above its map."""
        self.problem = text
        if utils.iface is not None:
            utils.iface.messageBar().pushMessage("sattools", text, level=Qgis.Warning, duration=0)
        QgsMessageLog.logMessage(text, "sattools", Qgis.Warning)
