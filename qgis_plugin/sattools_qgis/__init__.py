# SPDX-License-Identifier: GPL-2.0-or-later
"""QGIS plugin: the sattools commands as Processing algorithms."""


def classFactory(iface):
    """What QGIS calls to make the plugin."""
    from .plugin import SattoolsPlugin

    return SattoolsPlugin(iface)
