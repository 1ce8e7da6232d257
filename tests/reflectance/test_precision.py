"""Single precision: error against double precision, and no value or gradient that is not finite."""

import runpy
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import torch

STRESS = runpy.run_path(str(Path(__file__).parents[2] / "benchmarks" / "reflectance_stress.py"))
MODELS = STRESS["MODELS"]


@pytest.fixture(autouse=True)
def _seed() -> Iterator[Any]:
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(1)
        yield


@pytest.mark.parametrize("name", MODELS)
def test_single_precision_keeps_five_digits(name: Any) -> None:
    model, ranges = MODELS[name]
    error = STRESS["errors"](model, STRESS["random_case"](300_000, ranges, 89.0))
    assert float(error.kthvalue(int(0.999 * len(error))).values) <= 1e-5
    # worst where sun and sensor face each other at grazing angles over very rough ground
    assert float(error.max()) <= 1e-3


@pytest.mark.parametrize("name", MODELS)
def test_special_angles_and_bounds_give_finite_values_and_gradients(name: Any) -> None:
    model, ranges = MODELS[name]
    assert STRESS["not_finite"](model, STRESS["special_cases"](ranges))[0] == 0


@pytest.mark.parametrize("name", MODELS)
def test_random_geometries_above_and_below_the_horizon_give_finite_values_and_gradients(name: Any) -> None:
    model, ranges = MODELS[name]
    assert STRESS["not_finite"](model, STRESS["random_case"](100_000, ranges, 120.0))[0] == 0


@pytest.mark.slow
@pytest.mark.parametrize("name", MODELS)
def test_ten_million_geometries_give_finite_values_and_gradients(name: Any) -> None:
    model, ranges = MODELS[name]
    for _ in range(10):
        assert STRESS["not_finite"](model, STRESS["random_case"](1_000_000, ranges, 120.0))[0] == 0
