"""Images that do not fit into memory become what they would become as a whole."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import rasterio
from synthetic_views import parallel_rpc

from sattools.errors import SattoolsError
from sattools.radiometry.options import NormaliseOptions
from sattools.radiometry.stage import normalise
from sattools.scene import sensor_files, stored
from sattools.scene.raster import read_image
from sattools.scene.sensor_files import write_sensor_blocks


@pytest.mark.parametrize(
    "options", [NormaliseOptions(), NormaliseOptions(match=True, saturation=150.0, gamma=2.2, black=3.0)]
)
def test_blocks_of_an_image_are_those_of_the_whole(
    make_town: Any, monkeypatch: pytest.MonkeyPatch, options: NormaliseOptions
) -> None:
    whole, in_blocks = make_town("WHOLE"), make_town("BLOCKS")
    expected = normalise(whole, options)
    monkeypatch.setattr(sensor_files, "_VALUES", 1_000)
    monkeypatch.setattr(stored, "PIECE_CELLS", 700)
    found = normalise(in_blocks, options)
    assert found["images"] == expected["images"]
    assert found["notes"] == expected["notes"]
    for one, other in zip(whole.items, in_blocks.items, strict=True):
        arrays = [read_image(s.path(i.assets["radiance"].href)) for s, i in ((whole, one), (in_blocks, other))]
        np.testing.assert_array_equal(*arrays)


@pytest.mark.parametrize(
    ("source", "expected"),
    [
        ((1, 700), [(row, 0) for row in range(0, 600, 16)]),  # stored by rows: they are read once
        ((256, 256), [(0, 0), (0, 256), (0, 512), (256, 0), (256, 256), (256, 512), (512, 0), (512, 256), (512, 512)]),
        ((512, 256), [(0, 0), (0, 256), (0, 512), (256, 0), (256, 256), (256, 512), (512, 0), (512, 256), (512, 512)]),
    ],
)
def test_blocks_follow_the_source_are_asked_for_once_and_tags_stay(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, source: tuple[int, int], expected: list[tuple[int, int]]
) -> None:
    monkeypatch.setattr(sensor_files, "_VALUES", 2 * 256 * 256)
    if source[1] >= 700:
        monkeypatch.setattr(sensor_files, "_VALUES", 2 * 16 * 700)
    image = np.random.default_rng(0).normal(size=(2, 600, 700)).astype(np.float32)
    image[:, 10:20] = np.nan
    asked: list[tuple[int, int]] = []

    def block_of(rows: slice, cols: slice) -> np.ndarray:
        asked.append((rows.start, cols.start))
        return image[:, rows, cols]

    rpc = parallel_rpc((0.3, -0.2)).to_tags()
    about: dict[str, Any] = {"descriptions": ["red", "nir"], "source_block": source}
    write_sensor_blocks(tmp_path / "image.tif", (600, 700), 2, block_of, rpc, **about)
    assert asked == expected
    with rasterio.open(tmp_path / "image.tif") as data:
        np.testing.assert_array_equal(data.read(), image)
        assert data.descriptions == ("red", "nir")
        assert data.tags(ns="RPC").keys() >= rpc.keys()
        assert data.block_shapes[0] == (expected[1][0] or 256, 256)  # no tile is written in two pieces


def test_large_tiles_are_unpacked_once(tmp_path: Path) -> None:
    asked: list[tuple[int, int]] = []

    def block_of(rows: slice, cols: slice) -> np.ndarray:
        asked.append((rows.start, cols.start))
        return np.zeros((1, rows.stop - rows.start, cols.stop - cols.start), np.float32)

    write_sensor_blocks(tmp_path / "image.tif", (1200, 2100), 1, block_of, {}, source_block=(1024, 1024))
    assert asked == [(0, 0), (0, 1024), (0, 2048), (1024, 0), (1024, 1024), (1024, 2048)]


def test_a_file_that_holds_other_pixels_is_no_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    numbers = iter(range(10))
    monkeypatch.setattr(sensor_files.zlib, "crc32", lambda _: next(numbers))  # no two sums are alike
    with pytest.raises(SattoolsError, match="other pixels than were written"):
        write_sensor_blocks(tmp_path / "image.tif", (8, 8), 1, lambda *_: np.zeros((1, 8, 8), np.float32), {})
    assert list(tmp_path.iterdir()) == []
