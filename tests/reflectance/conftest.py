"""Geometry shared by the tests of the reflectance models."""

import math
from collections.abc import Callable

import pytest
import torch
from torch import Tensor


def from_angles(incidence: float, emission: float, azimuth: float) -> tuple[Tensor, Tensor, Tensor]:
    """Normal, sun and view in float64 from degrees, in a frame whose axes are not the facet's."""
    i, e, a = (math.radians(x) for x in (incidence, emission, azimuth))
    frame = torch.linalg.qr(torch.tensor([[0.3, -0.5, 0.8], [0.7, 0.6, 0.2], [-0.4, 0.9, 0.5]], dtype=torch.float64)).Q
    normal = torch.tensor([0, 0, 1.0], dtype=torch.float64)
    sun = torch.tensor([math.sin(i), 0, math.cos(i)], dtype=torch.float64)
    view = torch.tensor([math.sin(e) * math.cos(a), math.sin(e) * math.sin(a), math.cos(e)], dtype=torch.float64)
    return frame @ normal, frame @ sun, frame @ view


@pytest.fixture(scope="session")
def directions() -> Callable[[float, float, float], tuple[Tensor, Tensor, Tensor]]:
    return from_angles


@pytest.fixture(scope="session")
def scattered() -> Callable[..., list[Tensor]]:
    """Random directions ``[N, 3]`` and parameters ``[N]`` in given ranges: (count, ranges, dtype) to operands."""

    def draw(count: int, ranges: list[tuple[float, float]], dtype: torch.dtype = torch.float64) -> list[Tensor]:
        generator = torch.Generator().manual_seed(3)

        def upper(spread: float) -> Tensor:
            vectors = torch.randn(count, 3, generator=generator, dtype=torch.float64) * spread
            vectors[:, 2] = vectors[:, 2].abs() + 0.5
            return torch.nn.functional.normalize(vectors, dim=-1)

        unit = [torch.rand(count, generator=generator, dtype=torch.float64) for _ in ranges]
        parameters = [low + (high - low) * u for (low, high), u in zip(ranges, unit)]
        return [x.to(dtype) for x in (upper(0.2), upper(0.8), upper(0.8), *parameters)]

    return draw
