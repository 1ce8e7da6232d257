"""What QGIS runs to be photographed (see pictures.py): Run all on a simulated town, its results and its form."""

import os
from glob import glob

import processing
from qgis import utils
from qgis.core import QgsApplication, QgsProject
from qgis.PyQt.QtCore import QTimer
from qgis.PyQt.QtWidgets import QApplication, QDockWidget, QToolBar

WIDTH, HEIGHT, WAIT_MS = 1280, 800, 4000
PICTURES, FOLDER = os.environ["PICTURES"], os.environ["FOLDER"]
window = utils.iface.mainWindow()


def arrange() -> None:
    """Nothing but the map, the layers and the toolbox."""
    window.resize(WIDTH, HEIGHT)
    for bar in window.findChildren(QToolBar):
        bar.setVisible(bar.objectName() in ("mFileToolBar", "mMapNavToolBar"))
    for dock in window.findChildren(QDockWidget):
        dock.setVisible(dock.objectName() in ("Layers", "ProcessingToolbox"))


def work() -> None:
    """Run all, as from the toolbox."""
    town = f"{FOLDER}/TOWN"
    given = {
        "IMAGES": sorted(glob(f"{town}/images/*.tif")), "METADATA": f"{town}/metadata", "ID": "FROM_QGIS",
        "OUT": f"{FOLDER}/work", "DSM": f"{town}/truth/TOWN_DSM.tif",
    }  # fmt: skip
    processing.runAndLoadResults("sattools:runall", given)
    arrange()
    group = QgsProject.instance().layerTreeRoot().findGroup("FROM_QGIS")
    for node in group.children():
        node.setItemVisibilityChecked(node.name() in ("dsm", "dsm hillshade", "footprints"))
    utils.iface.setActiveLayer(QgsProject.instance().mapLayersByName("dsm")[0])
    utils.iface.zoomToActiveLayer()
    for tree in window.findChildren(QDockWidget, "ProcessingToolbox"):
        tree.findChild(type(tree.algorithmTree)).setFilterString("sattools")
    QTimer.singleShot(WAIT_MS, results)


def results() -> None:
    """The window, then the form."""
    window.grab().save(f"{PICTURES}/qgis_results.png")
    algorithm = QgsApplication.processingRegistry().algorithmById("sattools:runall")
    dialog = processing.createAlgorithmDialog(algorithm.id(), {})
    dialog.resize(900, 760)
    dialog.show()

    def form() -> None:
        dialog.grab().save(f"{PICTURES}/qgis_run_all.png")
        QgsProject.instance().setDirty(False)
        QApplication.instance().exit(0)
        os._exit(0)  # QGIS would ask what to do with the project

    QTimer.singleShot(WAIT_MS, form)


QTimer.singleShot(WAIT_MS, work)
