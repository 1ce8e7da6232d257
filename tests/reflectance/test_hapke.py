"""Hapke's model: published numbers, symmetry, limits."""

import math
from typing import Any

import numpy as np
import pytest
import textbook
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from sattools.reflectance import hapke

# incidence, emission, azimuth, theta-bar in degrees; mu0e, mue, S, BRF for w = 0.6, b = 0.3, c = 0.4, no opposition
GOLDEN = [
    (50, 30, 90, 20, 0.564818, 0.727764, 0.956777, 0.146216),
    (70, 65, 150, 30, 0.295126, 0.293154, 0.281883, 0.091275),
    (65, 70, 150, 30, 0.293154, 0.295126, 0.350653, 0.091275),
    (75, 60, 170, 35, 0.262539, 0.232308, 0.143326, 0.067743),
    (45, 10, 0, 15, 0.639797, 0.889841, 0.998628, 0.154039),
]
FULL = [(0.0, 0.95), (0.0, 0.9), (0.0, 1.0), (0.01, 60.0)]


@pytest.mark.parametrize(("i", "e", "psi", "theta", "mu0e", "mue", "shadow", "brf"), GOLDEN)
def test_reference_values_of_roughness_and_reflectance(
    directions: Any, i: Any, e: Any, psi: Any, theta: Any, mu0e: Any, mue: Any, shadow: Any, brf: Any
) -> None:
    vectors = directions(i, e, psi)
    # the values are printed with six decimals
    effective = textbook.effective(*(math.radians(x) for x in (i, e, psi, theta)))
    assert effective == pytest.approx((mu0e, mue, shadow), abs=6e-7)
    assert float(hapke(*vectors, 0.6, 0.3, 0.4, theta)) == pytest.approx(brf, abs=6e-7)


@pytest.mark.parametrize(
    ("i", "e", "psi", "brf"), [(30, 30, 0, 0.2474665), (30, 80, 0, 0.1955534), (30, 89, 180, 0.1542636)]
)
def test_reference_values_with_opposition_effect(directions: Any, i: Any, e: Any, psi: Any, brf: Any) -> None:
    value = hapke(*directions(i, e, psi), 0.526, 0.187, 0.6365, 13.3, b0=1.0, h=0.083)
    assert float(value) == pytest.approx(brf, abs=6e-8)


angle = st.floats(0.5, 89.0)


@given(
    angle,
    angle,
    st.floats(0.0, 180.0),
    st.floats(0.0, 0.98),
    st.floats(0.0, 0.9),
    st.floats(0.0, 1.0),
    st.floats(0.1, 60.0),
)
@settings(max_examples=200, deadline=None)
def test_agrees_with_the_printed_equations(
    directions: Any, i: Any, e: Any, psi: Any, w: Any, b: Any, c: Any, theta: Any
) -> None:
    value = float(hapke(*directions(i, e, psi), w, b, c, theta, b0=0.6, h=0.1))
    angles = (math.radians(x) for x in (i, e, psi))
    expected = textbook.hapke(*angles, w, b, c, math.radians(theta), 0.6, 0.1)
    # the printed form takes g by arc cosine, which loses half the digits near g = 0
    assert value == pytest.approx(expected, rel=1e-7, abs=1e-15)


def test_sun_and_view_can_be_exchanged(scattered: Any) -> None:
    normal, sun, view, *parameters = scattered(20_000, FULL)
    there, back = hapke(normal, sun, view, *parameters, 0.8, 0.1), hapke(normal, view, sun, *parameters, 0.8, 0.1)
    assert float(((there - back).abs() / there.clamp_min(1e-30)).max()) <= 1e-12


@pytest.mark.parametrize(("i", "psi"), [(30.0, 60.0), (60.0, 150.0)])
def test_both_cases_of_the_roughness_meet_where_incidence_equals_emission(directions: Any, i: Any, psi: Any) -> None:
    values = [float(hapke(*directions(i, e, psi), 0.6, 0.3, 0.4, 25.0)) for e in (i - 1e-9, i, i + 1e-9)]
    assert values[0] == pytest.approx(values[1], rel=1e-9)
    assert values[2] == pytest.approx(values[1], rel=1e-9)


@pytest.mark.parametrize(("c", "sign"), [(0.9, 1), (0.1, -1)])
def test_a_heavy_back_lobe_is_brighter_towards_the_sun(directions: Any, c: Any, sign: Any) -> None:
    towards, away = (float(hapke(*directions(75, 75, psi), 0.3, 0.5, c, 0.01)) for psi in (0.0, 180.0))
    assert sign * (towards - away) > 0.05


def test_weight_one_half_makes_the_phase_function_symmetric(directions: Any) -> None:
    towards, away = (float(hapke(*directions(45, 45, psi), 0.3, 0.5, 0.5, 0.001)) for psi in (0.0, 180.0))
    # g = 0 and g = 90 degrees: p = (1-b^2)/2 [(1+b)^-3 + (1-b)^-3] and (1-b^2)(1+b^2)^-1.5
    p0, p90 = 0.375 * (1.5**-3 + 0.5**-3), 0.75 * 1.25**-1.5
    assert towards - away == pytest.approx(0.3 / 4 * (p0 - p90) / (2 * math.sqrt(0.5)), rel=1e-9)


def test_dark_smooth_isotropic_ground_follows_lommel_and_seeliger(scattered: Any) -> None:
    normal, sun, view = scattered(1000, [])
    mu0, mu = (normal * sun).sum(-1), (normal * view).sum(-1)
    up = (mu0 > 0.05) & (mu > 0.05)
    value = hapke(normal, sun, view, 1e-8, 0.0, 0.0, 1e-4)[up]
    # multiple scattering adds a share of the order of w
    torch.testing.assert_close(value, (0.25e-8 / (mu0 + mu))[up], rtol=1e-6, atol=0)


def reflected(incidence: float, w: float, b: float, c: float, theta: float) -> float:
    """Share of a beam's light that leaves the surface: integral of BRF cos e / pi (Gauss and midpoint rules)."""
    nodes, weights = np.polynomial.legendre.leggauss(60)
    mu = torch.from_numpy((nodes + 1) / 2)[:, None]
    azimuth = (torch.arange(180, dtype=torch.float64) + 0.5) * math.pi / 180
    s = (1 - mu * mu).sqrt()
    view = torch.stack([s * azimuth.cos(), s * azimuth.sin(), mu.expand(-1, 180)], -1)
    i = math.radians(incidence)
    sun = torch.tensor([math.sin(i), 0, math.cos(i)], dtype=torch.float64)
    normal = torch.tensor([0, 0, 1.0], dtype=torch.float64)
    ring = (hapke(normal, sun, view, w, b, c, theta) * mu).mean(1)
    # both half circles are alike, so their mean stands for the circle: 2 pi / pi, and d mu = weights / 2
    return float((ring * torch.from_numpy(weights)).sum())


@pytest.mark.parametrize("incidence", [0.0, 40.0, 75.0])
def test_white_isotropic_smooth_ground_returns_all_light(incidence: Any) -> None:
    # the approximate H is up to 1 % too small and enters squared; w ends at 1 - 1e-6, which costs 0.2 %
    assert reflected(incidence, 1.0, 0.0, 0.5, 1e-4) == pytest.approx(0.99, abs=0.01)


@pytest.mark.parametrize("theta", [0.01, 20.0, 50.0])
@pytest.mark.parametrize(("b", "c"), [(0.0, 0.5), (0.3, 0.7), (0.3, 0.2)])
def test_ground_never_returns_more_light_than_it_receives(theta: Any, b: Any, c: Any) -> None:
    for incidence in (0.0, 30.0, 60.0):
        share = reflected(incidence, 0.95, b, c, theta)
        assert 0.1 < share < 1.0


def test_roughness_darkens_oblique_views(directions: Any) -> None:
    smooth, rough = (float(hapke(*directions(70, 60, 120), 0.6, 0.2, 0.5, theta)) for theta in (1.0, 30.0))
    assert rough < 0.7 * smooth
