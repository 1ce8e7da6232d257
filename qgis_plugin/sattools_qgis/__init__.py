# SPDX-License-Identifier: GPL-2.0-or-later
"""QGIS plugin: the sattools commands as Processing algorithms."""

from typing import Any


def classFactory(iface: Any) -> Any:
    """What QGIS calls to make the plugin."""
    from .plugin import SattoolsPlugin

    return SattoolsPlugin(iface)
