"""Clouds hide the ground in single images: they are found, told and masked, and bright ground is not."""

import tracemalloc
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import rasterio
from hypothesis import given, settings
from hypothesis import strategies as st
from spoilt import Town, prep
from synthetic_views import ALT0, LAT0, LON0, parallel_rpc, render, texture

from sattools.camera.ground import from_geographic
from sattools.camera.tracks import Tracks
from sattools.errors import InputError, SceneError
from sattools.prep.clouds import Clouds, common_brightness, find_clouds
from sattools.prep.large import GrayImages
from sattools.prep.options import PrepOptions
from sattools.prep.stage import prepare
from sattools.prep.sweeps import mask_clouds
from sattools.scene import Scene
from sattools.scene.blocks import Blocks
from sattools.scene.pixels import image_part
from sattools.scene.raster import read_image

RUNS = [(0.3, 0.05), (-0.2, 0.2), (0.0, -0.3), (0.15, 0.3), (-0.3, -0.1)]
CAMERAS = [parallel_rpc(run) for run in RUNS]
UTM = "EPSG:32633"
X, Y = from_geographic(UTM, LON0, LAT0)
BOUNDS = (X - 50, Y - 50, X + 50, Y + 50)
HEIGHTS = (ALT0 - 12.0, ALT0 + 60.0)
WHITE = 400.0  # ground: 100 +- 24


@pytest.fixture(scope="module")
def plain() -> list[Any]:
    return [render(texture(), run) for run in RUNS]


@pytest.fixture(scope="module")
def points() -> Tracks:
    """Points of a grid on the hills, which all images show."""
    east, north = (g.ravel() for g in np.meshgrid(np.arange(-40, 41, 8.0), np.arange(-40, 41, 8.0)))
    height = 8.0 * np.sin(east / 17.0) * np.cos(north / 23.0)
    pixel = [[129.5 + (east - t[0] * height) / 0.5, 119.5 - (north - t[1] * height) / 0.5] for t in RUNS]
    point = np.repeat(np.arange(east.size), len(RUNS))
    return Tracks(point, np.tile(np.arange(len(RUNS)), east.size), np.array(pixel).transpose(2, 0, 1).reshape(-1, 2))


def covered(image: Any, radius_m: float, at: tuple[float, float] = (110.0, 120.0), white: float = WHITE) -> Any:
    """The image with a white disc around (row, column)."""
    rows, cols = np.indices(image.shape)
    inside = np.hypot(rows - at[0], cols - at[1]) * 0.5 < radius_m
    return np.where(inside, np.float32(white), image), inside


def found(images: Any, points: Tracks) -> list[Clouds | None]:
    return find_clouds(images, CAMERAS, points, UTM, BOUNDS, HEIGHTS)


def pixels(clouds: Clouds, shape: tuple[int, int]) -> Any:
    window = rasterio.windows.Window(0, 0, shape[1], shape[0])
    return Blocks(clouds.places, clouds.step, (0, 0)).within(window)


def test_images_without_clouds_have_none(plain: Any, points: Tracks) -> None:
    assert found(plain, points) == [None] * 5


@pytest.mark.parametrize("cloudy", [[1], [0, 3]])
def test_a_cloud_is_found_in_the_images_that_show_it(plain: Any, points: Tracks, cloudy: list[int]) -> None:
    images = list(plain)
    for view in cloudy:
        images[view], inside = covered(images[view], 28.0)
    clouds = found(images, points)
    assert [view for view, cloud in enumerate(clouds) if cloud is not None] == cloudy
    for view in cloudy:
        cloud = clouds[view]
        assert cloud is not None
        mask = pixels(cloud, inside.shape)
        assert mask[inside].mean() > 0.97
        _, wide = covered(plain[0], 28.0 + 15.0)  # a margin of 6 m, half a patch, blocks of 2 m and what is blurred
        assert not mask[~wide].any()
        assert cloud.share == pytest.approx(np.pi * 37.0**2 / 1e4, abs=0.1)


def test_many_images_are_held_once_more_while_clouds_are_looked_for(plain: Any, points: Tracks) -> None:
    cloudy, _ = covered(plain[1], 28.0)
    images = [plain[0], cloudy, *plain[2:]] * 6
    view = np.concatenate([points.view + 5 * k for k in range(6)])
    same = Tracks(np.tile(points.point, 6), view, np.tile(points.pixel, (6, 1)))
    tracemalloc.start()
    clouds = find_clouds(images, CAMERAS * 6, same, UTM, BOUNDS, HEIGHTS)
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert [cloud is not None for cloud in clouds] == [False, True, False, False, False] * 6
    assert peak < 1.7 * sum(image.nbytes for image in images)


def test_the_brightness_of_images_may_differ_as_that_of_dates_does(plain: Any, points: Tracks) -> None:
    dates = zip((1, 0.5, 3, 1.4, 0.8), (0, 90, 10, 0, 40), plain, strict=True)
    images = [gain * image + haze for gain, haze, image in dates]
    assert found(images, points) == [None] * 5
    images[2], _ = covered(images[2], 28.0, white=3 * WHITE)
    clouds = found(images, points)
    assert [cloud is not None for cloud in clouds] == [False, False, True, False, False]


def test_clouds_on_most_tie_points_of_an_image_are_found(plain: Any, points: Tracks) -> None:
    """Which say that white is what others show as ground."""
    images = list(plain)
    images[4], inside = covered(images[4], 34.0)  # 45 of 121 points
    cloud = found(images, points)[4]
    assert cloud is not None
    assert pixels(cloud, inside.shape)[inside].mean() > 0.97


def test_a_cloud_that_leaves_too_few_tie_points_beside_it_stays_found(
    plain: Any, points: Tracks, monkeypatch: pytest.MonkeyPatch
) -> None:
    images = list(plain)
    images[4], inside = covered(images[4], 34.0)
    monkeypatch.setattr("sattools.prep.clouds.OBSERVATIONS", 100)  # of 121, of which the cloud hides 45
    cloud = find_clouds(images, CAMERAS, points, UTM, BOUNDS, HEIGHTS)[4]
    assert cloud is not None
    assert pixels(cloud, inside.shape)[inside].mean() > 0.9


def test_a_white_roof_is_no_cloud_however_high_it_stands(points: Tracks) -> None:
    """Slanting images show it apart by up to 30 m, each over ground that the others see."""
    ground = texture()
    roof = np.zeros_like(ground)
    roof[350:550, 350:550] = 1.0  # 50 x 50 m
    images = []
    for run in RUNS:
        on_top = render(roof, run, height=lambda east, north: 0 * east + 50.0) > 110.0
        images.append(np.where(on_top, np.float32(WHITE), render(ground, run)))
    assert found(images, points) == [None] * 5


def test_what_shines_in_one_image_and_is_small_is_no_cloud(plain: Any, points: Tracks) -> None:
    images = list(plain)
    images[1], _ = covered(images[1], 12.0)  # 450 m2: a roof in the sun's mirror image
    assert found(images, points) == [None] * 5


@pytest.mark.parametrize(("radius_m", "is_cloud"), [(17.0, False), (32.0, True)])
def test_what_is_large_is_so_in_metres_whatever_the_pixels(points: Tracks, radius_m: float, is_cloud: bool) -> None:
    """910 and 3220 m2 in pixels of 1.05 m, of which not quite two are as wide as a cell of the look."""
    size, gsd = (115, 125), 1.05
    cameras = [parallel_rpc(run, gsd, size) for run in RUNS]
    images = [render(texture(), run, gsd, size) for run in RUNS]
    rows, cols = np.indices(size)
    images[1] = np.where(np.hypot(rows - 57, cols - 62) * gsd < radius_m, np.float32(WHITE), images[1])
    pixel = (points.pixel - [129.5, 119.5]) * 0.5 / gsd + [62.0, 57.0]
    here = Tracks(points.point, points.view, pixel)
    clouds = find_clouds(images, cameras, here, UTM, BOUNDS, HEIGHTS)
    assert [cloud is not None for cloud in clouds] == [False, is_cloud, False, False, False]


def test_haze_that_leaves_the_ground_to_be_seen_is_no_cloud(plain: Any, points: Tracks) -> None:
    images = list(plain)
    _, inside = covered(images[1], 28.0)
    images[1] = np.where(inside, images[1] + np.float32(10.0), images[1])
    assert found(images, points) == [None] * 5


def test_without_tie_points_nothing_is_known(plain: Any) -> None:
    images = list(plain)
    images[1], _ = covered(images[1], 28.0)
    none = Tracks(np.empty(0, np.intp), np.empty(0, np.intp), np.empty((0, 2)))
    assert found(images, none) == [None] * 5


def test_two_images_are_left_wherever_clouds_are_masked(plain: Any, points: Tracks) -> None:
    """Of three, two of which are white, the two may be right, as where trees have leaves on two dates."""
    images = [image if view < 3 else np.full_like(image, np.nan) for view, image in enumerate(plain)]
    images[1], _ = covered(plain[1], 28.0)
    assert [cloud is not None for cloud in found(images, points)] == [False, True, False, False, False]
    images[2], _ = covered(plain[2], 28.0)
    assert found(images, points) == [None] * 5


def test_of_two_images_the_one_that_shows_white_at_whatever_height_is_clouded(plain: Any, points: Tracks) -> None:
    """Nothing but a cloud is likely to be so large; what is not cannot be matched either."""
    images = [image if view < 2 else np.full_like(image, np.nan) for view, image in enumerate(plain)]
    assert found(images, points) == [None] * 5
    images[1], inside = covered(plain[1], 28.0)
    clouds = found(images, points)
    assert [cloud is not None for cloud in clouds] == [False, True, False, False, False]
    assert clouds[1] is not None
    assert pixels(clouds[1], inside.shape)[inside].mean() > 0.97


@given(
    gains=st.lists(st.floats(0.3, 3.0), min_size=4, max_size=4),
    levels=st.lists(st.floats(-200.0, 200.0), min_size=4, max_size=4),
    seed=st.integers(0, 10_000),
)
@settings(max_examples=25, deadline=None)
def test_gains_and_offsets_bring_images_to_one_brightness(gains: Any, levels: Any, seed: int) -> None:
    """With a fifth of the points of one image on a cloud."""
    rng = np.random.default_rng(seed)
    ground = rng.normal(0.0, 1.0, 200)
    tracks = Tracks(np.repeat(np.arange(200), 4), np.tile(np.arange(4), 200), np.zeros((800, 2)))
    values = (ground[:, None] + rng.normal(0, 0.05, (200, 4))) * gains + levels
    values[:40, 2] = 6.0 * gains[2] + levels[2]
    gain, offset = common_brightness(tracks, values.ravel(), 4)
    same = values * gain + offset
    clear = slice(40, None)
    # noise of 0.05 at both ends of a line, and its own error
    assert np.abs(same[clear] - np.median(same[clear], axis=1)[:, None]).max() < 0.4
    assert np.median(same[:40, 2]) > same[clear].max() + 1.0


def test_clouds_of_images_that_are_seen_reduced_lie_in_the_pixels_of_the_file(plain: Any, points: Tracks) -> None:
    """As whole satellite scenes are, of which a window is looked at."""
    images = list(plain)
    images[1], inside = covered(images[1], 28.0)
    whole = GrayImages([image.reshape(120, 2, 130, 2).mean(axis=(1, 3)) for image in images], [2] * 5)
    seen: Any = SimpleNamespace(rpcs=CAMERAS, tracks=points)
    said: list[str] = []
    one = {"window": (1000, 500, 260, 240), "clouds": None, "warn": said.append}
    sources: Any = [SimpleNamespace(id=str(number), **one) for number in range(5)]
    assert mask_clouds(sources, seen, whole, UTM, None, HEIGHTS) == []
    assert [source.clouds is not None for source in sources] == [False, True, False, False, False]
    mask = sources[1].clouds.within(rasterio.windows.Window(1000, 500, 260, 240))
    assert mask[inside].mean() > 0.97
    assert not mask[~covered(plain[1], 28.0 + 14.0)[1]].any()
    assert len(said) == 1


@pytest.fixture
def town(town_source: Any, tmp_path: Path) -> Any:
    return Town(tmp_path, town_source, 5)


@pytest.fixture(scope="module")
def cloudy(town_source: Any, tmp_path_factory: pytest.TempPathFactory) -> Any:
    """A town with a cloud in its third image, which has `before`: what `prep` makes with copies, and without them."""
    town = Town(tmp_path_factory.mktemp("cloudy"), town_source, 5)
    town.pixels(3, cloud_over(30.0))
    before = town.image(3).read_bytes()
    copied, referred = prep(town), prep(town, "--no-copy", "--out", town.folder / "referred")
    return SimpleNamespace(town=town, before=before, copied=copied, referred=referred)


def cloud_over(radius_m: float) -> Any:
    def change(values: Any) -> Any:
        rows, cols = np.indices(values.shape[1:])
        middle = np.array(values.shape[1:]) / 2
        inside = np.hypot(rows - middle[0], cols - middle[1]) * 0.5 < radius_m
        return np.where(inside, np.array(2000, values.dtype), values)

    return change


def masked(town: Any, number: int) -> float:
    with rasterio.open(town.folder / f"out/Q/images/TOWN_{number:03d}.tif") as data:
        return float((data.dataset_mask() == 0).mean())


def test_prep_masks_a_cloud_in_its_copy_and_says_so(cloudy: Any) -> None:
    town, result = cloudy.town, cloudy.copied
    with rasterio.MemoryFile(cloudy.before) as file, file.open() as data:
        before = data.read()
    assert result.exit_code == 0, result.output
    said = [line for line in result.stderr.splitlines() if "clouds or glare hide" in line]
    assert len(said) == 1
    assert "TOWN_003: " in said[0]
    assert "--clouds keep" in said[0]
    scene = Scene.from_json(result.stdout)
    assert any("TOWN_003: clouds or glare" in note for note in scene.history[-1]["notes"])
    assert [item.role for item in scene.items] == ["train"] * 5
    with rasterio.open(town.folder / "out/Q/images/TOWN_003.tif") as data:
        np.testing.assert_array_equal(data.read(), before)  # a mask hides numbers, and loses none
        hidden = data.dataset_mask() == 0
    white = (before == 2000).all(axis=0)
    assert hidden[white].mean() > 0.95
    assert 0.2 < hidden.mean() < 0.7
    assert [masked(town, number) for number in (1, 2, 4, 5)] == [0.0] * 4


def test_clouds_stay_where_the_user_wants_them(town: Any) -> None:
    town.pixels(3, cloud_over(30.0))
    result = prep(town, "--clouds", "keep")
    assert result.exit_code == 0, result.output
    assert "cloud" not in result.stderr
    assert masked(town, 3) == 0.0


def test_clouds_of_images_that_are_not_copied_are_masked_too(cloudy: Any) -> None:
    """The originals stay as they are; whatever reads them for the scene reads the mask as well."""
    town, copied, referred = cloudy.town, cloudy.copied, cloudy.referred
    assert referred.exit_code == 0, referred.output
    assert town.image(3).read_bytes() == cloudy.before
    items = [Scene.from_json(result.stdout).items[2] for result in (copied, referred)]
    assert "clouds" not in items[0].assets
    mask = items[1].assets["clouds"]
    assert mask.href == "clouds/TOWN_003.tif"
    scene = Scene.from_json(referred.stdout)
    for window, reduce in ((None, 1), ((slice(10, 90), slice(20, 81)), 1), ((slice(11, 100), slice(8, 90)), 3)):
        own = image_part(scene, items[1]).read(window, reduce)
        there = np.isnan(own).all(axis=0)
        assert 0.2 < there.mean() < 0.98
        plain = read_image(town.image(3), window and _moved(window, items[1]), reduce)
        np.testing.assert_array_equal(own[:, ~there], plain[:, ~there])
    with rasterio.open(town.folder / "out/Q/images/TOWN_003.tif") as data:  # the copy
        hidden = data.dataset_mask() == 0
    whole = np.isnan(image_part(scene, items[1]).read()).all(axis=0)
    np.testing.assert_array_equal(whole, hidden)


def _moved(window: Any, item: Any) -> Any:
    """A window of an item's image in its file."""
    col, row = item.assets["image"].extra["sattools:window"][:2]
    rows, cols = window
    return slice(rows.start + row, rows.stop + row), slice(cols.start + col, cols.stop + col)


@pytest.mark.parametrize(("blocks", "words"), [(None, "found no 'sattools:blocks'"), ([0, 0, 0], "blocks of 0 pixels")])
def test_a_mask_whose_place_is_not_told_is_refused(cloudy: Any, blocks: Any, words: str) -> None:
    scene = Scene.from_json(cloudy.referred.stdout)
    extra = scene.items[2].assets["clouds"].extra
    del extra["sattools:blocks"]
    if blocks is not None:
        extra["sattools:blocks"] = blocks
    with pytest.raises(SceneError, match=words):
        image_part(scene, scene.items[2])


def written(folder: Path, images: Any) -> list[Path]:
    paths = []
    for number, (image, camera) in enumerate(zip(images, CAMERAS, strict=False)):
        path = folder / f"field_{number}.tif"
        height, width = image.shape
        with rasterio.open(path, "w", driver="GTiff", width=width, height=height, count=1, dtype="uint16") as out:
            out.write(image.clip(1, 2047).astype(np.uint16), 1)
            out.update_tags(ns="RPC", **camera.to_tags())
        paths.append(path)
    return paths


def middle(folder: Path) -> PrepOptions:
    """40 m around the middle of the images."""
    return PrepOptions(out=str(folder / "out"), crs=UTM, bounds=[X - 20, Y - 20, X + 20, Y + 20])


@pytest.mark.filterwarnings("ignore:Dataset has no geotransform")
def test_an_image_that_shows_clouds_alone_is_set_aside(plain: Any, tmp_path: Path) -> None:
    images = list(plain)
    images[2], _ = covered(images[2], 52.0)
    scene, extra = prepare(written(tmp_path, images), middle(tmp_path))
    assert [item.role for item in scene.items] == ["train", "train", "unused", "train", "train"]
    assert "field_2: clouds hide the area, set aside (role unused)" in extra["notes"]


@pytest.mark.filterwarnings("ignore:Dataset has no geotransform")
def test_where_clouds_leave_one_image_for_training_that_is_said_before_anything_is_written(
    plain: Any, tmp_path: Path
) -> None:
    images = list(plain[:3])
    images[1], _ = covered(images[1], 52.0)
    held = replace(middle(tmp_path), holdout=["field_2"])
    with pytest.raises(InputError, match=r"found 1 for training that are not covered by clouds \(`--clouds keep`"):
        prepare(written(tmp_path, images), held)
    assert not [path for path in (tmp_path / "out").rglob("*") if path.is_file()]
