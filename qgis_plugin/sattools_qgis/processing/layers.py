# SPDX-License-Identifier: GPL-2.0-or-later
"""Where layers stand in the project: one group per scene, what says how good below what it is about.

QGIS 3.22 loads results in the order of their names, later ones by keys that 3.22 does not have; so layers are put in
their places here, one after the other.
"""

from typing import Any

from ..forms import MATERIAL

SHOWN = ("changes", "height_change", "contours", "footprints", "difference", "dsm", "prior_dsm")
# From top to bottom. QGIS gives a new project its topmost layer's CRS: footprints in degrees would squeeze the maps.
ORDER = (
    "changes", "height_change", "significance",
    "contours", "difference", "dsm", "dsm hillshade", "prior_dsm", "prior_dsm hillshade", "dtm", "dtm hillshade",
    "ndsm", "ortho", "relit", "albedo", *MATERIAL, "dsm_std",
    "dsm_error95", "probability", "validity", "dtm_validity", "prior_confidence", "prior_probability",
    "tie_points", "footprints",
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
    old = root.findLayer(layer.id())
    before = [
        other for other in group.children() if _id(other) != layer.id() and rank(other.name()) <= rank(layer.name())
    ]
    after = group.children()[group.children().index(before[-1]) + 1 :] if before else group.children()
    node = group.insertLayer(len(group.children()) - len(after), layer)
    if old is not None:  # only now: QGIS drops a layer from the project that is nowhere in the tree
        old.parent().removeChildNode(old)
    node.setItemVisibilityChecked(layer.name() in SHOWN or layer.name().endswith("hillshade"))
    node.setExpanded(False)
    if (
        project.crs().isGeographic()
        and len(group.findLayers()) == len(project.mapLayers())
        and not layer.crs().isGeographic()
    ):
        project.setCrs(layer.crs())  # footprints in degrees may have come first, in which maps would look squeezed
    return node


def _id(node: Any) -> Any:
    return node.layerId() if hasattr(node, "layerId") else None
