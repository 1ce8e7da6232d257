"""Layers of which a part is multiplied in bfloat16: what one layer hands on to the next."""

from __future__ import annotations

import torch
from torch import Tensor, nn
from torch.nn.functional import linear


def mixed_linear(layer: nn.Linear, parts: list[Tensor]) -> Tensor:
    """What a layer makes of its inputs ``[N, I]`` together, in their order: ``[N, outputs]``.

    Inputs of bfloat16 are multiplied by weights that are rounded to it (Micikevicius et al. 2018, "Mixed precision
    training"; Kalamkar et al. 2019, "A study of bfloat16 for deep learning training"). Inputs of float32 stay exact,
    whatever lies beside them: a coordinate that is rounded to 8 bits is metres off. Weights and their gradients are of
    float32.

    Args:
        layer: whose weights are of float32.
        parts: unitless, of float32 or bfloat16 each.

    Returns:
        bfloat16 where all inputs are, else float32.
    """
    if all(part.dtype == torch.float32 for part in parts):
        return layer(parts[0] if len(parts) == 1 else torch.cat(parts, dim=-1))
    if len(parts) == 1:
        return linear(parts[0], layer.weight.bfloat16(), layer.bias.bfloat16())
    total: Tensor = layer.bias
    for part, weight in zip(parts, layer.weight.split([part.shape[-1] for part in parts], dim=1), strict=True):
        total = total + linear(part, weight.to(part.dtype)).float()
    return total


__all__ = ["mixed_linear"]
