# SPDX-License-Identifier: GPL-2.0-or-later
"""Where layers stand in the project: one group per scene, lines above maps, what says how good above what it is about.

QGIS 3.22 loads results in the order of their names, later ones by keys that 3.22 does not have; so layers are put in
their places here, one after the other.
"""

from typing import Any

# from top to bottom; those of the first two lines, and the surface, show at once
LINES = ("tie_points", "contours", "footprints")
SHOWN = ("contours", "footprints", "difference", "dsm", "prior_dsm")
ORDER = (
    *LINES, "difference", "dsm", "dsm hillshade", "prior_dsm", "prior_dsm hillshade", "ortho", "albedo", "reflectance",
    "w", "b", "c", "theta", "rho0", "k", "rhoc", "dsm_std", "probability", "validity", "prior_confidence",
    "prior_probability",
)  # fmt: skip


def rank(name: Any) -> Any:
    """Place of a layer in its group, 0 on top; layers without a place come last."""
    return ORDER.index(name) if name in ORDER else len(ORDER)


def place(project: Any, layer: Any, scene: Any) -> Any:
    """Move a layer to its place in the scene's group; an older layer of the same file goes. Returns its tree node."""
    root = project.layerTreeRoot()
    group = root.findGroup(scene) or root.insertGroup(0, scene)
    for other in group.findLayers():
        old = other.layer()
        if old is not None and old.id() != layer.id() and (old.name(), old.source()) == (layer.name(), layer.source()):
            project.removeMapLayer(old.id())
    before = [other for other in group.children() if rank(other.name()) <= rank(layer.name())]
    node = root.findLayer(layer.id())
    if node is not None and node.parent() is not None:
        before = [other for other in before if other is not node and _id(other) != layer.id()]
        node.parent().removeChildNode(node)
    node = group.insertLayer(len(before), layer)
    node.setItemVisibilityChecked(layer.name() in SHOWN or layer.name().endswith("hillshade"))
    node.setExpanded(False)
    return node


def _id(node: Any) -> Any:
    return node.layerId() if hasattr(node, "layerId") else None
