"""The kernel for cells of many bands against the readable model times the cosine of incidence."""

import pytest
import torch

from sattools.reflectance import hapke
from sattools.reflectance.hapke_bands import hapke_light, hapke_slopes

SUN = torch.tensor([0.5, 0.3, 0.812403840463596], dtype=torch.float64)
VIEWS = ([0.0, 0.0, 1.0], [-0.4, 0.2, 0.894427190999916], [0.5, 0.3, 0.812403840463596])


def cells(count: int, bands: int, dtype: torch.dtype = torch.float64) -> list[torch.Tensor]:
    torch.manual_seed(count)
    normal = torch.randn(count, 3, dtype=torch.float64) * 0.6 + torch.tensor([0.0, 0.0, 1.0])
    normal /= normal.norm(dim=-1, keepdim=True)
    ranges = ((0.02, 0.9), (0.0, 1.0), (0.2, 50.0))
    shape = [low + (high - low) * torch.rand(count, dtype=torch.float64) for low, high in ranges]
    w = 0.01 + 0.97 * torch.rand(count, bands, dtype=torch.float64)
    return [x.to(dtype) for x in (normal, *shape, w)]


def plain(*operands: torch.Tensor) -> torch.Tensor:
    normal, b, c, theta, w, sun, view = operands
    model = hapke(normal[:, None, :], sun, view, w, b[:, None], c[:, None], theta[:, None])
    return model * (normal @ sun).clamp_min(0)[:, None]


@pytest.mark.parametrize("view", VIEWS)
@pytest.mark.parametrize(("count", "bands"), [(1, 1), (127, 3), (300, 8)])
def test_values_and_gradients_are_those_of_the_readable_model(count: int, bands: int, view: list[float]) -> None:
    towards = torch.tensor(view, dtype=torch.float64)
    towards = towards / towards.norm()
    found: list[torch.Tensor] = []
    expected: list[torch.Tensor] = []
    seed = torch.rand(count, bands, dtype=torch.float64)
    for results, model in ((found, None), (expected, plain)):
        operands = [x.requires_grad_() for x in cells(count, bands)]
        normal, b, c, theta, w = operands
        value = model(*operands, SUN, towards) if model else hapke_light(normal, SUN, towards, w, (b, c, theta))
        value.backward(seed)
        results += [value.detach(), *(x.grad for x in operands)]
    for one, other in zip(found, expected, strict=True):
        torch.testing.assert_close(one, other, rtol=1e-9, atol=1e-9)


def test_gradcheck_away_from_the_kinks() -> None:
    torch.manual_seed(0)
    normal, b, c, theta, w = cells(6, 3)
    normal = (normal + torch.tensor([0.0, 0.0, 2.0])).requires_grad_()
    view = torch.tensor([-0.3, 0.1, 0.948683298050514], dtype=torch.float64)
    others = [x.clamp(0.1, 0.9).requires_grad_() for x in (b, c)]
    theta, w = theta.clamp(2, 45).requires_grad_(), w.clamp(0.05, 0.9).requires_grad_()

    def unit(n: torch.Tensor, p: torch.Tensor, q: torch.Tensor, t: torch.Tensor, a: torch.Tensor) -> torch.Tensor:
        return hapke_light(n / n.norm(dim=-1, keepdim=True), SUN, view, a, (p, q, t))

    assert torch.autograd.gradcheck(unit, (normal, *others, theta, w), eps=1e-6, atol=1e-6, rtol=1e-5)


def test_slopes_are_the_gradients_of_every_band() -> None:
    normal, b, c, theta, w = cells(200, 3)
    view = torch.tensor([-0.3, 0.1, 0.948683298050514], dtype=torch.float64)
    value, slopes = hapke_slopes(normal, SUN, view, w, (b, c, theta))
    alone = hapke_slopes(normal, SUN, view, w, (b, c, theta), shapes=False)
    assert alone[0].equal(value)
    assert alone[1].equal(slopes[..., :1])
    operands = [x.requires_grad_() for x in (w, b, c, theta)]
    again = plain(normal, b, c, theta, w, SUN, view)
    torch.testing.assert_close(value, again.detach(), rtol=1e-9, atol=1e-9)
    for band in range(3):
        (gw, *others) = torch.autograd.grad(again[:, band].sum(), operands, retain_graph=True)
        torch.testing.assert_close(slopes[:, band, 0], gw[:, band], rtol=1e-9, atol=1e-9)
        for k, gradient in enumerate(others):
            torch.testing.assert_close(slopes[:, band, 1 + k], gradient, rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_singular_angles_and_limits_are_finite(dtype: torch.dtype) -> None:
    up = torch.tensor([0.0, 0.0, 1.0], dtype=dtype)
    level = torch.tensor([1.0, 0.0, 0.0], dtype=dtype)
    slant = torch.tensor([0.6, 0.0, 0.8], dtype=dtype)
    normals = torch.stack([up, level, -up, slant, -level])
    for sun, view in [(up, up), (level, up), (up, level), (level, level), (level, -level), (slant, slant)]:
        for w, b, c, theta in [(0.0, 0.0, 0.0, 0.0), (1.0, 1.0, 1.0, 60.0), (0.5, 0.9, 0.5, 1e-4)]:
            operands = [normals.clone(), *(torch.full((5,), x, dtype=dtype) for x in (b, c, theta))]
            operands = [x.requires_grad_() for x in (*operands, torch.full((5, 2), w, dtype=dtype))]
            value = hapke_light(operands[0], sun, view, operands[4], (operands[1], operands[2], operands[3]))
            value.sum().backward()
            assert value.isfinite().all()
            assert (value >= 0).all()
            assert all(x.grad.isfinite().all() for x in operands)
            assert (value[normals @ sun < 0] == 0).all()


def test_single_precision_in_and_out_costs_rounding_only() -> None:
    normal, b, c, theta, w = cells(500, 3)
    view = torch.tensor([-0.3, 0.1, 0.948683298050514], dtype=torch.float64)
    exact = hapke_light(normal, SUN, view, w, (b, c, theta))
    single = [x.float() for x in (normal, w, b, c, theta)]
    rounded = hapke_light(single[0], SUN.float(), view.float(), single[1], (single[2], single[3], single[4]))
    assert rounded.dtype == torch.float32
    torch.testing.assert_close(rounded.double(), exact, rtol=2e-4, atol=1e-6)
