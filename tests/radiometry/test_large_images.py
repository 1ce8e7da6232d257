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
from sattools.scene.sensor_files import write_sensor_rows


@pytest.mark.parametrize(
    "options", [NormaliseOptions(), NormaliseOptions(match=True, saturation=150.0, gamma=2.2, black=3.0)]
)
def test_strips_of_an_image_are_those_of_the_whole(
    make_town: Any, monkeypatch: pytest.MonkeyPatch, options: NormaliseOptions
) -> None:
    whole, in_strips = make_town("WHOLE"), make_town("STRIPS")
    expected = normalise(whole, options)
    monkeypatch.setattr(sensor_files, "_STRIP_VALUES", 1_000)
    monkeypatch.setattr(stored, "PIECE_CELLS", 700)
    found = normalise(in_strips, options)
    assert found["images"] == expected["images"]
    assert found["notes"] == expected["notes"]
    for one, other in zip(whole.items, in_strips.items, strict=True):
        arrays = [read_image(s.path(i.assets["radiance"].href)) for s, i in ((whole, one), (in_strips, other))]
        np.testing.assert_array_equal(*arrays)


def test_rows_are_asked_for_once_from_the_top_and_tags_stay(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sensor_files, "_STRIP_VALUES", 2_000)
    image = np.random.default_rng(0).normal(size=(2, 300, 50)).astype(np.float32)
    image[:, 10:20] = np.nan
    asked: list[int] = []

    def rows_of(rows: slice) -> np.ndarray:
        asked.append(rows.start)
        return image[:, rows]

    rpc = parallel_rpc((0.3, -0.2)).to_tags()
    write_sensor_rows(tmp_path / "image.tif", (300, 50), 2, rows_of, rpc, ["red", "nir"])
    assert asked == list(range(0, 300, 16))
    with rasterio.open(tmp_path / "image.tif") as data:
        np.testing.assert_array_equal(data.read(), image)
        assert data.descriptions == ("red", "nir")
        assert data.tags(ns="RPC").keys() >= rpc.keys()


def test_a_file_that_holds_other_pixels_is_no_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    numbers = iter(range(10))
    monkeypatch.setattr(sensor_files.zlib, "crc32", lambda _: next(numbers))  # no two sums are alike
    with pytest.raises(SattoolsError, match="other pixels than were written"):
        write_sensor_rows(tmp_path / "image.tif", (8, 8), 1, lambda rows: np.zeros((1, 8, 8), np.float32), {})
    assert list(tmp_path.iterdir()) == []
