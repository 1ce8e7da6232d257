"""The fast forms of Hapke and RPV against the printed equations and automatic differentiation."""

from typing import Any

import pytest
import torch

from sattools.reflectance import hapke, reference, rpv

HAPKE = [(0.05, 0.95), (0.05, 0.7), (0.0, 1.0), (5.0, 40.0), (0.1, 0.9), (0.05, 0.8)]
RPV = [(0.05, 0.9), (0.5, 1.4), (-0.5, 0.5), (0.1, 1.0)]


@pytest.mark.parametrize(("fast", "plain", "ranges"), [(hapke, reference.hapke, HAPKE), (rpv, reference.rpv, RPV)])
def test_values_and_gradients_are_those_of_automatic_differentiation(
    scattered: Any, fast: Any, plain: Any, ranges: Any
) -> None:
    operands = scattered(2000, ranges)
    # the twin knows no horizon: facets that face away are left to other tests
    lit = ((operands[0] * operands[1]).sum(-1) > 0.05) & ((operands[0] * operands[2]).sum(-1) > 0.05)
    operands = [o[lit] for o in operands]
    assert len(operands[0]) > 1000
    results = []
    for model in (fast, plain):
        parts = [o.clone().requires_grad_() for o in operands]
        value = model(*parts)
        value.sum().backward()
        # a gradient by a direction counts only across it: the twin's arc cosines know unit vectors alone
        across = [p.grad - (p.grad * o).sum(-1, keepdim=True) * o for p, o in zip(parts[:3], operands[:3], strict=True)]
        results.append([value.detach(), *across, *(p.grad for p in parts[3:])])
    for quick, slow in zip(*results, strict=True):
        torch.testing.assert_close(quick, slow, rtol=1e-6, atol=1e-7)
