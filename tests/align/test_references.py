"""What `align` is given to move a scene onto: rasters of heights as others deliver them, and nothing else."""

from pathlib import Path

import numpy as np
import pytest
from align_ground import CRS, GRID

from sattools.align.reference import check_reference
from sattools.errors import InputError
from sattools.scene.raster import write_cog


def test_a_class_map_is_no_reference(tmp_path: Path) -> None:
    """As `compare --dsm` says it: a surface was moved onto the codes of ground, trees and buildings."""
    codes = np.full(GRID.shape, 2, np.uint8)
    codes[:100, :100], codes[200:, :100] = 5, 6
    write_cog(tmp_path / "classes.tif", codes, GRID, nodata=None)
    with pytest.raises(InputError, match=r"classes.tif: found class codes \(2, 5, 6\), expected heights \[m\]"):
        check_reference(tmp_path / "classes.tif", CRS)
