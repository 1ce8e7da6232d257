"""Precision and finiteness of the reflectance models in float32, on random and on special geometries.

    python benchmarks/reflectance_stress.py [--samples 10000000]

Prints the distribution of the relative error against float64 (same rounded vectors and parameters) and counts values
and gradients that are not finite, among them all combinations of special angles and bounds. The exit status is 1 if
there are any.
"""

from __future__ import annotations

import argparse
import itertools
import math
import sys
from collections.abc import Callable

import torch
from torch import Tensor

from sattools.reflectance import hapke, rpv

CHUNK = 1_000_000
HAPKE = ((0.0, 0.99), (0.0, 0.99), (0.0, 1.0), (1e-4, 60.0))
RPV = ((0.0, 1.0), (0.0, 2.0), (-0.95, 0.95), (0.0, 1.0))
COSINES = (
    0.0,
    90.0,
    1e-6,
    1e-3,
    0.05,
    1.0,
    30.0,
    45.0,
    60.0,
    85.0,
    89.0,
    89.99,
    89.99999,
    90.00001,
    91.0,
    150.0,
    180.0,
)
AZIMUTHS = (0.0, 1e-6, 1e-3, 1.0, 90.0, 179.0, 179.999, 180.0)


def directions(incidence: Tensor, emission: Tensor, azimuth: Tensor, turn: bool) -> tuple[Tensor, Tensor, Tensor]:
    """Float64 unit vectors ``[N, 3]`` normal, sun, view from degrees ``[N]``; ``turn``: each turned at random."""
    i, e, a = (torch.deg2rad(angle.double()) for angle in (incidence, emission, azimuth))
    zero = torch.zeros_like(i)
    normal = torch.stack([zero, zero, zero + 1], -1)
    sun = torch.stack([i.sin(), zero, i.cos()], -1)
    view = torch.stack([e.sin() * a.cos(), e.sin() * a.sin(), e.cos()], -1)
    if not turn:
        return normal, sun, view
    q = torch.nn.functional.normalize(torch.randn(len(i), 4, dtype=torch.float64), dim=-1)
    w, x, y, z = q.unbind(-1)
    rotation = torch.stack(
        [
            *(1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)),
            *(2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)),
            *(2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)),
        ],
        -1,
    ).reshape(-1, 3, 3)
    return tuple(torch.einsum("nij,nj->ni", rotation, vector) for vector in (normal, sun, view))  # type: ignore[return-value]


def random_case(count: int, ranges: tuple, limit: float) -> list[Tensor]:
    """Float32 operands: angles uniform up to ``limit`` degrees, azimuths and parameters uniform in their ranges."""
    vectors = directions(torch.rand(count) * limit, torch.rand(count) * limit, torch.rand(count) * 360, True)
    return [v.float() for v in vectors] + [low + (high - low) * torch.rand(count) for low, high in ranges]


def special_cases(ranges: tuple) -> list[Tensor]:
    """Float32 operands: all combinations of special angles with the ends and the middle of every parameter's range."""
    steps = [(low, 0.5 * (low + high), high) for low, high in ranges]
    angles = torch.tensor(list(itertools.product(COSINES, COSINES, AZIMUTHS)), dtype=torch.float64)
    parameters = torch.tensor(list(itertools.product(*steps)))
    vectors = directions(*angles.unbind(-1), turn=False)
    # cos 90 degrees is 6e-17 in float64: make the horizon exact
    vectors = [torch.where(v.abs() < 1e-15, torch.zeros(()).double(), v).float() for v in vectors]
    count = len(parameters)
    rows = [v.repeat_interleave(count, 0) for v in vectors]
    return rows + [column.repeat(len(angles)) for column in parameters.unbind(-1)]


def errors(model: Callable[..., Tensor], operands: list[Tensor]) -> Tensor:
    """Relative error of float32 against float64 ``[N]``; 0 where both are the same (w = 0)."""
    exact = model(*[o.double() for o in operands])
    difference = (model(*operands).double() - exact).abs()
    return torch.where(difference == 0, difference, difference / exact.abs())


def not_finite(model: Callable[..., Tensor], operands: list[Tensor]) -> tuple[int, float, float]:
    """Number of values and gradients that are not finite, the largest value and the largest gradient."""
    leaves = [o.clone().requires_grad_() for o in operands]
    value = model(*leaves)
    grads = torch.autograd.grad(value, leaves, torch.ones_like(value))
    bad = sum(int((~torch.isfinite(x)).sum()) for x in (value, *grads))
    return bad, float(value.detach().abs().max()), max(float(g.abs().max()) for g in grads)


def opposition(*operands: Tensor) -> Tensor:
    """Hapke's model with a strong opposition effect."""
    return hapke(*operands, b0=1.0, h=0.05)


MODELS: dict[str, tuple[Callable[..., Tensor], tuple]] = {
    "hapke": (hapke, HAPKE),
    "hapke, opposition effect": (opposition, HAPKE),
    "rpv": (rpv, RPV),
}


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--samples", type=int, default=10_000_000)
    options = parser.parse_args()
    torch.manual_seed(0)
    failures = 0
    for name, (model, ranges) in MODELS.items():
        operands = random_case(CHUNK, ranges, 89.0)
        found = errors(model, operands)
        worst = int(found.argmax())
        quantiles = [float(found.kthvalue(max(1, math.ceil(q * len(found)))).values) for q in (0.5, 0.99, 0.999)]
        n, s, v = (o[worst].double() for o in operands[:3])
        angles = [math.degrees(math.acos(min(1.0, float(torch.dot(*d))))) for d in ((n, s), (n, v), (s, v))]
        print(f"{name}: relative error on {CHUNK} geometries to 89 degrees:")
        print(f"  median {quantiles[0]:.1e}, 99 % {quantiles[1]:.1e}, 99.9 % {quantiles[2]:.1e}, ", end="")
        print(f"worst {float(found[worst]):.1e} at i, e, g = " + ", ".join(f"{a:.2f}" for a in angles), end="")
        print(" degrees, parameters " + ", ".join(f"{float(o[worst]):.3f}" for o in operands[3:]))

        special = special_cases(ranges)
        counts = [not_finite(model, [o[k : k + CHUNK] for o in special]) for k in range(0, len(special[0]), CHUNK)]
        bad = sum(c[0] for c in counts)
        value, gradient = max(c[1] for c in counts), max(c[2] for c in counts)
        print(f"  {len(special[0])} special combinations: {bad} not finite, ", end="")
        print(f"largest value {value:.1e}, gradient {gradient:.1e}")
        failures += bad
        counts = [not_finite(model, random_case(CHUNK, ranges, 120.0)) for _ in range(max(1, options.samples // CHUNK))]
        bad = sum(c[0] for c in counts)
        print(f"  {CHUNK * len(counts)} random geometries to 120 degrees: {bad} not finite")
        failures += bad
    return int(failures > 0)


if __name__ == "__main__":
    sys.exit(main())
