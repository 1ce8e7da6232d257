"""An image that says which part of a whole it is has a camera of its own, whatever format it is in."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import rasterio.shutil
from synthetic_views import cubic_rpc

from sattools.camera import RPC
from sattools.errors import InputError
from sattools.prep.cameras import own_camera
from sattools.prep.loading import load_source
from sattools.scene.chips import camera_of_chip
from sattools.scene.sensor_files import write_sensor_image

WHOLE = cubic_rpc()
ROWS, COLS = 12, 20


def ichipb(first: tuple[float, float], step: float = 1.0) -> str:
    """STDI-0002's extension: the chip's corner pixels and where their middles are in the whole (rows, columns)."""
    chip = [(row, col) for row in (0.5, ROWS - 0.5) for col in (0.5, COLS - 0.5)]
    whole = [(first[0] + step * row, first[1] + step * col) for row, col in chip]
    places = "".join(f"{number:012.3f}" for place in chip + whole for number in place)
    return f"00{step:010.5f}0000{places}0003500000041000"


def nitf(folder: Path, extension: str) -> Path:
    pixels = np.arange(ROWS * COLS, dtype=np.uint8).reshape(1, ROWS, COLS)
    write_sensor_image(folder / "whole.tif", pixels, WHOLE.to_tags())
    rasterio.shutil.copy(folder / "whole.tif", folder / "a.ntf", driver="NITF", TRE=f"ICHIPB={extension}")
    (folder / "a.ntf.aux.xml").unlink()  # has all digits of the RPC, the file itself has fewer
    return folder / "a.ntf"


def whole_of(path: Path) -> RPC:
    """As GDAL has it."""
    with rasterio.open(path) as data:
        return RPC.from_tags(data.tags(ns="RPC"))


def pixels(rpc: RPC) -> np.ndarray:
    lon, lat = WHOLE.lon_offset + 0.3 * WHOLE.lon_scale, WHOLE.lat_offset - 0.2 * WHOLE.lat_scale
    return np.array(rpc.projection([lon, WHOLE.lon_offset], [lat, WHOLE.lat_offset], [10.0, 40.0]))


def test_a_nitf_that_was_cut_out_of_a_whole_has_the_camera_of_its_window(tmp_path: Path) -> None:
    path = nitf(tmp_path, ichipb((1000.0, 2000.0)))
    wanted = pixels(whole_of(path)) - np.array([[2000.0], [1000.0]])
    np.testing.assert_allclose(pixels(RPC.from_file(path)), wanted, rtol=0, atol=1e-6)
    source = load_source(path, "a", None)
    np.testing.assert_allclose(pixels(source.rpc), wanted, rtol=0, atol=1e-6)
    own = own_camera(path)
    assert own is not None
    np.testing.assert_allclose(pixels(own), wanted, rtol=0, atol=1e-6)


def test_a_geotiff_made_of_such_a_nitf_has_it_too(tmp_path: Path) -> None:
    path = nitf(tmp_path, ichipb((1000.0, 2000.0)))
    rasterio.shutil.copy(path, tmp_path / "b.tif", driver="GTiff")
    wanted = pixels(whole_of(path)) - np.array([[2000.0], [1000.0]])
    np.testing.assert_allclose(pixels(RPC.from_file(tmp_path / "b.tif")), wanted, rtol=0, atol=1e-6)


def test_a_nitf_of_coarser_pixels_counts_those(tmp_path: Path) -> None:
    """The first coarse pixel is the mean of 2 x 2: its middle is between those of the whole's first two."""
    path = nitf(tmp_path, ichipb((100.0, 200.0), step=2.0))
    wanted = (pixels(whole_of(path)) - np.array([[200.5], [100.5]])) / 2.0
    np.testing.assert_allclose(pixels(RPC.from_file(path)), wanted, rtol=0, atol=1e-6)


def test_a_whole_image_that_says_so_keeps_every_digit(tmp_path: Path) -> None:
    path = nitf(tmp_path, ichipb((0.0, 0.0)))
    with rasterio.open(path) as data:
        assert RPC.from_file(path).to_tags() == RPC.from_tags(data.tags(ns="RPC")).to_tags()


def chip_tags(**other: Any) -> dict[str, str]:
    ends = {"11": (0.5, 0.5), "12": (0.5, 9.5), "21": (9.5, 0.5)}
    chip = {f"ICHIP_OP_{axis}_{k}": str(v[n]) for k, v in ends.items() for n, axis in enumerate(("ROW", "COL"))}
    whole = {f"ICHIP_FI_{axis}_{k}": str(v[n]) for k, v in ends.items() for n, axis in enumerate(("ROW", "COL"))}
    return chip | whole | other


def test_a_part_that_is_turned_against_its_whole_is_refused() -> None:
    turned = chip_tags(ICHIP_FI_ROW_12="9.5", ICHIP_FI_ROW_21="0.5", ICHIP_FI_COL_12="0.5", ICHIP_FI_COL_21="9.5")
    with pytest.raises(InputError, match=r"^a\.ntf: found an image that is turned against the whole .*, expected one"):
        camera_of_chip(WHOLE.to_tags(), turned, "a.ntf")


def test_an_extension_that_was_left_empty_says_nothing() -> None:
    empty = dict.fromkeys(chip_tags(), "0")
    assert camera_of_chip(WHOLE.to_tags(), empty, "a.ntf") == WHOLE.to_tags()
    assert camera_of_chip(WHOLE.to_tags(), chip_tags(ICHIP_OP_ROW_11="?"), "a.ntf") == WHOLE.to_tags()
