"""The compiled renderer leads blocks of neighbouring rays together; here every ray is followed alone.

Heights, slopes, steps and offsets are multiples of powers of two, so that float32 positions are exact and both must
look at the very same samples.
"""

import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import numba
import numpy as np
import pytest
import torch
from torch.nn.functional import max_pool2d

from sattools.render import ParallelRays, Quadrature, render
from sattools.render.blocks import LANES, absorption
from sattools.render.surface import COUNTER

SOFTNESS, STEP, BOTTOM = 0.5, 0.25, -8.0
REACH, EMPTY, LEAST = 4, 6.0, 1e-3


def town(shape: Any, seed: Any = 0) -> Any:
    """Ground of 0 to 1 m with walls of 5 and 11 m, two of them at the map's edge; and colours."""
    rng = np.random.default_rng(seed)
    rows, cols = shape
    height = rng.integers(0, 64, shape) / 64
    height[rows // 4 : rows // 2, cols // 3 : cols // 2] += 5
    height[rows // 2 :, -max(1, cols // 6) :] += 11
    height[: rows // 3, : max(1, cols // 8)] += 5
    return torch.from_numpy(height).float(), torch.from_numpy(rng.uniform(0.1, 0.9, (*shape, 2))).float()


def quadrature(height: Any) -> Any:
    return Quadrature(SOFTNESS, STEP, float(height.detach().max()) + EMPTY * SOFTNESS, BOTTOM)


def follow(height: Any, colour: Any, rays: Any, mask: Any) -> Any:
    """Every ray by itself, in float64: colours, depth, opacity and the number of samples.

    It looks only where it last said it would: it leaps over air that is empty by the highest surface around.
    """
    rows, cols = height.shape
    ceiling = max_pool2d(height.detach()[None], 2 * REACH + 1, 1, REACH)[0]
    largest = (REACH - 1) / max(*(abs(s) for s in rays.slope), 1e-3)
    row, col = (t.double() for t in torch.meshgrid(torch.arange(rows), torch.arange(cols), indexing="ij"))
    light, depth, rgb, count = mask.double(), torch.zeros(rows, cols), torch.zeros(rows, cols, 2), 0
    z = float(height.detach().max()) + EMPTY * SOFTNESS
    looks_at = torch.full((rows, cols), z, dtype=torch.float64)
    while z > BOTTOM:
        dz = z - rays.z_ref
        x = (col + rays.offset[0] + rays.slope[0] * dz).clamp(0, cols - 1)
        y = (row - rays.offset[1] - rays.slope[1] * dz).clamp(0, rows - 1)
        x0, y0 = x.long().clamp(0, max(0, cols - 2)), y.long().clamp(0, max(0, rows - 2))
        x1, y1 = (x0 + 1).clamp_max(cols - 1), (y0 + 1).clamp_max(rows - 1)
        looks = (light > LEAST) & (z <= looks_at)
        free = z - EMPTY * SOFTNESS - ceiling[y0, x0]
        leap = STEP * (free.clamp_max(largest) / STEP).floor().clamp_min(1)
        looks_at = torch.where(looks & (free > 0), z - leap, looks_at)
        near = looks & (free <= 0)
        count += int(near.sum())
        fx, fy = x - x0, y - y0
        corners = [(y0, x0, (1 - fx) * (1 - fy)), (y0, x1, fx * (1 - fy)), (y1, x0, (1 - fx) * fy), (y1, x1, fx * fy)]
        u = (sum(w * height[r, c] for r, c, w in corners) - z) / SOFTNESS
        alpha = -torch.expm1(-torch.sigmoid(u) * STEP / SOFTNESS)
        weight = torch.where(near & (u >= -EMPTY), light * alpha, 0.0)
        rgb = rgb + weight[..., None] * sum(w[..., None] * colour[r, c] for r, c, w in corners)
        depth = depth + weight * z
        light = light - weight
        z -= STEP
    return rgb, depth, mask - light, count


SHAPES = [(9, LANES - 1), (9, LANES), (9, LANES + 1), (7, 2 * LANES + 5), (12, 3), (2, 2), (1, 9), (9, 1)]
VIEWS = [
    ParallelRays((0.0, 0.0), 0.5),
    ParallelRays((0.375, -0.25), 0.5, (0.125, -1.5)),
    ParallelRays((-0.625, 0.5), 0.0, (-0.75, 0.25)),
    ParallelRays((3.0, 2.25), 0.25),  # steep: a plane lies up to 40 cells aside of the next block, beyond the map
    ParallelRays((-5.0, 0.125), 0.25, (64.0, -2.0)),
]


def some(shape: Any) -> Any:
    """A mask that wants four rays in five."""
    return torch.from_numpy((np.random.default_rng(1).random(shape) < 0.8).astype(np.uint8))


@pytest.mark.parametrize("shape", SHAPES)
@pytest.mark.parametrize("rays", VIEWS)
def test_a_ray_has_the_same_value_and_sample_count_in_a_packet_as_alone(shape: Any, rays: Any) -> None:
    height, colour = town(shape)
    rgb, depth, opacity, count = follow(height.double(), colour.double(), rays, some(shape))
    before = COUNTER["forward"]
    found = render(height, colour, rays, quadrature(height), 1.0, some(shape))
    assert COUNTER["forward"] - before == count
    # float32 sums of up to some hundred samples; depths are up to 14 m
    assert found[0].numpy() == pytest.approx(rgb.numpy(), abs=1e-5)
    assert found[1].numpy() == pytest.approx(depth.numpy(), abs=1e-4)
    assert found[2].numpy() == pytest.approx(opacity.numpy(), abs=1e-5)


@pytest.mark.parametrize("shape", [*SHAPES, (130, 256)])  # the last one in two chunks of rows
@pytest.mark.parametrize("rays", VIEWS)
def test_gradients_reach_the_cells_that_the_ray_saw(shape: Any, rays: Any) -> None:
    """Also across the borders of blocks and chunks, and at the map's edge."""
    weights = torch.randn((*shape, 4), generator=torch.Generator().manual_seed(3))
    grads = []
    for kind in (torch.float32, torch.float64):
        height, colour = (t.to(kind, copy=True).requires_grad_() for t in town(shape))
        if kind == torch.float32:
            rgb, depth, opacity = render(height, colour, rays, quadrature(height), 1.0, some(shape))
        else:
            rgb, depth, opacity, _ = follow(height, colour, rays, some(shape))
        (torch.cat([rgb, depth[..., None], opacity[..., None]], -1) * weights).sum().backward()
        grads.append((height.grad, colour.grad))
    for mine, alone in zip(*grads, strict=True):
        # float32 differences of sums of up to some hundred terms
        assert float((mine - alone).norm() / alone.norm()) < 1e-4


DIGEST = """
import hashlib
import torch
from sattools.render import ParallelRays, Quadrature, render
noise = torch.Generator().manual_seed(0)
height = (5 * torch.rand(260, 256, generator=noise)).requires_grad_()  # four chunks of rows
colour = torch.rand(260, 256, 2, generator=noise).requires_grad_()
rgb, depth, opacity = render(height, colour, ParallelRays((0.375, -0.25), 0.5), Quadrature(0.5, 1 / 3, 8.0, -5.0), 1.0)
(rgb.square().sum() + depth.sum()).backward()
parts = [t.detach().numpy().tobytes() for t in (rgb, depth, opacity, height.grad, colour.grad)]
digest = hashlib.sha256(b"".join(parts)).hexdigest()
"""


def digest(threads: int, **environment: str) -> str:
    program = f"from sattools.cli import set_threads\nset_threads({threads})\n{DIGEST}print(digest)"
    run = [sys.executable, "-c", program]
    found = subprocess.run(run, env=os.environ | environment, capture_output=True, text=True, check=True).stdout
    assert len(found.strip()) == 64
    return found.strip()


def test_the_number_of_threads_changes_neither_pictures_nor_gradients() -> None:
    """A process has its threads for life: this one has one, as all that runs tests."""
    assert numba.config.NUMBA_NUM_THREADS == torch.get_num_threads() == 1
    here: dict[str, Any] = {}
    exec(DIGEST, here)  # noqa: S102
    assert here["digest"] == digest(2)


@pytest.mark.slow
def test_a_first_run_which_compiles_changes_neither_pictures_nor_gradients(tmp_path: Path) -> None:
    first = digest(1, NUMBA_CACHE_DIR=str(tmp_path))
    assert digest(1, NUMBA_CACHE_DIR=str(tmp_path)) == first  # now from the cache


@pytest.mark.parametrize(("thickness", "error"), [(0.5, 1e-6), (1 / 1.5, 1e-6), (1.0, 1e-6), (2.0, 3e-6)])
def test_the_absorption_of_a_sample_is_a_polynomial_of_its_density(thickness: Any, error: Any) -> None:
    density = np.linspace(0.002, 1, 1000)
    polynomial = np.polynomial.Polynomial([float(c) for c in absorption(thickness)])
    assert density * polynomial(2 * density - 1) == pytest.approx(-np.expm1(-thickness * density), rel=error)
