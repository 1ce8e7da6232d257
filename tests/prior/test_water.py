"""Water with waves, about which images do not agree, is laid level with its shore; other doubtful places stay."""

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
import pytest

from sattools.prior.water import TILE, level_water, water_levels
from sattools.scene.stored import StoredMap

CELL, SHAPE = 0.5, (240, 200)
WATER = slice(0, 90)  # columns, 45 m of 100 m


PAIRS = 45


@dataclass
class Harbour:
    """What matching has found, and how bright four images show the blocks ``[4, 30, 25]`` of it."""

    height: np.ndarray
    confidence: np.ndarray
    shown: np.ndarray
    water: np.ndarray = field(default_factory=lambda: np.zeros(SHAPE, np.uint8))

    def looks(self, rows: slice, cols: slice, level: float) -> np.ndarray:
        return self.shown[:, rows, cols]

    def levelled(self, pairs: int = PAIRS) -> float:
        """Share of the cells that are laid level."""
        self.water = level_water(self.height, self.confidence, CELL, self.looks, pairs)
        return float(self.water[:].mean())


@pytest.fixture
def harbour() -> Harbour:
    """Lumps of 6 m on water beside a quay at 2 m, with houses of 12 m on it; each image has the water in one tone."""
    rng = np.random.default_rng(0)
    height = np.full(SHAPE, 2.0, np.float32)
    height[40:80, 120:160] = height[140:200, 120:170] = 12.0
    confidence = np.full(SHAPE, 0.6, np.float32)
    lumps = rng.normal(0.0, 6.0, (SHAPE[0] // 4, 23)).repeat(4, axis=0).repeat(4, axis=1)
    height[:, WATER] = lumps[:, :90]
    confidence[:, WATER] = rng.uniform(0.0, 0.06, (SHAPE[0], 90))
    shown = rng.uniform(0.2, 1.0, (4, SHAPE[0] // 8, SHAPE[1] // 8))
    for image, tone in zip(shown, (0.1, 0.2, 0.5, 0.9), strict=True):
        image[:, :11] = tone * rng.normal(1.0, 0.05, (SHAPE[0] // 8, 11))
    return Harbour(height, confidence, shown)


@pytest.mark.parametrize("pairs", [45, 3])
def test_water_lies_level_with_its_quay_and_is_not_sure(harbour: Harbour, pairs: int) -> None:
    harbour.confidence[:, WATER] /= 2  # of three pairs
    before = harbour.height.copy()
    share = harbour.levelled(pairs)
    np.testing.assert_allclose(harbour.height[:, :80], 2.0, atol=1e-5)
    assert not harbour.confidence[:, :80].any()
    assert share == pytest.approx(90 / 200, abs=0.06)  # less a strip of up to 6 m along the quay
    np.testing.assert_array_equal(harbour.height[:, 96:], before[:, 96:])
    assert harbour.water.dtype == np.uint8
    assert (harbour.water[:, :80] == 1).all()
    assert not harbour.water[:, 96:].any()


def test_water_goes_on_to_the_very_edge_of_the_area(harbour: Harbour) -> None:
    """Rows and columns that make no whole block kept their lumps: a rim of up to 4 m along two edges."""
    lumps = np.random.default_rng(1).normal(0.0, 6.0, (SHAPE[0] + 7, SHAPE[1] + 7)).astype(np.float32)
    doubt = np.full(lumps.shape, 0.03, np.float32)
    lumps[: SHAPE[0], : SHAPE[1]], doubt[: SHAPE[0], : SHAPE[1]] = harbour.height[:, ::-1], harbour.confidence[:, ::-1]
    lumps[SHAPE[0] :, :110], doubt[SHAPE[0] :, :110] = 2.0, 0.6
    harbour = Harbour(lumps, doubt, harbour.shown[:, :, ::-1])
    harbour.levelled()
    np.testing.assert_allclose(harbour.height[:, 120:], 2.0, atol=1e-5)
    assert (harbour.water[:, 120:] == 1).all()
    assert not harbour.water[:, :100].any()


def test_a_pier_stays(harbour: Harbour) -> None:
    harbour.height[100:116, 30:90], harbour.confidence[100:116, 30:90] = 3.5, 0.6
    harbour.levelled()
    np.testing.assert_array_equal(harbour.height[100:116, 30:90], 3.5)
    assert not harbour.water[100:116, 30:90].any()
    assert (harbour.height[:80, :80] == 2.0).all()


def test_houses_at_the_water_keep_their_walls(harbour: Harbour) -> None:
    """Beside a height step no height is sure."""
    harbour.height[20:60, 91:130], harbour.confidence[20:60, 91:130] = 15.0, 0.6
    harbour.confidence[20:60, 91:93] = 0.05
    harbour.levelled()
    np.testing.assert_array_equal(harbour.height[20:60, 91:130], 15.0)


def test_a_shore_of_which_little_is_sure_is_looked_for_further_away(harbour: Harbour) -> None:
    harbour.confidence[:, 90:114] = 0.2  # 12 m of trees
    harbour.levelled()
    np.testing.assert_allclose(harbour.height[:, :80], 2.0, atol=1e-5)


def test_images_that_are_cut_or_masked_do_not_matter_while_most_show_it(harbour: Harbour) -> None:
    harbour.shown[3, :, :11] = np.nan  # glare, masked as a cloud
    harbour.levelled()
    np.testing.assert_allclose(harbour.height[:, :80], 2.0, atol=1e-5)


def test_of_few_images_half_have_to_show_it_of_many_more(harbour: Harbour) -> None:
    """Glare is masked like clouds; in the other two of four images water is as plain."""
    harbour.confidence[:, WATER] /= 2
    harbour.shown[:2, :, :11] = np.nan
    assert harbour.levelled(45) == 0.0
    assert harbour.levelled(6) == pytest.approx(90 / 200, abs=0.06)


def test_glint_may_make_water_brighter_over_kilometres() -> None:
    """Where it is four times as bright on one side as on the other, each tile is alike, the whole is not."""
    rows, cols = 8, 4 * TILE
    rng = np.random.default_rng(0)
    confidence, sure, found = np.zeros((rows + 8, cols)), np.zeros((rows + 8, cols)), np.zeros((rows + 8, cols))
    confidence[rows:], sure[rows:], found[rows:] = 0.6, 1.0, 2.0
    height = np.where(sure > 0, 2.0, rng.normal(0.0, 6.0, sure.shape))
    shown = np.broadcast_to(np.geomspace(0.2, 0.8, cols), (3, *sure.shape)).copy()
    shown[:, rows:] = rng.uniform(0.2, 1.0, (3, 8, cols))
    levels = water_levels(np.stack([confidence, height, height**2, sure, found]), 4.0, lambda r, c, _: shown[:, r, c])
    np.testing.assert_array_equal(levels[: rows - 1], 2.0)
    assert np.isnan(levels[rows + 1 :]).all()


def unsure_but_smooth(harbour: Harbour) -> None:
    harbour.height[:, WATER] = 30.0  # a roof without texture, whose height its rims tell


def hillside(harbour: Harbour) -> None:
    harbour.height[:, 90:] = np.linspace(0.0, 32.0, SHAPE[0])[:, None]  # of 15 degrees: its rim is no shore


def small(harbour: Harbour) -> None:
    harbour.confidence[:, WATER] = 0.6
    harbour.confidence[40:80, 20:60] = 0.02  # 20 m by 20 m: a courtyard


def doubtful(harbour: Harbour) -> None:
    harbour.confidence[:, WATER] = 0.2  # trees


def sea(harbour: Harbour) -> None:
    harbour.confidence[:] = 0.02  # no shore


def towers(harbour: Harbour) -> None:
    harbour.shown[:, :, :11] = harbour.shown[:, :, 12:23]  # roofs, walls and shade


def slope(harbour: Harbour) -> None:
    harbour.shown[:, :, :11] *= np.geomspace(1, 4, SHAPE[0] // 8)[:, None]  # a hill that bends away from the sun


def seen_by_one(harbour: Harbour) -> None:
    harbour.shown[:3, :, :11] = np.nan


@pytest.mark.parametrize("change", [unsure_but_smooth, hillside, small, doubtful, sea, towers, slope, seen_by_one])
@pytest.mark.parametrize("pairs", [45, 3])
def test_what_does_not_look_like_water_with_a_shore_stays(
    harbour: Harbour, change: Callable[[Harbour], None], pairs: int
) -> None:
    harbour.confidence[:, WATER] /= 2
    change(harbour)
    before = harbour.height.copy()
    assert harbour.levelled(pairs) == 0.0
    np.testing.assert_array_equal(harbour.height, before)


def test_few_images_have_to_be_less_sure(harbour: Harbour) -> None:
    """What three of them agree about by chance, or of towers, is as doubtful as water."""
    before = harbour.height.copy()
    harbour.confidence[:, WATER] *= 2  # 0.06 in the mean
    assert harbour.levelled(3) == 0.0
    np.testing.assert_array_equal(harbour.height, before)
    assert harbour.levelled(45) == pytest.approx(90 / 200, abs=0.06)


@pytest.mark.parametrize("shape", [(3, 3), (10, 200), (241, 203)])
def test_areas_of_any_size(shape: tuple[int, int]) -> None:
    def looks(rows: slice, cols: slice, _: float) -> np.ndarray:
        return np.ones((2, rows.stop - rows.start, cols.stop - cols.start))

    water = level_water(np.zeros(shape, np.float32), np.zeros(shape, np.float32), CELL, looks, 45)
    assert water.shape == shape
    assert not water.any()


def test_maps_in_files_come_out_the_same(harbour: Harbour, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Band by band, so that areas larger than memory can be laid level, too."""
    stored = []
    for values in (harbour.height, harbour.confidence):
        stored.append(StoredMap(SHAPE, np.float32, tmp_path))
        stored[-1][:] = values
    in_files = replace(harbour, height=stored[0], confidence=stored[1])
    harbour.levelled()
    monkeypatch.setattr("sattools.scene.stored.PIECE_CELLS", SHAPE[1] * 24)
    in_files.levelled()
    maps = harbour.height, harbour.confidence, harbour.water
    for found, expected in zip([*stored, in_files.water], maps, strict=True):
        np.testing.assert_array_equal(found[:], expected)
