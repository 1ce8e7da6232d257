"""The plugin lies beside the package and is imported from there, as QGIS does."""

import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[2] / "qgis_plugin"))
