# SPDX-License-Identifier: GPL-2.0-or-later
"""Registers the Processing provider; never touches the interface, so that it also works in qgis_process."""

from typing import Any

from qgis.core import QgsApplication

from .processing.provider import SattoolsProvider


class SattoolsPlugin:
    """Adds and removes the provider."""

    def __init__(self, iface: Any) -> None:
        self.provider = None

    def initProcessing(self) -> None:
        """Called by QGIS and by qgis_process."""
        self.provider = SattoolsProvider()
        QgsApplication.processingRegistry().addProvider(self.provider)

    def initGui(self) -> None:
        """Called by QGIS with a window."""
        self.initProcessing()

    def unload(self) -> None:
        """Called when the plugin is switched off."""
        if self.provider is not None:
            QgsApplication.processingRegistry().removeProvider(self.provider)
            self.provider = None
