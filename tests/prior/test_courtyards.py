"""Courtyards that the smoothness term bridges, and what tells them from roofs."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter, map_coordinates

from sattools.prior.frame import Frame
from sattools.prior.matching import match
from sattools.prior.matching.sweep import MatchTask
from sattools.prior.options import PriorOptions
from sattools.prior.visibility import courtyards
from sattools.prior.visibility.courtyards import doubtful
from sattools.prior.visibility.occlusion import UNKNOWN, all_visible, compute_visibility, dark_noise, measure_dark

CELL = 0.5
HEIGHTS = (-4.0, 18.0)
LEANS = [(0.0, 0.0), (0.25, 0.1), (-0.2, 0.25), (0.1, -0.3), (-0.9, 0.5), (0.8, 0.7), (-0.6, -0.9), (1.0, -0.6)]
SUN = (0.42, -0.56, 0.714)


def lit_views(height: Any, albedo: Any, haze: Any = 0.0) -> Any:
    """Views of a surface in sun and shadow, rendered from the top downward: walls hide, and are dark."""
    slopes = np.array(LEANS)
    margin = match.margin_for(slopes, 0.0, (HEIGHTS[0] - 8, HEIGHTS[1] + 8), 2)
    wide, rho = (np.pad(a, margin, mode="edge") for a in (height, albedo))
    rows, cols = np.indices(wide.shape).astype(float)
    shaded = np.zeros(wide.shape, bool)
    for z in np.arange(0.25, HEIGHTS[1], 0.25):  # up the ray to the sun
        at = [rows - SUN[1] / SUN[2] * z / CELL, cols + SUN[0] / SUN[2] * z / CELL]
        shaded |= map_coordinates(wide, at, order=0, mode="nearest") > wide + z
    radiance = rho * np.where(shaded, 0.15, 1.0)
    rng = np.random.default_rng(5)
    images = []
    for k, slope in enumerate(slopes):
        image = np.full(wide.shape, 0.1)
        for z in np.arange(HEIGHTS[0], HEIGHTS[1], 0.1):
            at = [rows - slope[0] * z, cols - slope[1] * z]
            top = map_coordinates(wide, at, order=0, mode="nearest")
            image = np.where(top >= z + 0.1, 0.1, image)  # a wall
            image = np.where(np.abs(top - z) <= 0.05, map_coordinates(radiance, at, order=1, mode="nearest"), image)
        images.append(image + haze * k + rng.normal(0, 0.004, image.shape))
    stack = np.stack(images).astype(np.float32)
    return Frame(stack, np.ones(stack.shape, np.uint8), slopes, 0.0, CELL, margin, (SUN,) * len(stack))


@pytest.fixture(scope="module")
def block() -> Any:
    """A block of 14 m with a courtyard of 8 m, and beside it a black flat roof of 6 m."""
    rng = np.random.default_rng(1)
    height = np.zeros((100, 120))
    height[20:72, 20:72] = 14.0
    height[38:54, 38:54] = 0.0
    height[30:60, 90:112] = 6.0
    albedo = np.clip(0.6 + 0.25 * gaussian_filter(rng.normal(0, 1, height.shape), 0.7), 0.1, 1.0)
    albedo[30:60, 90:112] *= 0.2
    return height, lit_views(height, albedo, haze=0.01)


PAIRS = np.array([(a, b) for a in range(8) for b in range(a + 1, 8)])
COURT, ROOF, BLACK = np.s_[41:51, 41:51], np.s_[24:34, 26:66], np.s_[34:56, 94:108]


def test_a_court_is_open_and_roofs_stay_bright_or_black(block: Any) -> None:
    height, frame = block
    found = match.match(frame, PAIRS, HEIGHTS, PriorOptions()).height
    assert np.median(np.abs(found - height)[COURT]) < 1.0
    assert np.median(np.abs(found - height)[ROOF]) < 0.3
    assert np.median(np.abs(found - height)[BLACK]) < 0.3


def test_without_looking_for_courts_it_would_be_roofed_over(block: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    height, frame = block
    monkeypatch.setattr(match, "OPENING_PASSES", 0)
    found = match.match(frame, PAIRS, HEIGHTS, PriorOptions()).height
    assert np.median(found[COURT]) > 8.0, "else this scene proves nothing"
    assert np.median(np.abs(found - height)[ROOF]) < 0.3


def test_what_lies_in_the_sun_and_looks_like_shadow_is_doubted_if_the_views_disagree(block: Any) -> None:
    height, frame = block
    roofed = height.astype(np.float32)
    roofed[38:54, 38:54] = 14.0
    visibility = compute_visibility(frame, roofed, HEIGHTS, 2.0, all_visible(frame).dark)
    visibility = replace(visibility, dark=measure_dark(frame, roofed, 2.0, visibility))
    poor, good = np.full(height.shape, 0.2, np.float32), np.full(height.shape, 0.8, np.float32)
    doubt = doubtful(frame, visibility, roofed, poor, PriorOptions())
    assert doubt[COURT].mean() > 0.9
    assert doubt[ROOF].mean() == 0.0
    assert not doubtful(frame, visibility, roofed, good, PriorOptions()).any()


def test_shadows_are_as_bright_as_each_date_s_haze_makes_them(block: Any) -> None:
    height, frame = block
    surface = height.astype(np.float32)
    visibility = compute_visibility(frame, surface, HEIGHTS, 2.0, all_visible(frame).dark)
    dark = measure_dark(frame, surface, 2.0, visibility)
    # 0.15 of an albedo of 0.6 and some, plus a haze of 0.01 a date; a wall is 0.1
    assert dark == pytest.approx(0.085 + 0.01 * np.arange(8), abs=0.015)
    # noise of 0.004 and hardly any texture: 15 % of 0.1; resampled nowhere here
    assert 0.003 < dark_noise(frame, dark, 0.05, 0.001) < 0.012
    assert dark_noise(frame, dark, 0.05, 0.02) == 0.02


def test_without_suns_nothing_is_known_of_shadows_and_nothing_is_opened(block: Any) -> None:
    height, frame = block
    blind = Frame(frame.images, frame.masks, frame.parallax, 0.0, CELL, frame.margin, (None,) * 8)
    visibility = all_visible(blind)
    surface = height.astype(np.float32)
    task = MatchTask(blind, PAIRS, HEIGHTS, 2.0, PriorOptions(), robust=False)
    rough = courtyards.RoughSurface(surface, np.zeros_like(surface), surface, visibility)
    same = courtyards.open_courtyards(task, rough)
    assert same.height is surface
    assert same.ceiling is None
    assert visibility.dark.max() == UNKNOWN
    assert dark_noise(blind, visibility.dark, 0.05, 0.01) == 0.01


def test_a_point_just_below_a_lit_roof_is_lit_and_deep_below_it_may_be_shaded(block: Any) -> None:
    height, frame = block
    visibility = compute_visibility(frame, height.astype(np.float32), HEIGHTS, 2.0, all_visible(frame).dark)
    assert visibility.shadow_height[0, 28, 40] <= 12.0  # roof of 14 m, tolerance 2 m
    assert visibility.shadow_height[0, 46, 46] > 5.0  # floor of the courtyard
