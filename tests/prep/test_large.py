"""`prep` on images that are too large to be looked at as a whole: the same cameras, and never an image in memory."""

from pathlib import Path

import numpy as np
import pytest
import rasterio
from synthetic_views import LAT0, LON0, parallel_rpc, render, texture

from sattools.camera import RPC
from sattools.camera.ground import from_geographic
from sattools.camera.tracks import Tracks
from sattools.errors import InputError, SattoolsError
from sattools.prep import images as prep_images
from sattools.prep import large
from sattools.prep import pixels as prep_pixels
from sattools.prep.images import block_factor
from sattools.prep.loading import load_source
from sattools.prep.options import PrepOptions
from sattools.prep.pixels import read_gray, value_range, write_image
from sattools.prep.stage import prepare
from sattools.radiometry.options import NormaliseOptions
from sattools.radiometry.stage import normalise
from sattools.scene import Scene
from sattools.scene.pixels import image_part
from sattools.views import load_sources

RUNS = [(0.3, 0.05), (-0.2, 0.2), (0.0, -0.3)]
BIAS = [(0.0, 0.0), (6.0, -3.0), (-2.0, 5.0)]


@pytest.fixture(scope="module")
def pixels() -> list[np.ndarray]:
    """Three images of one ground."""
    ground = texture()
    return [render(ground, run).clip(1, 2047).astype(np.uint16) for run in RUNS]


@pytest.fixture
def folder(tmp_path: Path, pixels: list[np.ndarray]) -> Path:
    """The images, with cameras that are off by some pixels."""
    for k, (image, run, bias) in enumerate(zip(pixels, RUNS, BIAS, strict=True)):
        with rasterio.open(
            tmp_path / f"city_{k}.tif", "w", driver="GTiff", width=image.shape[1], height=image.shape[0], count=1,
            dtype="uint16",
        ) as out:  # fmt: skip
            out.write(image[None])
            out.update_tags(ns="RPC", **parallel_rpc(run, bias=bias).to_tags())
    return tmp_path


def paths(folder: Path) -> list[Path]:
    return sorted(folder.glob("city_*.tif"))


def make_small(monkeypatch: pytest.MonkeyPatch) -> None:
    """Images of 240 x 260 pixels count as large, squares are as much smaller."""
    monkeypatch.setattr(prep_images, "LARGE_PX", 20_000)
    monkeypatch.setattr(prep_images, "REDUCED_PX", 20_000)
    monkeypatch.setattr(large, "WINDOW_PX", 110)
    monkeypatch.setattr(large, "_LEAST_PX", 50)


def shifts(scene: Scene) -> np.ndarray:
    return np.array([item.properties["sattools:rpc_shift_px"] for item in scene.items])


def test_small_images_are_read_as_they_are() -> None:
    assert block_factor((3000, 3000), [(3000, 3000)] * 3) == 1
    # 144 million pixels in blocks of 6 x 6 are 4 million
    assert block_factor((12000, 12000), [(12000, 12000)] * 3) == 6
    # each is small, all together are not
    assert block_factor((3000, 3000), [(3000, 3000)] * 30) == 2


def test_a_reduced_image_has_the_means_of_its_blocks(folder: Path) -> None:
    path = paths(folder)[0]
    whole, reduced = (read_gray(load_source(path, "a", None), factor) for factor in (1, 3))
    assert reduced.shape == (whole.shape[0] // 3, whole.shape[1] // 3)
    np.testing.assert_allclose(reduced[5, 7], whole[15:18, 21:24].mean(), rtol=1e-6)


def test_the_range_of_values_is_that_of_all_pixels_however_they_are_read(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    source = load_source(paths(folder)[0], "a", None)
    with rasterio.open(source.path) as data:
        pixels = data.read()
    expected = (float(pixels.min()), float(pixels.max()))
    assert value_range(source) == expected
    monkeypatch.setattr(prep_pixels, "_STRIP_PX", 1000)
    assert value_range(source) == expected
    read_gray(source, 4)
    assert source.read_range == (source.window, expected)


def test_cameras_from_windows_agree_with_those_from_whole_images(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    plain, _ = prepare(paths(folder), PrepOptions(out=str(folder / "plain"), correction="shift"))
    make_small(monkeypatch)
    windows, note = prepare(paths(folder), PrepOptions(out=str(folder / "windows"), correction="shift"))
    # a common shift, and one that means another height, cannot be seen: what is left must agree
    difference = shifts(windows) - shifts(plain)
    runs = np.array(RUNS) * [1, -1]
    design = np.concatenate([np.tile(np.eye(2), (3, 1, 1)), runs[:, :, None]], axis=2).reshape(6, 3)
    rest = difference.ravel() - design @ np.linalg.lstsq(design, difference.ravel(), rcond=None)[0]
    assert np.abs(rest).max() < 0.3  # pixels; features are good to some tenths
    assert note["adjustment"]["median_after_px"] < 0.5
    # a common shift of the cameras moves the area by a fraction of a cell
    assert abs(windows.require_grid().width - plain.require_grid().width) <= 1


def test_squares_lie_apart_and_where_two_images_look(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    make_small(monkeypatch)
    monkeypatch.setattr(large, "WINDOW_PX", 40)
    sources = [load_source(path, path.stem, None) for path in paths(folder)]
    squares = large.ground_squares(sources, [s.rpc for s in sources], "EPSG:32633", 100.0)
    assert len(squares) == large.WINDOWS
    middles = np.array([[(w + e) / 2, (s + n) / 2] for w, s, e, n in squares])
    apart = np.hypot(*(middles[:, None] - middles[None]).transpose(2, 0, 1))
    assert apart[~np.eye(len(squares), dtype=bool)].min() > 10.0  # metres, of some 100 that the images show


def test_tracks_of_several_places_are_numbered_through() -> None:
    one = Tracks(np.array([0, 0, 1, 1]), np.array([0, 1, 0, 2]), np.zeros((4, 2)))
    both = large.joined([one, one])
    assert both.point.tolist() == [0, 0, 1, 1, 2, 2, 3, 3]
    assert both.n_points == 4
    assert large.joined([]).n_points == 0


def test_referred_images_are_the_same_scene_as_copied_ones(folder: Path) -> None:
    with rasterio.open(paths(folder)[0]) as data:
        before = data.read()
    options = {"crs": "EPSG:32633", "correction": "shift", "min_height": 80.0, "max_height": 130.0}
    x, y = from_geographic("EPSG:32633", LON0, LAT0)  # the middle of the images
    bounds = [x - 30, y - 30, x + 30, y + 30]
    copied, referred = (
        prepare(paths(folder), PrepOptions(out=str(folder / name), bounds=bounds, copy=copy, **options))[0]
        for name, copy in (("copied", True), ("referred", False))
    )
    assert not (referred.root / "images").exists()
    assert referred.items[0].assets["image"].href == str(paths(folder)[0])
    for one, other in zip(load_sources(copied, copied.items), load_sources(referred, referred.items), strict=True):
        np.testing.assert_array_equal(one.radiance, other.radiance)
        assert one.rpc.to_rpc_txt() == other.rpc.to_rpc_txt()
    for scene in (copied, referred):
        normalise(scene, NormaliseOptions())
    name = copied.items[0].id
    with (
        rasterio.open(copied.root / f"radiance/{name}.tif") as one,
        rasterio.open(referred.root / f"radiance/{name}.tif") as other,
    ):
        np.testing.assert_array_equal(one.read(), other.read())
        # the corrected camera of the window, not the original's
        a, b = (RPC.from_tags(data.tags(ns="RPC")) for data in (one, other))
        assert abs(a.col_offset - b.col_offset) < 1e-6
        assert abs(a.row_offset - b.row_offset) < 1e-6
    with rasterio.open(paths(folder)[0]) as data:
        np.testing.assert_array_equal(data.read(), before)


def test_an_original_that_has_become_smaller_is_noticed(folder: Path) -> None:
    scene, _ = prepare(paths(folder), PrepOptions(out=str(folder / "out"), copy=False))
    scene.items[0].assets["image"].extra["sattools:window"] = [0, 0, 9999, 10]
    with pytest.raises(InputError, match="expected those of columns 0 to 9999 and rows 0 to 10, of which item city_0"):
        image_part(scene, scene.items[0])


def test_a_copy_that_cannot_be_read_back_is_not_kept(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    source = load_source(paths(folder)[0], "a", None)
    target = folder / "copy.tif"
    sums = iter(range(1000))
    monkeypatch.setattr(prep_pixels.zlib, "crc32", lambda _: next(sums))
    with pytest.raises(SattoolsError, match=r"copy.tif: cannot be written \(found other pixels than were written\)"):
        write_image(source, source.rpc, target)
    assert not target.exists()
    assert [p.name for p in folder.iterdir() if "tmp" in p.name] == []
