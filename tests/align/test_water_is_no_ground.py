"""Water whose level is assumed does not say how high a surface lies."""

from pathlib import Path

import pytest
from test_parts_of_surfaces import GRID, reference_in, surface_in

from sattools.align.options import AlignOptions
from sattools.align.surface import SurfaceFiles, shift_to_raster
from sattools.errors import InputError
from sattools.scene.raster import read_raster, write_cog


def flooded(files: SurfaceFiles, columns: slice) -> SurfaceFiles:
    """With water laid 6 m too high there."""
    assert files.validity is not None
    heights, validity = read_raster(files.dsm)[0], read_raster(files.validity)[0]
    heights[..., columns], validity[..., columns] = 3.0, 4
    write_cog(files.dsm, heights, GRID)
    write_cog(files.validity, validity, GRID, nodata=None)
    return files


@pytest.mark.parametrize("method", ["auto", "z"])
def test_land_alone_decides(tmp_path: Path, method: str) -> None:
    files = flooded(surface_in(tmp_path), slice(0, 300))
    shift, _ = shift_to_raster(files, reference_in(tmp_path, 1.0), AlignOptions(method=method))
    assert shift.up == pytest.approx(3.0, abs=0.1 if method == "auto" else 0.5)


@pytest.mark.parametrize("method", ["auto", "z"])
def test_a_surface_of_nothing_but_water_is_told(tmp_path: Path, method: str) -> None:
    files = flooded(surface_in(tmp_path), slice(0, None))
    with pytest.raises(InputError, match=r"^found nothing measured in .*dsm\.tif, expected heights to register by"):
        shift_to_raster(files, reference_in(tmp_path, 1.0), AlignOptions(method=method))


def test_a_strip_of_land_that_does_not_suffice_is_told(tmp_path: Path) -> None:
    files = flooded(surface_in(tmp_path), slice(2, None))
    with pytest.raises(InputError, match=r"\(0\.\d % of the surface is measured: filled ground and water that was"):
        shift_to_raster(files, reference_in(tmp_path, 1.0), AlignOptions())
