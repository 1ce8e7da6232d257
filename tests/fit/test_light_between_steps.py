"""Light is computed with heights that are smooth between the steps of a town, and as before where there are hills."""

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from sattools.fit.materials.blur import blurred
from sattools.fit.materials.normals import surface_normals
from sattools.fit.materials.steps import (
    NORMAL_CELLS,
    blurred_within,
    find_steps,
    normals_within,
    plain_blurred_within,
    smooth_heights,
    smooth_normals,
)
from sattools.simulate.natural import fractal

UP = torch.tensor([0.0, 0.0, 1.0])


def house(size: int = 24, high: float = 6.0) -> torch.Tensor:
    """Level ground with a house of 8 x 8 cells."""
    height = torch.zeros(size, size)
    height[8:16, 8:16] = high
    return height


def test_a_house_has_a_level_roof_and_stands_on_level_ground() -> None:
    smooth, steps = smooth_heights(house(), 1.0)
    assert steps is not None
    assert int(steps.east.sum()) == int(steps.south.sum()) == 16
    assert torch.allclose(smooth, house(), atol=1e-6)
    assert torch.allclose(smooth_normals(house(), 1.0), UP.expand(24, 24, 3), atol=1e-6)


def test_a_wall_that_takes_two_cells_is_one_still() -> None:
    height = torch.zeros(16, 16)
    height[:, 8:], height[:, 7] = 6.0, 3.0
    normal = smooth_normals(height, 1.0)
    assert torch.allclose(normal[:, :7], UP.expand(16, 7, 3), atol=1e-6)
    assert torch.allclose(normal[:, 8:], UP.expand(16, 8, 3), atol=1e-6)


def test_a_roof_keeps_its_slope_to_its_rim() -> None:
    height = house()
    height[8:16, 8:16] += 0.5 * torch.arange(8.0)  # rises to the east by 0.5 m per metre
    smooth, steps = smooth_heights(height, 1.0)
    assert steps is not None
    normal = smooth_normals(height, 1.0)[8:16, 8:16]
    slope = -normal[..., 0] / normal[..., 2]
    # means of one side only pull the ends of a ramp in by some of its rise
    assert float(slope.min()) > 0.15
    assert float(slope[:, 3:5].min()) > 0.35
    assert torch.allclose(smooth[0], torch.zeros(24), atol=1e-6)


def test_hills_have_no_steps_however_steep_they_are() -> None:
    cells = torch.arange(32.0)
    hill = 1.2 * torch.minimum(cells, 31 - cells).expand(32, 32).clone()
    hill[10, 10] += 20.0  # a blunder
    assert find_steps(hill, 1.0) is None
    assert torch.equal(smooth_normals(hill, 1.0), surface_normals(blurred(hill, NORMAL_CELLS), 1.0))


@pytest.mark.parametrize("turned", [False, True])
def test_hills_that_fall_one_way_are_hills(turned: bool) -> None:
    # most neighbours along such a hill are level with each other
    hill = 0.4 * torch.arange(32.0).expand(32, 32).clone()
    hill[10:14, 10:14] += 5.0
    assert find_steps(hill.T.contiguous() if turned else hill, 1.0) is None


@pytest.mark.parametrize("slope_deg", [15.0, 30.0, 40.0])
def test_relief_is_no_town_whichever_way_it_is_turned(slope_deg: float) -> None:
    relief = torch.from_numpy(fractal(128, 2.0, slope_deg, np.random.default_rng(3))).float()
    relief = relief + 0.3 * torch.randn(128, 128, generator=torch.Generator().manual_seed(0))  # errors of a fit
    relief[40:46, 60:66] += 8.0  # a blunder
    assert find_steps(relief, 2.0) is None
    assert find_steps(relief.T.contiguous(), 2.0) is None


def test_level_ground_with_noise_is_smoothed_as_before() -> None:
    noise = 0.1 * torch.randn(20, 20, generator=torch.Generator().manual_seed(0))
    assert find_steps(noise, 1.0) is None
    assert torch.equal(smooth_heights(noise, 1.0)[0], blurred(noise, NORMAL_CELLS))


@settings(max_examples=25, deadline=None)
@given(seed=st.integers(0, 10**6), rows=st.integers(2, 14), cols=st.integers(2, 14))
def test_the_compiled_blur_is_its_plain_twin_forth_and_back(seed: int, rows: int, cols: int) -> None:
    chance = torch.Generator().manual_seed(seed)
    height = 4.0 * torch.randint(0, 2, (rows, cols), generator=chance).double()
    height += 0.01 * torch.randn(rows, cols, generator=chance, dtype=torch.float64)
    steps = find_steps(height, 1.0)
    if steps is None:
        return
    weights = torch.randn(rows, cols, generator=chance, dtype=torch.float64)
    found, grads = [], []
    for blur in (blurred_within, plain_blurred_within):
        leaf = height.clone().requires_grad_()
        out = blur(leaf, 1.5, steps)
        (out * weights).sum().backward()
        found.append(out.detach())
        grads.append(leaf.grad)
    assert torch.allclose(*found, atol=1e-12)
    assert torch.allclose(*grads, atol=1e-12)


def test_gradients_of_light_between_steps_are_right() -> None:
    height = house(12).double()
    height += 0.05 * torch.randn(12, 12, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    steps = find_steps(height, 1.0)
    assert steps is not None

    def light(h: torch.Tensor) -> torch.Tensor:
        return normals_within(blurred_within(h, 1.0, steps), 1.0, steps)

    assert torch.autograd.gradcheck(light, (height.requires_grad_(),))


@pytest.mark.parametrize("shape", [(1, 9), (9, 1)])
def test_a_single_row_or_column_has_normals(shape: tuple[int, int]) -> None:
    height = torch.zeros(shape)
    height.view(-1)[4:] = 6.0
    assert torch.isfinite(smooth_normals(height, 1.0)).all()
