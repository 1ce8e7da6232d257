"""The scene document, its ground grid and its files."""

from sattools.scene.document import COG_TYPE, GEOTIFF_TYPE, Asset, Item, Scene, check_id
from sattools.scene.grid import Grid

__all__ = ["COG_TYPE", "GEOTIFF_TYPE", "Asset", "Grid", "Item", "Scene", "check_id"]
