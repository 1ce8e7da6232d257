# SPDX-License-Identifier: GPL-2.0-or-later
"""What all algorithms share: running a command under a feedback, loading its results."""

import os
from typing import Any

from qgis.core import (
    QgsProcessingAlgorithm,
    QgsProcessingContext,
    QgsProcessingException,
    QgsRasterLayer,
    QgsVectorLayer,
)
from qgis.PyQt.QtGui import QIcon

from ..runner import Cancelled, CommandFailed, as_typed, run
from .styles import styler

VECTORS = ("footprints", "tie_points", "contours", "changes")  # products that are no rasters


class Base(QgsProcessingAlgorithm):
    """Runs the executable; subclasses say with what."""

    def __init__(self, executable: Any) -> None:
        super().__init__()
        self.executable = executable

    def icon(self) -> Any:
        return QIcon(os.path.join(os.path.dirname(os.path.dirname(__file__)), "icon.svg"))

    def groupId(self) -> Any:
        return self.group().lower().replace(" ", "")

    def call(self, arguments: Any, feedback: Any, first: Any = 0.0, last: Any = 100.0) -> Any:
        """Run `sattools --progress json ...`; progress goes from first to last percent.

        Raises QgsProcessingException with the command's last line.
        """
        whole = [self.executable, "--progress", "json", *arguments]
        feedback.pushCommandInfo(as_typed(whole))
        said = set()

        def on_progress(share: Any, message: Any) -> None:
            feedback.setProgress(first + share * (last - first))
            if message not in said:
                said.add(message)
                feedback.pushInfo(message)

        def on_line(line: Any) -> None:
            tell = feedback.pushWarning if line.startswith("sattools: ") else feedback.pushInfo
            tell(line)

        try:
            return run(whole, on_progress, on_line, feedback.isCanceled)
        except Cancelled:
            raise QgsProcessingException("cancelled: every process has ended") from None
        except CommandFailed as error:
            raise QgsProcessingException(str(error)) from None
        except OSError as error:
            raise QgsProcessingException(f"{self.executable}: cannot be run ({error})") from None

    def load(self, paths: Any, context: Any, scene: Any) -> None:
        """Add layers to the project when the algorithm has finished; paths: product name -> file; scene: its name."""
        if context.project() is None:
            return
        for name, path in paths.items():
            layer = QgsVectorLayer(path, name, "ogr") if name in VECTORS else QgsRasterLayer(path, name)
            if not layer.isValid():
                continue
            context.temporaryLayerStore().addMapLayer(layer)
            details = QgsProcessingContext.LayerDetails(name, context.project(), name)
            details.setPostProcessor(styler(name, scene))
            context.addLayerToLoadOnCompletion(layer.id(), details)
