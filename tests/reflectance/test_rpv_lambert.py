"""Lambert's law and the Rahman-Pinty-Verstraete model."""

import math
from typing import Any

import pytest
import textbook
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from sattools.reflectance import hapke, lambert, rpv

angle = st.floats(0.5, 89.0)


def test_lambert_is_the_albedo_whatever_the_incidence(directions: Any) -> None:
    for incidence in (0.0, 60.0, 89.0):
        assert float(lambert(*directions(incidence, 30.0, 10.0), 1.0)) == 1.0
    normal, sun, view = (x.float() for x in directions(30.0, 30.0, 10.0))
    assert lambert(normal.expand(4, 3), sun, view, torch.tensor(0.25)).tolist() == [0.25] * 4


@given(angle, angle, st.floats(0, 180), st.floats(0, 1), st.floats(0, 2), st.floats(-0.95, 0.95), st.floats(0, 1))
@settings(max_examples=200, deadline=None)
def test_rpv_agrees_with_the_printed_equations(
    directions: Any, i: Any, e: Any, psi: Any, rho0: Any, k: Any, theta: Any, rhoc: Any
) -> None:
    value = float(rpv(*directions(i, e, psi), rho0, k, theta, rhoc))
    expected = textbook.rpv(*(math.radians(x) for x in (i, e, psi)), rho0, k, theta, rhoc)
    # the printed G subtracts large squares near the hot spot and loses half the digits
    assert value == pytest.approx(expected, rel=1e-6, abs=1e-15)


def test_rpv_becomes_lambert(scattered: Any) -> None:
    normal, sun, view, rho0 = scattered(10_000, [(0.0, 1.0)])
    value, expected = rpv(normal, sun, view, rho0, 1.0, 0.0, 1.0), lambert(normal, sun, view, rho0)
    torch.testing.assert_close(value, expected, rtol=1e-15, atol=0)
    assert float((expected == 0).double().mean()) < 0.5


def test_rpv_at_a_point_worked_out_by_hand(directions: Any) -> None:
    # i = e = 60 degrees on the sun's side: cos g = 1, G = 0, mu0 mu (mu0 + mu) = 1/4
    value = float(rpv(*directions(60, 60, 0), 0.2, 0.5, -0.5, 0.4))
    assert value == pytest.approx(0.2 * 2 * (0.75 / 0.125) * 1.6, rel=1e-12)


def test_sun_and_view_of_rpv_can_be_exchanged(scattered: Any) -> None:
    normal, sun, view, *parameters = scattered(20_000, [(0.0, 1.0), (0.0, 2.0), (-0.95, 0.95), (0.0, 1.0)])
    there, back = rpv(normal, sun, view, *parameters), rpv(normal, view, sun, *parameters)
    assert float(((there - back).abs() / there.clamp_min(1e-30)).max()) <= 1e-12


@pytest.mark.parametrize(("theta", "sign"), [(-0.3, 1), (0.3, -1)])
def test_negative_asymmetry_is_brighter_towards_the_sun(directions: Any, theta: Any, sign: Any) -> None:
    towards, away = (float(rpv(*directions(50, 50, psi), 0.3, 1.0, theta, 1.0)) for psi in (0.0, 180.0))
    assert sign * (towards - away) > 0.05


def test_asymmetry_can_be_learned_from_zero(directions: Any) -> None:
    theta = torch.zeros((), dtype=torch.float64, requires_grad=True)
    rpv(*directions(30, 30, 0), 0.3, 1.0, theta, 1.0).backward()
    # d/dTheta (1 + 2 Theta cos g + Theta^2)^(-3/2) = -3 cos g at 0
    assert float(theta.grad) == pytest.approx(-0.9, rel=1e-12)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_the_type_of_the_inputs_is_the_type_of_the_result(directions: Any, dtype: Any) -> None:
    vectors = [x.to(dtype) for x in directions(30, 40, 50)]
    for value in (lambert(*vectors, 0.5), rpv(*vectors, 0.5, 0.9, 0.1, 0.5), hapke(*vectors, 0.5, 0.3, 0.4, 20.0)):
        assert value.dtype == dtype
    assert hapke(*vectors, torch.tensor(0.5).double(), 0.3, 0.4, 20.0).dtype == torch.float64


def test_other_types_and_shapes_are_refused(directions: Any) -> None:
    vectors = directions(30, 40, 50)
    with pytest.raises(TypeError, match=r"found torch\.float16, expected float32 or float64"):
        lambert(*[x.half() for x in vectors], 0.5)
    with pytest.raises(ValueError, match=r"sun: found shape \(2,\), expected \[..., 3\]"):
        hapke(vectors[0], vectors[1][:2], vectors[2], 0.5, 0.3, 0.4, 20.0)


def test_a_direction_that_is_a_list_is_told() -> None:
    with pytest.raises(TypeError, match="sun: found list, expected a tensor or an array"):
        lambert(torch.tensor([0.0, 0.0, 1.0]), [0.0, 0.0, 1.0], torch.tensor([0.0, 0.0, 1.0]), 0.5)
