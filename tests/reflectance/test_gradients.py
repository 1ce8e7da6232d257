"""Gradients of the reflectance models, and the blocks and bands they are computed in."""

import math
from typing import Any

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from sattools.reflectance import blocks, hapke, lambert, rpv

RANGES = [(0.05, 0.9), (0.05, 0.8), (0.0, 1.0), (1.0, 50.0), (0.1, 1.0), (0.05, 1.0)]

# kinks: i = e, the principal plane, the horizon
geometry = (
    st.tuples(st.floats(1.0, 80.0), st.floats(1.0, 80.0), st.floats(5.0, 175.0))
    .filter(lambda a: abs(a[0] - a[1]) > 0.5)
)  # fmt: skip


def leaves(values: Any) -> list[torch.Tensor]:
    return [torch.as_tensor(v, dtype=torch.float64).clone().requires_grad_() for v in values]


@given(geometry, st.floats(0.01, 0.95), st.floats(0.0, 0.8), st.floats(0.0, 1.0), st.floats(0.5, 60.0))
@settings(max_examples=40, deadline=None)
def test_gradients_of_hapke_are_those_of_finite_differences(
    directions: Any, angles: Any, w: Any, b: Any, c: Any, theta: Any
) -> None:
    operands = leaves([*directions(*angles), w, b, c, theta, 0.7, 0.2])
    assert torch.autograd.gradcheck(hapke, operands, eps=1e-6, atol=1e-6, rtol=1e-5)


@given(geometry, st.floats(0.01, 1.0), st.floats(0.0, 2.0), st.floats(-0.9, 0.9), st.floats(0.0, 1.0))
@settings(max_examples=40, deadline=None)
def test_gradients_of_rpv_are_those_of_finite_differences(
    directions: Any, angles: Any, rho0: Any, k: Any, theta: Any, rhoc: Any
) -> None:
    operands = leaves([*directions(*angles), rho0, k, theta, rhoc])
    assert torch.autograd.gradcheck(rpv, operands, eps=1e-6, atol=1e-6, rtol=1e-5)


def test_the_normal_is_steered_even_where_the_sun_stands_on_it(directions: Any) -> None:
    normal, sun, view = directions(0.0, 60.0, 0.0)
    operands = leaves([normal, sun, view])
    # psi does not exist at i = 0, but the model is smooth there
    assert torch.autograd.gradcheck(lambda n, s, v: hapke(n, s, v, 0.5, 0.3, 0.4, 30.0), operands, atol=1e-6)
    hapke(*operands, 0.5, 0.3, 0.4, 30.0).backward()
    assert float(operands[0].grad.norm()) > 0.05


@pytest.mark.parametrize("name", ["w", "b", "c", "theta"])
def test_parameters_stay_alive_at_the_ends_of_their_ranges(directions: Any, name: Any) -> None:
    # not at 1e-4 degrees: the true derivative with respect to theta-bar vanishes with theta-bar
    ends = {"w": (0.0, 0.99), "b": (0.0, 0.99), "c": (0.0, 1.0), "theta": (2.0, 60.0)}[name]
    for end in ends:
        values = {"w": 0.5, "b": 0.3, "c": 0.4, "theta": 20.0} | {name: end}
        operands = leaves([*directions(60.0, 75.0, 40.0), *values.values()])
        hapke(*operands).backward()
        assert abs(float(operands[3 + list(values).index(name)].grad)) > 1e-5


@pytest.mark.parametrize(("name", "value"), [("w", 1.0), ("b", 1.0), ("theta", 0.0), ("theta", 90.0)])
def test_values_outside_the_model_are_held_at_its_bounds(directions: Any, name: Any, value: Any) -> None:
    values = {"w": 0.5, "b": 0.3, "c": 0.4, "theta": 20.0} | {name: value}
    operands = leaves([*directions(50.0, 20.0, 40.0), *values.values()])
    result = hapke(*operands)
    result.backward()
    assert math.isfinite(float(result.detach()))
    assert float(operands[3 + list(values).index(name)].grad) == 0


@pytest.mark.parametrize("model", ["lambert", "rpv", "hapke"])
@pytest.mark.parametrize(("i", "e"), [(95.0, 20.0), (20.0, 95.0), (120.0, 150.0)])
def test_facets_that_face_away_from_sun_or_sensor_are_black_and_exert_no_pull(
    directions: Any, model: Any, i: Any, e: Any
) -> None:
    function, values = {
        "lambert": (lambert, [0.5]),
        "rpv": (rpv, [0.5, 0.8, -0.1, 0.5]),
        "hapke": (hapke, [0.5, 0.3, 0.4, 20.0]),
    }[model]
    operands = leaves([*directions(i, e, 70.0), *values])
    result = function(*operands)
    (result + 0 * sum(o.sum() for o in operands)).backward()
    assert float(result.detach()) == 0
    assert all(float(o.grad.abs().max()) == 0 for o in operands)


def test_the_horizon_itself_takes_the_limit() -> None:
    normal, sun = torch.tensor([0, 0, 1.0]).double(), torch.tensor([0.6, 0, 0.8]).double()
    edge, near = (torch.tensor([0, math.cos(x), math.sin(x)]).double() for x in (0.0, 1e-7))
    edge[2] = 0
    at, close = (float(hapke(normal, sun, view, 0.5, 0.3, 0.4, 20.0)) for view in (edge, near))
    assert at == pytest.approx(close, rel=1e-5)
    assert at > 0.05


def test_blocks_do_not_change_values_or_gradients(scattered: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    operands = scattered(500, RANGES)
    # one mean slope and one view for all samples: their gradients are sums over blocks
    operands[2], operands[6] = operands[2][0], operands[6][0]
    results = []
    for size in (10**6, 7):
        monkeypatch.setattr(blocks, "BLOCK", size)
        parts = [o.clone().requires_grad_() for o in operands]
        value = hapke(*parts)
        value.square().sum().backward()
        results.append([value.detach(), *(p.grad for p in parts)])
    for whole, cut in zip(*results):
        torch.testing.assert_close(whole, cut, rtol=1e-11, atol=1e-14)


@pytest.mark.parametrize("size", [10**6, 64])
def test_bands_share_the_geometry(scattered: Any, monkeypatch: pytest.MonkeyPatch, size: Any) -> None:
    monkeypatch.setattr(blocks, "BLOCK", size)
    normal, sun, view, w, b, c, theta, b0, h = scattered(300, RANGES)
    bands = torch.stack([w, 0.5 * w, 0.9 - w], -1)

    def together(n: Any, x: Any, *rest: Any) -> Any:
        directions = [d[:, None, :] for d in (n, sun, view)]
        return hapke(*directions, x, *[r[:, None] for r in rest])

    def one_by_one(n: Any, x: Any, *rest: Any) -> Any:
        return torch.stack([hapke(n, sun, view, x[:, k], *rest) for k in range(3)], -1)

    results = []
    for way in (together, one_by_one):
        parts = [o.clone().requires_grad_() for o in (normal, bands, b, c, theta, b0, h)]
        value = way(*parts)
        value.square().sum().backward()
        results.append([value.detach(), *(p.grad for p in parts)])
    assert results[0][0].shape == (300, 3)
    for shared, single in zip(*results):
        torch.testing.assert_close(shared, single, rtol=1e-11, atol=1e-14)


def test_gradients_can_be_asked_for_twice_and_in_part(scattered: Any) -> None:
    normal, sun, view, *parameters = scattered(50, RANGES)
    w = parameters[0].requires_grad_()
    value = hapke(normal, sun, view, *parameters)
    first = torch.autograd.grad(value.sum(), w, retain_graph=True)[0]
    second = torch.autograd.grad(value.sum(), w)[0]
    assert torch.equal(first, second)
    normal = normal.requires_grad_()
    both = torch.autograd.grad(hapke(normal, sun, view, *parameters).sum(), [normal, w])
    torch.testing.assert_close(both[1], first)
    with torch.no_grad():
        assert not hapke(normal, sun, view, *parameters).requires_grad


def test_empty_and_single_inputs_keep_their_shape(directions: Any) -> None:
    none = torch.zeros(0, 3)
    assert hapke(none, none, none, 0.5, 0.3, 0.4, 20.0).shape == (0,)
    assert hapke(*directions(30, 40, 50), 0.5, 0.3, 0.4, 20.0).shape == ()
    assert hapke(*directions(30, 40, 50), torch.rand(2, 1), 0.3, torch.rand(3), 20.0).shape == (2, 3)
