"""Maps of one grid on another."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import interpolate

from sattools.scene import Grid


def resample_map(array: np.ndarray, source: Grid, target: Grid) -> Tensor:
    """A map ``[h, w]`` on another grid with the same upper left corner.

    It is averaged or bilinear; NaN spreads no further.

    Args:
        array: ``[h, w]``; NaN = unknown.
        source: its grid.
        target: grid to resample to.
    """
    factor = target.cell_size / source.cell_size
    tensor = torch.from_numpy(np.ascontiguousarray(array, dtype=np.float32))
    known = torch.isfinite(tensor).float()
    stack = torch.stack([torch.nan_to_num(tensor) * known, known])[None]
    size = (round(target.height * factor), round(target.width * factor))
    pad = (0, max(0, size[1] - source.width), 0, max(0, size[0] - source.height))
    stack = torch.nn.functional.pad(stack, pad, mode="replicate")[..., : size[0], : size[1]]
    if factor > 1:
        value, weight = interpolate(stack, size=target.shape, mode="area")[0]
    else:
        value, weight = interpolate(stack, size=target.shape, mode="bilinear", align_corners=False)[0]
    return torch.where(weight > 0.5, value / weight.clamp_min(1e-6), torch.nan)


__all__ = ["resample_map"]
