"""What GDAL keeps beside a raster (`.aux.xml`) goes with the raster that it is of."""

from pathlib import Path

import numpy as np
import rasterio

from sattools.scene import Grid
from sattools.scene.files import all_or_nothing
from sattools.scene.raster import write_cog

GRID = Grid("EPSG:32617", 0.0, 0.0, 1.0, 8, 8)


# as `gdalinfo -stats` and QGIS leave it
KEPT = (
    '<PAMDataset><PAMRasterBand band="1"><Metadata><MDI key="STATISTICS_MINIMUM">-28</MDI></Metadata>'
    "</PAMRasterBand></PAMDataset>"
)


def lowest(path: Path) -> str | None:
    """What programs of GDAL's take for the lowest height without looking."""
    with rasterio.open(path) as file:
        return file.tags(1).get("STATISTICS_MINIMUM")


def test_a_raster_that_is_replaced_is_not_taken_for_the_one_before(tmp_path: Path) -> None:
    """QGIS coloured heights above the geoid between the lowest and the highest above the ellipsoid."""
    path = tmp_path / "dsm.tif"
    write_cog(path, np.full((1, 8, 8), -28.0, np.float32), GRID)
    Path(f"{path}.aux.xml").write_text(KEPT)
    assert lowest(path) == "-28"
    with all_or_nothing():
        write_cog(path, np.full((1, 8, 8), 3.0, np.float32), GRID)
        assert Path(f"{path}.aux.xml").is_file()  # as long as the old raster is there
    assert not Path(f"{path}.aux.xml").exists()
    assert lowest(path) is None


def test_statistics_of_other_rasters_and_links_stay(tmp_path: Path) -> None:
    elsewhere = tmp_path / "elsewhere.xml"
    elsewhere.write_text("of somebody")
    (tmp_path / "dsm.tif.aux.xml").symlink_to(elsewhere)
    (tmp_path / "other.tif.aux.xml").write_text("of another raster")
    write_cog(tmp_path / "dsm.tif", np.zeros((1, 8, 8), np.float32), GRID)
    assert (tmp_path / "dsm.tif.aux.xml").is_symlink()
    assert (tmp_path / "other.tif.aux.xml").read_text() == "of another raster"
