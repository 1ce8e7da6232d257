"""Shadows that what stands around an area casts into it."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from sattools.errors import InputError
from sattools.render import around as around_module
from sattools.render.around import Around, read_around
from sattools.render.shadows import light_from
from sattools.scene import Grid, Scene
from sattools.scene.raster import write_cog

WHOLE = Grid("EPSG:32633", 500000.0, 5000000.0, 1.0, 90, 70)
INSIDE = slice(20, 50), slice(25, 65)
SUNS = [(0.6, 0.3, 0.742), (-0.9, 0.0, 0.436), (0.05, -0.98, 0.19), (0.0, 0.0, 1.0)]


def town() -> np.ndarray:
    rng = np.random.default_rng(3)
    height = rng.normal(0, 0.3, WHOLE.shape).astype(np.float32)
    for row, col in rng.integers(0, 60, (12, 2)):
        height[row : row + 6, col : col + 5] += 9.0
    return height


def ring(height: np.ndarray) -> np.ndarray:
    """Those around, and a rim of four cells of the area."""
    known = height.copy()
    known[24:46, 29:61] = np.nan
    return known


@pytest.mark.parametrize("sun", SUNS)
def test_shadows_are_those_of_the_whole(sun: Any) -> None:
    height = town()
    around = Around(((ring(height), WHOLE),), WHOLE.part(*INSIDE))
    lit = around.light_from(height[INSIDE], 1.0, sun)
    np.testing.assert_array_equal(lit, light_from(height, 1.0, sun)[INSIDE])
    assert sun[:2] == (0.0, 0.0) or (lit != light_from(height[INSIDE], 1.0, sun)).any()


def test_what_is_laid_on_other_cells_once_is_that_of_its_own_light_and_cells(monkeypatch: pytest.MonkeyPatch) -> None:
    """As it is in a fit, which asks for the same light again and again."""
    height, area = town(), WHOLE.part(*INSIDE)
    layers = ((ring(height), WHOLE), (ring(height)[::2, ::2], WHOLE.resized(2.0)))
    suns = [*SUNS, (0.9, 0.0, 0.436)]  # one opposite another: as many cells of other ground
    asked = [(height[INSIDE][::step, ::step], float(step), sun) for step in (1, 2) for sun in suns]
    alone = [Around(layers, area).light_from(*each) for each in asked]
    around, calls = Around(layers, area), []
    laid = around_module.reproject_map
    monkeypatch.setattr(around_module, "reproject_map", lambda *given: calls.append(given) or laid(*given))
    for first in (True, False):
        calls.clear()
        for each, light in zip(asked, alone, strict=True):
            np.testing.assert_array_equal(around.light_from(*each), light)
        assert bool(calls) == first  # all of the second round was there


def test_a_later_layer_counts_where_it_is_known() -> None:
    flat = np.zeros(WHOLE.shape, np.float32)
    wall = ring(flat)
    wall[:, 70] = 10.0  # 5 m east of the area
    area = WHOLE.part(*INSIDE)
    sun = (0.7071, 0.0, 0.7071)
    assert (Around(((wall, WHOLE), (ring(flat), WHOLE)), area).light_from(flat[INSIDE], 1.0, sun) == 1).all()
    shade = Around(((ring(flat), WHOLE), (wall, WHOLE)), area).light_from(flat[INSIDE], 1.0, sun) < 0.5
    # ten metres of shadow, of which five or six cells lie within the area
    assert set(shade.sum(axis=1)) <= {4, 5, 6}
    assert shade[:, -4:].all()


def test_unknown_heights_are_the_lowest_of_all_inside_and_outside() -> None:
    height = town()
    unknown = ring(height)
    unknown[:, :20] = np.nan
    lowest = float(np.nanmin([np.nanmin(unknown), np.nanmin(height[INSIDE])]))
    expected = np.where(np.isfinite(unknown), unknown, np.float32(lowest))
    expected[INSIDE] = height[INSIDE]
    own = height[INSIDE].copy()
    own[3, 5] = np.nan
    expected[23, 30] = lowest
    around = Around(((unknown, WHOLE),), WHOLE.part(*INSIDE))
    np.testing.assert_array_equal(around.light_from(own, 1.0, SUNS[1]), light_from(expected, 1.0, SUNS[1])[INSIDE])


def test_cells_of_another_size_see_the_same_ground_around() -> None:
    flat = np.zeros(WHOLE.shape, np.float32)
    wall = ring(flat)
    wall[:, 67:71] = 10.0  # begins 2 m east of the area
    area = WHOLE.part(*INSIDE)
    fine = np.zeros((60, 80), np.float32)
    shade = Around(((wall, WHOLE),), area).light_from(fine, 0.5, (0.7071, 0.0, 0.7071)) < 0.5
    assert shade.shape == fine.shape
    # 8 m of shadow within the area; the wall's foot is a ramp of a cell of 1 m
    assert 14 <= shade.sum(axis=1).mean() <= 17


def test_a_scene_without_surroundings_has_nothing_around(tmp_path: Path) -> None:
    assert read_around(Scene("A", tmp_path, grid=WHOLE)) is None


def test_of_a_large_area_only_what_is_known_and_near_is_kept(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """An area of 400 m in a ring of 20 m, in pieces of 40 m."""
    monkeypatch.setattr("sattools.scene.stored.AT_ONCE", 1000)
    monkeypatch.setattr("sattools.render.around._EDGE", 40)
    whole = Grid("EPSG:32633", 500000.0, 5000000.0, 1.0, 440, 440)
    height = np.random.default_rng(1).normal(0, 3, whole.shape).astype(np.float32)
    inside = slice(20, 420), slice(20, 420)
    known = height.copy()
    known[24:416, 24:416] = np.nan
    write_cog(tmp_path / "around.tif", known, whole)
    scene = Scene("A", tmp_path, grid=whole.part(*inside), products={"prior_surroundings": "around.tif"})
    around = read_around(scene)
    assert around is not None
    assert sum(values.size for values, _ in around.layers) < 0.5 * whole.height * whole.width
    lit = around.light_from(height[inside], 1.0, SUNS[0])
    np.testing.assert_array_equal(lit, light_from(height, 1.0, SUNS[0])[inside])
    scene.grid = whole.part(slice(20, 80), slice(200, 260))  # a tile at the northern border
    near = read_around(scene)
    assert near is not None
    assert max(grid.bounds[2] for _, grid in near.layers) < whole.left + 400
    scene.grid = whole.part(slice(200, 260), slice(200, 260))
    assert read_around(scene) is None


def test_a_file_of_surroundings_that_holds_nothing_is_told(tmp_path: Path) -> None:
    scene = Scene("A", tmp_path, grid=WHOLE)
    scene.products["prior_surroundings"] = "none.tif"
    write_cog(tmp_path / "none.tif", np.full((1, *WHOLE.shape), np.nan, np.float32), WHOLE)
    with pytest.raises(InputError, match=r"none.tif: found 1 band, or no data"):
        read_around(scene)
