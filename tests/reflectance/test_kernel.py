"""The compiled form of Hapke's model against its readable twin, and the elementary functions it is made of."""

import itertools
import math
from typing import Any

import numpy as np
import pytest
import torch

from sattools.reflectance import elementary, hapke
from sattools.reflectance.hapke import plain_hapke

RANGES = [(0.0, 0.99), (0.0, 0.95), (0.0, 1.0), (1e-4, 60.0), (0.0, 1.0), (0.05, 1.0)]


def both_ways(operands: list[torch.Tensor], needed: range | list[int], weight: torch.Tensor | None = None) -> Any:
    """Value and gradients of the compiled form and of its twin."""
    results = []
    for model in (hapke, plain_hapke):
        parts = [o.clone().requires_grad_(k in needed) for k, o in enumerate(operands)]
        value = model(*parts)
        value.backward(torch.ones_like(value) if weight is None else weight)
        results.append([value.detach(), *(p.grad for p in parts)])
    return zip(*results, strict=True)


def test_values_and_gradients_are_those_of_the_twin(scattered: Any) -> None:
    operands = scattered(3000, RANGES)
    weight = torch.linspace(-1, 1, 3000, dtype=torch.float64)
    for compiled, plain in both_ways(operands, range(9), weight):
        # steep places (small theta-bar, grazing light) lose up to six digits of the fifteen in either form
        torch.testing.assert_close(compiled, plain, rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("needed", [[], [3], [0, 6], [1], [2, 7, 8], [0, 3, 4, 5, 6]])
def test_only_what_is_asked_for_gets_a_gradient(scattered: Any, needed: Any) -> None:
    operands = scattered(300, RANGES)
    parts = [o.clone().requires_grad_(k in needed) for k, o in enumerate(operands)]
    value = hapke(*parts)
    assert value.requires_grad == bool(needed)
    if needed:
        value.sum().backward()
    assert [k for k, p in enumerate(parts) if p.grad is not None] == needed
    for compiled, plain in both_ways(operands, needed) if needed else ():
        if compiled is not None:
            torch.testing.assert_close(compiled, plain, rtol=1e-9, atol=1e-9)


def test_what_samples_share_gathers_all_their_gradients(scattered: Any) -> None:
    operands = scattered(500, RANGES)
    for k in (1, 2, 4, 6, 8):
        operands[k] = operands[k][:1] if k == 6 else operands[k][0]
    for compiled, plain in both_ways(operands, range(9)):
        assert compiled.shape == plain.shape
        # a gradient of the shared slope sums 500 derivatives of both signs
        torch.testing.assert_close(compiled, plain, rtol=1e-8, atol=1e-7)


def test_axes_broadcast_as_in_the_twin(scattered: Any) -> None:
    normal, sun, view, w, b, c, theta, b0, h = scattered(12, RANGES)
    grid = [
        normal.reshape(3, 4, 3),
        sun[:4],
        view[:3, None],
        w[:4],
        b[:3, None],
        c[0],
        theta.reshape(3, 4),
        b0[0],
        h[0],
    ]
    for compiled, plain in both_ways(grid, range(9)):
        assert compiled.shape == plain.shape
        torch.testing.assert_close(compiled, plain, rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_at_all_singular_angles_values_agree_and_gradients_stay_finite(directions: Any, dtype: Any) -> None:
    angles = itertools.product([0, 30, 60, 90 - 1e-4, 90, 100], [0, 30, 60, 90 - 1e-4, 90, 100], [0, 1e-3, 90, 180])
    corners = list(itertools.product([0, 0.99], [0, 0.99], [0, 1], [1e-4, 20, 60], [0, 1], [0.05]))
    geometry = [directions(*a) for a in angles]
    rows = [(*g, *[torch.tensor(float(p)) for p in corner]) for g in geometry for corner in corners]
    operands = [torch.stack([row[k] for row in rows]).to(dtype) for k in range(9)]
    (values, plain), *gradients = both_ways(operands, range(9))
    assert all(bool(torch.isfinite(g).all()) for g, _ in gradients)
    # rounding decides on which side of the horizon, and of i = e, a direction lies that is on it; it decides otherwise
    # in double precision than in single
    edge, tolerance = (1e-2, 1e-3) if dtype == torch.float32 else (1e-9, 1e-8)
    cosines = torch.stack([torch.stack([n @ s, n @ v]) for n, s, v in geometry])
    tame = ((cosines.abs() > edge).all(1) & ((cosines[:, 0] - cosines[:, 1]).abs() > edge)).repeat_interleave(
        len(corners)
    )
    assert tame.sum() > 1000
    torch.testing.assert_close(values[tame], plain[tame], rtol=tolerance, atol=tolerance)
    assert bool(torch.isfinite(values).all())


def test_what_is_unknown_stays_unknown(scattered: Any) -> None:
    operands = scattered(4, RANGES)
    operands[3][1] = math.nan
    assert torch.isnan(hapke(*operands)).tolist() == [False, True, False, False]


def test_numbers_of_samples_that_fill_no_whole_block_are_all_worked_out(scattered: Any) -> None:
    operands = scattered(8192 + 128 + 1, RANGES)
    torch.testing.assert_close(hapke(*operands), plain_hapke(*operands), rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize(
    ("name", "reference", "values"),
    [
        ("exp", np.exp, -np.geomspace(1e-12, 190, 5000)),
        ("expm1", np.expm1, -np.geomspace(1e-12, 190, 5000)),
        ("log", np.log, np.geomspace(1 + 1e-9, 1e14, 5000)),
        ("tan", np.tan, np.geomspace(1e-9, math.radians(80), 5000)),
    ],
)
def test_elementary_functions_keep_all_digits(name: Any, reference: Any, values: Any) -> None:
    function = getattr(elementary, name)
    found = np.array([function(value) for value in values])
    assert np.abs(found / reference(values) - 1).max() < 5e-15


def test_the_angle_of_a_direction_keeps_all_digits_in_the_upper_half() -> None:
    turns = np.linspace(0, math.pi, 1001)
    found = [elementary.angle(math.sin(turn), math.cos(turn)) for turn in turns]
    assert found == pytest.approx(turns, abs=1e-15)
    assert elementary.angle(0.0, 0.0) == 0.0
    assert elementary.angle(0.0, -1.0) == math.pi
