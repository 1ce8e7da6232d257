"""Pixels without data that no number declares: frames of one number, and masks."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import rasterio
from numpy.typing import NDArray
from spoilt import Town, made, prep

from sattools.prep.frames import find_frames
from sattools.prep.large import GrayImages
from sattools.scene import Scene
from sattools.views import load_sources


@pytest.fixture
def town(town_source: Any, tmp_path: Path) -> Any:
    return Town(tmp_path, town_source, 3)


def cut(value: int, dtype: Any = np.uint16, chimney: bool = True) -> Any:
    """The corner at the left top is one number, and so is a chimney somewhere."""

    def change(values: Any) -> Any:
        values = np.clip(values.astype(np.float64), 1, 60000).astype(dtype)
        values[:, corner_of(values[0])] = value
        if chimney:
            values[:, 50:53, 50:53] = value
        return values

    return change


def corner_of(values: Any) -> NDArray[np.bool_]:
    rows, cols = np.indices(values.shape)
    return np.asarray(rows + cols < 40)


def unknown(result: Any, number: int) -> NDArray[np.bool_]:
    """Pixels of an image without data, as later stages read them."""
    scene = Scene.from_json(result if isinstance(result, str) else result.stdout)
    source = load_sources(scene, [item for item in scene.items if item.id == f"TOWN_{number:03d}"])[0]
    return np.asarray(np.isnan(source.radiance).all(axis=0))


@pytest.mark.parametrize("value", [0, 1, 65535])
def test_a_cut_corner_of_one_number_is_no_data_and_a_chimney_of_that_number_is(town: Any, value: int) -> None:
    for number in range(1, 4):
        town.pixels(number, cut(value))
    result = prep(town)
    assert result.exit_code == 0, result.output
    percent = "% of the pixels, from a corner on, are " + str(value)
    assert (percent in result.stderr) == (value != 0)  # zeros are what every vendor writes: they are noted
    assert percent in "".join(Scene.from_json(result.stdout).history[-1]["notes"])
    for number in range(1, 4):
        with rasterio.open(town.folder / f"out/Q/images/TOWN_{number:03d}.tif") as data:
            masked, values = data.dataset_mask() == 0, data.read()
        np.testing.assert_array_equal(masked, corner_of(masked))
        assert (values[:, masked] == value).all()  # pixels stay as they were
        assert unknown(result, number).sum() > 0
        assert not unknown(result, number)[50:53, 50:53].any()


def test_a_picture_of_eight_bits_with_white_corners(town: Any) -> None:
    for number in range(1, 4):
        town.pixels(number, lambda values: cut(255, np.uint8)(np.minimum(values / 8, 254)))
    made(town, "are 255 in all bands and taken for no data", "gdal_edit.py -a_nodata 255")


def white(*roofs: tuple[slice, slice], number: int = 255) -> Any:
    """A picture of eight bits with roofs that are as bright as it gets."""

    def change(values: Any) -> Any:
        values = np.clip(values / 8, 1, 254).astype(np.uint8)
        for roof in roofs:
            values[:, roof[0], roof[1]] = number
        return values

    return change


CORNER, MIDDLE, FLANK = (slice(0, 30), slice(0, 40)), (slice(80, 95), slice(60, 80)), (slice(0, None), slice(0, 20))


@pytest.mark.parametrize(
    "roofs",
    [
        [(slice(0, 5), slice(0, 5))],  # too small
        [CORNER],  # what is left is no convex image
        [(slice(0, 24), slice(None, 40)), MIDDLE],
    ],
)
def test_bright_roofs_in_a_corner_are_no_frame(town: Any, roofs: Any) -> None:
    for number in range(1, 4):
        town.pixels(number, white(*roofs))
    result = prep(town)
    assert "from a corner on" not in result.stderr
    assert not unknown(result, 2).any()


def test_a_roof_with_a_straight_edge_is_no_frame_where_others_are_as_bright(town: Any) -> None:
    def diagonal(values: Any) -> Any:
        values = white(MIDDLE)(values)
        values[:, corner_of(values[0])] = 255
        return values

    for number in range(1, 4):
        town.pixels(number, diagonal)
    assert "from a corner on" not in prep(town).stderr


@pytest.mark.parametrize("number", [0, 255])
def test_the_edge_of_a_strip_is_a_frame_though_shadows_and_roofs_have_its_number(town: Any, number: int) -> None:
    for k in range(1, 4):
        town.pixels(k, white(FLANK, MIDDLE, number=number))
    result = prep(town)
    for k in range(1, 4):
        with rasterio.open(town.folder / f"out/Q/images/TOWN_{k:03d}.tif") as data:
            masked = data.dataset_mask() == 0
        assert masked[:, :20].all()
        assert not masked[:, 20:].any()
    assert result.exit_code == 0


def test_two_frames_of_different_numbers_are_both_no_data(town: Any) -> None:
    def change(values: Any) -> Any:
        values = cut(1, chimney=False)(values)
        values[:, corner_of(values[0])[::-1, ::-1]] = 65535
        return values

    for number in range(1, 4):
        town.pixels(number, change)
    prep(town)
    with rasterio.open(town.folder / "out/Q/images/TOWN_002.tif") as data:
        masked = data.dataset_mask() == 0
    np.testing.assert_array_equal(masked, corner_of(masked) | corner_of(masked)[::-1, ::-1])


def test_a_frame_that_a_mask_tells_is_nothing_to_tell(town: Any) -> None:
    for number in range(1, 4):
        town.pixels(number, cut(255))
        with rasterio.open(town.image(number), "r+") as data:
            data.write_mask(~corner_of(data.read(1)))
    assert prep(town).stderr == ""
    assert "frame" not in prep(town, "--no-copy", "--overwrite").stderr


def test_a_mask_is_honoured(town: Any) -> None:
    for number in range(1, 4):
        with rasterio.open(town.image(number), "r+") as data:
            data.write_mask(~corner_of(data.read(1)))
    result = prep(town)
    assert result.stderr == ""
    for number in range(1, 4):
        with rasterio.open(town.folder / f"out/Q/images/TOWN_{number:03d}.tif") as data:
            masked = data.dataset_mask() == 0
        np.testing.assert_array_equal(masked, corner_of(masked))
        assert unknown(result, number).sum() > 0


def test_a_frame_that_is_not_copied_is_told(town: Any) -> None:
    for number in range(1, 4):
        town.pixels(number, cut(1))
    result = prep(town, "--no-copy")
    assert "TOWN_001: is not copied, so its frame of 1 is ground later on: declare it as no data" in result.stderr


def test_a_window_knows_the_frame_that_reaches_its_corners(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    values = rng.integers(1, 1000, (2, 300, 400)).astype(np.uint16)
    values[:, :, 250:] = 7
    path = tmp_path / "a.tif"
    with rasterio.open(path, "w", driver="GTiff", count=2, height=300, width=400, dtype="uint16") as data:
        data.write(values)
    with rasterio.open(path) as data:
        assert find_frames(data, path, (0, 0, 240, 300)) == []
        (frame,) = find_frames(data, path, (200, 100, 150, 150))
        assert frame.value == 7
        assert frame.share == pytest.approx(100 / 150, abs=0.01)
        there = frame.blocks.within(rasterio.windows.Window(240, 120, 40, 20))
    assert there.shape == (20, 40)
    assert there[:, 10:].all()
    assert not there[:, :8].any()


def test_a_dark_corner_of_a_window_is_no_frame_where_the_image_goes_on(tmp_path: Path) -> None:
    values = np.random.default_rng(0).integers(1, 1000, (1, 300, 400)).astype(np.uint16)
    rows, cols = np.indices((300, 400))
    values[0, (rows < 200) & (cols < 200) & (rows + cols > 240)] = 0  # a lake within the image
    path = tmp_path / "a.tif"
    with rasterio.open(path, "w", driver="GTiff", count=1, height=300, width=400, dtype="uint16") as data:
        data.write(values)
    with rasterio.open(path) as data:
        assert find_frames(data, path, (20, 20, 180, 180)) == []


def test_a_frame_of_a_large_image_is_found_by_some_of_its_pixels(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("sattools.prep.frames.LOOKED_AT", 1000)
    values = np.random.default_rng(0).integers(1, 1000, (1, 300, 400)).astype(np.uint16)
    rows, cols = np.indices((300, 400))
    frame = rows > 150 + cols / 4
    values[0, frame] = 0
    path = tmp_path / "a.tif"
    with rasterio.open(path, "w", driver="GTiff", count=1, height=300, width=400, dtype="uint16") as data:
        data.write(values)
    with rasterio.open(path) as data:
        (found,) = find_frames(data, path, (0, 0, 400, 300))
    assert found.blocks.step > 1
    there = found.blocks.within(rasterio.windows.Window(0, 0, 400, 300))
    assert there[frame].all()  # of which the pixels of that number are taken
    assert there[~frame].mean() < 0.3


def test_a_wide_frame_does_not_widen_the_area(town: Any) -> None:
    whole = Scene.from_json(prep(town).stdout).require_grid()

    def framed(values: Any) -> Any:
        return np.pad(np.clip(values, 1, None), ((0, 0), (90, 60), (70, 110)))

    for number in range(1, 4):
        town.pixels(number, framed)
        town.camera(number, lambda rpc: rpc.cropped(-70, -90))
        town.metadata(number, height=None, width=None)
    result = prep(town, "--overwrite")
    assert result.exit_code == 0, result.output
    again = Scene.from_json(result.stdout).require_grid()
    assert again.cell_size == whole.cell_size
    # bounds are found to a 400th of what all images cover together, which has a rim of 2 %
    np.testing.assert_allclose(again.bounds, whole.bounds, atol=1.5)


@pytest.mark.parametrize("factor", [1, 4])
def test_the_outline_of_data_is_convex_and_in_pixels_of_the_image(factor: int) -> None:
    gray = np.full((40, 60), np.nan, np.float32)
    gray[10:30, 5:45] = 1
    gray[12:20, 10:20] = np.nan  # a hole is no border
    (edge,) = GrayImages([gray], [factor]).edges()
    assert edge is not None
    assert edge.min(axis=0).tolist() == [5 * factor - 0.5, 10 * factor - 0.5]
    assert edge.max(axis=0).tolist() == [45 * factor - 0.5, 30 * factor - 0.5]
    assert len(edge) == 5
    gray[:, :] = 1
    gray[0, 0] = np.nan
    assert GrayImages([gray], [factor]).edges() == [None]
    assert GrayImages([gray * np.nan], [factor]).edges() == [None]
