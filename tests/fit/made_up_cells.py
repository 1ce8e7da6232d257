"""Cells of a known reflectance, as views see them."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import torch

from sattools.fit.materials.inversion import Samples, predict
from sattools.fit.materials.parameters import AMPLITUDE, Kind


def unit(v: Any) -> torch.Tensor:
    v = torch.as_tensor(v, dtype=torch.float64)
    return v / v.norm(dim=-1, keepdim=True)


def made_up(
    kind: Kind, endmembers: torch.Tensor, cells: int = 1500, plain: torch.Tensor | None = None
) -> tuple[Samples, torch.Tensor]:
    """Cells of random slope and amount, seven views of a fan, no noise; and the true unbounded amounts."""
    g = torch.Generator().manual_seed(0)
    normal = unit(torch.cat([0.35 * torch.randn(cells, 2, generator=g), torch.ones(cells, 1)], 1))
    abundances = torch.zeros(cells, len(endmembers), dtype=torch.float64)
    abundances[torch.arange(cells), torch.randint(len(endmembers), (cells,), generator=g)] = 1
    amplitude = AMPLITUDE[kind].raw(0.15 + 0.5 * torch.rand(cells, 3, generator=g, dtype=torch.float64))
    tilts = np.radians(np.linspace(-25, 25, 7))
    views = [unit((np.sin(t), 0.05, np.cos(t))) for t in tilts]
    suns = [unit((0.5, -0.4, 0.75))] * 7
    empty = torch.zeros(7, cells, 3, dtype=torch.float64)
    samples = Samples(normal, abundances, empty, torch.ones(7, cells, dtype=torch.float64), suns, views)
    seen = predict(kind, replace(samples, plain=plain), amplitude, endmembers)
    return replace(samples, seen=seen), amplitude
