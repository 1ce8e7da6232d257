"""The compiled normals against operations of torch."""

import pytest
import torch

from sattools.fit.materials.normals import plain_surface_normals, surface_normals


@pytest.mark.parametrize("shape", [(1, 1), (1, 5), (2, 2), (3, 1), (3, 3), (12, 17)])
def test_values_and_gradients_are_those_of_the_plain_form(shape: tuple[int, int]) -> None:
    torch.manual_seed(0)
    seed = torch.rand(*shape, 3, dtype=torch.float64)
    results = []
    for normals in (surface_normals, plain_surface_normals):
        generator = torch.Generator().manual_seed(1)
        height = (5 * torch.rand(shape, dtype=torch.float64, generator=generator)).requires_grad_()
        value = normals(height, 0.7)
        value.backward(seed)
        results.append((value.detach(), height.grad))
    for one, other in zip(*results, strict=True):
        torch.testing.assert_close(one, other, rtol=1e-11, atol=1e-12)


def test_gradcheck_and_a_plane() -> None:
    height = torch.rand(4, 5, dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(lambda h: surface_normals(h, 2.0), height)
    plane = 0.5 * torch.arange(6.0)[None, :].expand(4, 6) - torch.arange(4.0)[:, None]  # rises to the east and north
    normal = torch.tensor([-0.5, -1.0, 1.0])
    torch.testing.assert_close(surface_normals(plane, 1.0), (normal / normal.norm()).expand(4, 6, 3))
