"""Albedo and light of a surface whose heights stand: solved for on its own cells."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from sattools.export.options import ExportOptions
from sattools.export.stage import export
from sattools.fit.options import FitOptions
from sattools.fit.stage import fit
from sattools.fit.surface.recolour import Colours, Seen, Usual, sample, solve_albedo, solve_colours, usual
from sattools.scene import Scene
from sattools.scene.raster import read_raster

GAIN = np.array([[1.0, 1.0], [1.4, 1.3], [0.6, 0.7], [1.1, 0.9]])
OFFSET = np.array([[0.0, 0.0], [0.05, 0.08], [-0.02, 0.0], [0.1, 0.12]])
AMBIENT = np.array([[0.2, 0.3], [0.25, 0.35], [0.2, 0.3], [0.15, 0.3]])
TRUE = Colours(GAIN, OFFSET, AMBIENT)
UNKNOWN = Colours(np.ones((4, 2)), np.zeros((4, 2)), np.full((4, 2), 0.4))


@pytest.fixture
def albedo() -> np.ndarray:
    return np.random.default_rng(0).uniform(0.05, 0.6, (4000, 2)).astype(np.float32)


@pytest.fixture
def seen(albedo: np.ndarray) -> Seen:
    """Four images of 4000 cells, each a third in shade and a fifth hidden, in two bands."""
    return shown(albedo, TRUE)


def shown(albedo: np.ndarray, colours: Colours) -> Seen:
    rng = np.random.default_rng(1)
    lit = (rng.uniform(size=(4, len(albedo))) > 1 / 3).astype(np.float32)
    weight = (rng.uniform(size=lit.shape) > 0.2).astype(np.float32)
    light = np.stack([colours.light(lit, band) for band in range(2)], axis=-1)
    return Seen((light * albedo + colours.offset[:, None]).astype(np.float32), weight, lit)


def solved(
    seen: Seen, start: Colours = UNKNOWN, albedo: np.ndarray | None = None, *, scale_held: bool = False
) -> tuple[Colours, np.ndarray]:
    some = sample(seen, np.full((seen.weight.shape[1], 2), 0.3, np.float32) if albedo is None else albedo, 0)
    colours = solve_colours(some, start, scale_held=scale_held)
    return colours, solve_albedo(seen, colours, usual(some[0], colours))


def test_colours_and_albedo_are_found_from_a_start_that_knows_neither(seen: Seen, albedo: np.ndarray) -> None:
    colours, found = solved(seen)
    shows = seen.weight.any(axis=0)
    # twelve rounds of two least squares that take turns come near, but not to the last digit
    np.testing.assert_allclose(found[shows], albedo[shows], atol=0.02)
    np.testing.assert_allclose(colours.gain, GAIN, atol=0.05)
    np.testing.assert_allclose(colours.offset, OFFSET, atol=0.02)
    np.testing.assert_allclose(colours.ambient, AMBIENT, atol=0.05)


def test_from_the_truth_nothing_moves(seen: Seen, albedo: np.ndarray) -> None:
    colours, found = solved(seen, TRUE, albedo)
    shows = seen.weight.any(axis=0)
    np.testing.assert_allclose(colours.ambient, AMBIENT, atol=1e-4)  # numbers of single precision
    np.testing.assert_allclose(found[shows], albedo[shows], atol=1e-4)


def test_light_in_the_shade_of_few_cells_is_nearer_that_of_the_other_images(seen: Seen, albedo: np.ndarray) -> None:
    # image 2 shows five cells in shade, which look fully lit: a height there is wrong
    lit = seen.lit.copy()
    lit[2] = 1.0
    bright = shown(albedo, TRUE)
    radiance = np.stack([TRUE.light(lit, band) for band in range(2)], axis=-1) * albedo + OFFSET[:, None]
    noise = np.random.default_rng(2).normal(0.0, 0.02, radiance.shape)
    lit[2, :5] = 0.0
    colours, _ = solved(Seen((radiance + noise).astype(np.float32), bright.weight, lit), TRUE)
    np.testing.assert_allclose(colours.ambient[2], [0.2, 0.3], atol=0.35)  # alone: 1


def test_shade_that_shows_noise_alone_has_an_albedo_near_the_middle_one() -> None:
    shade = Seen(np.full((4, 1, 2), 0.2, np.float32), np.ones((4, 1), np.float32), np.zeros((4, 1), np.float32))
    dark = Colours(np.ones((4, 2)), np.zeros((4, 2)), np.full((4, 2), 0.02))
    # light of 0.02 in four images, spread 0.1 over half of 0.3: (4 x 0.02 x 0.2 + 0.44 x 0.3) / (4 x 0.02^2 + 0.44)
    found = solve_albedo(shade, dark, Usual(np.array([0.1, 0.1]), np.array([0.3, 0.3]), np.array([0.15, 0.15])))
    assert found[0].tolist() == pytest.approx([0.32, 0.32], abs=0.01)


def test_the_first_image_keeps_the_unit(seen: Seen) -> None:
    colours, _ = solved(seen)
    assert colours.gain[0].tolist() == [1.0, 1.0]
    assert colours.offset[0].tolist() == [0.0, 0.0]


def test_glare_in_one_image_of_four_is_not_the_grounds(seen: Seen, albedo: np.ndarray) -> None:
    all_seen = replace(seen, weight=np.ones_like(seen.weight))
    radiance = all_seen.radiance.copy()
    radiance[2, :400] += 0.8
    _, found = solved(replace(all_seen, radiance=radiance))
    # a mean of the four would be 0.3 too bright (0.8 over a gain of 0.6 over four images)
    assert np.abs(found[:400] - albedo[:400]).mean() < 0.03


def test_clipped_pixels_count_where_nothing_else_is_seen_alone(seen: Seen, albedo: np.ndarray) -> None:
    weight = np.ones_like(seen.weight)
    radiance = seen.radiance.copy()
    radiance[:2, :300] = 0.1
    weight[:2, :300] = 1e-3
    weight[2:, :100] = 0.0  # nobody else
    _, found = solved(Seen(radiance, weight, np.ones_like(seen.lit)), TRUE)
    assert np.abs(found[:100] - (0.1 - OFFSET[:2].mean(axis=0)) / GAIN[:2].mean(axis=0)).mean() < 0.05


def test_land_beside_much_water_keeps_its_albedo(albedo: np.ndarray) -> None:
    mostly_water = np.where(np.arange(len(albedo))[:, None] < 3000, 0.01, albedo).astype(np.float32)
    water = shown(mostly_water, TRUE)
    noise = np.random.default_rng(3).normal(0.0, 0.02, water.radiance.shape).astype(np.float32)
    _, found = solved(replace(water, radiance=water.radiance + noise), TRUE, mostly_water)
    shows = (water.weight * water.lit).sum(axis=0) >= 2
    land = shows & (np.arange(len(albedo)) >= 3000)
    # noise of 0.02 in two images or more; drawn to the water's 0.01, land of 0.33 in the mean would be far below that
    assert abs((found[land] - albedo[land]).mean()) < 0.01


def test_what_one_image_alone_shows_has_the_albedo_that_it_shows(seen: Seen, albedo: np.ndarray) -> None:
    alone = np.zeros_like(seen.weight)
    alone[np.arange(len(albedo)) % 4, np.arange(len(albedo))] = 1.0
    lit = Seen(shown(albedo, TRUE).radiance, alone, seen.lit)
    some = sample(lit, albedo, 0)
    assert some[0].weight.shape[1] == 4000
    found = solve_albedo(lit, TRUE, usual(some[0], TRUE))
    np.testing.assert_allclose(found, albedo, atol=0.02)


def test_of_nothing_seen_nothing_is_found(seen: Seen) -> None:
    blind = replace(seen, weight=np.zeros_like(seen.weight))
    colours, found = solved(blind, TRUE)
    np.testing.assert_array_equal(colours.gain, GAIN)
    assert np.isfinite(found).all()


def test_calibrated_images_keep_gain_and_offset(albedo: np.ndarray) -> None:
    known = Colours(GAIN, np.zeros_like(OFFSET), AMBIENT)
    start = Colours(GAIN, np.zeros_like(OFFSET), np.full_like(AMBIENT, 0.6))
    colours, found = solved(shown(albedo, known), start, scale_held=True)
    np.testing.assert_array_equal(colours.gain, GAIN)
    np.testing.assert_array_equal(colours.offset, 0.0)
    np.testing.assert_allclose(colours.ambient, AMBIENT, atol=0.03)
    assert np.abs(found - albedo).mean() < 0.01


def test_an_image_that_shows_next_to_nothing_keeps_its_colours(seen: Seen, albedo: np.ndarray) -> None:
    weight = seen.weight.copy()
    weight[3, 49:] = 0.0
    start = replace(TRUE, gain=np.array([*GAIN[:3], [0.77, 0.88]]))
    colours, _ = solved(replace(seen, weight=weight), start, albedo)
    np.testing.assert_allclose(colours.gain[3], [0.77, 0.88], rtol=1e-3)  # the first image's gain stays 1


def test_an_image_all_in_shade_does_not_tell_how_bright_the_sun_is(albedo: np.ndarray) -> None:
    lit = (np.random.default_rng(1).uniform(size=(4, len(albedo))) > 1 / 3).astype(np.float32)
    lit[0] = 0.0
    light = np.stack([TRUE.light(lit, band) for band in range(2)], axis=-1)
    dark = Seen((light * albedo + OFFSET[:, None]).astype(np.float32), np.ones(lit.shape, np.float32), lit)
    colours, found = solved(dark, TRUE, albedo)
    np.testing.assert_allclose(colours.gain, GAIN, atol=0.05)
    np.testing.assert_allclose(found, albedo, atol=0.02)


def test_cells_do_not_depend_on_what_else_is_solved_with_them(seen: Seen) -> None:
    known = Usual(np.array([0.01, 0.02]), np.array([0.3, 0.3]), np.array([0.15, 0.15]))
    whole = solve_albedo(seen, TRUE, known)
    np.testing.assert_array_equal(solve_albedo(seen.at(slice(1000, 1100)), TRUE, known), whole[1000:1100])


def test_black_ground_is_not_darker_than_black(seen: Seen) -> None:
    dark = replace(seen, radiance=seen.radiance - 1.0)
    assert solve_albedo(dark, TRUE, Usual(*np.array([[0.01, 0.01], [0.3, 0.3], [0.15, 0.15]]))).min() == 0.0


def relative_error(scene: Scene, options: FitOptions) -> float:
    """Mean difference to the true albedo over its mean, after one factor per band."""
    fit(scene, options)
    export(scene, ExportOptions())
    found, _ = read_raster(scene.path(scene.products["albedo"]))
    true, _ = read_raster(next((scene.root / "truth").glob("*ALBEDO.tif")))
    true = true[:, : found.shape[1], : found.shape[2]]
    shown = np.isfinite(found).all(axis=0)
    factor = np.median(true[:, shown], axis=1) / np.median(found[:, shown], axis=1)
    return float(np.abs(found * factor[:, None, None] - true)[:, shown].mean() / true[:, shown].mean())


def test_a_town_has_its_albedo(make_town: Any) -> None:
    # 0.237; it was 0.287 when the descent's albedo on cells of 1 m was interpolated to those of 0.5 m
    assert relative_error(make_town("TOWN"), FitOptions()) < 0.25
