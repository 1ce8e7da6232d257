"""The compiled blur against convolutions of torch, on maps smaller and larger than its reach."""

import pytest
import torch

from sattools.fit.materials.blur import blurred, plain_blurred


@pytest.mark.parametrize("shape", [(1, 1), (1, 9), (3, 4), (20, 31), (2, 15, 12), (2, 3, 9, 8)])
@pytest.mark.parametrize("sigma", [0.3, 2.0])
def test_values_and_gradients_are_those_of_the_convolution(shape: tuple[int, ...], sigma: float) -> None:
    torch.manual_seed(0)
    seed = torch.rand(shape, dtype=torch.float64)
    results = []
    for blur in (blurred, plain_blurred):
        maps = torch.rand(shape, dtype=torch.float64, generator=torch.Generator().manual_seed(1)).requires_grad_()
        value = blur(maps, sigma)
        value.backward(seed)
        results.append((value.detach(), maps.grad))
    for one, other in zip(*results, strict=True):
        torch.testing.assert_close(one, other, rtol=1e-12, atol=1e-12)


def test_gradcheck_and_constants_stay() -> None:
    maps = torch.rand(7, 9, dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(lambda m: blurred(m, 1.0), maps)
    flat = torch.full((6, 5), 3.0)
    torch.testing.assert_close(blurred(flat, 2.0), flat)
    assert blurred(flat, 2.0).dtype == torch.float32


def test_a_map_that_is_not_in_memorys_order() -> None:
    maps = torch.rand(9, 7).T
    torch.testing.assert_close(blurred(maps, 1.5), plain_blurred(maps, 1.5))
