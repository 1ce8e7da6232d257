"""Photometric losses of linear radiance."""

from typing import Any

import pytest
import torch

from sattools.fit.losses import photometric, raw_weight, tone

RAW = ["mse", "raw-gamma", "raw-log"]
ALL = [*RAW, "mse-gamma"]


def slope_at_the_truth(name: Any, truth: Any, noise: Any) -> Any:
    """Mean gradient of the loss where the prediction is right and the target noisy."""
    predicted = torch.full_like(noise, truth, requires_grad=True)
    photometric(name, predicted, truth + noise).sum().backward()
    return float(predicted.grad.mean())


@pytest.mark.parametrize("truth", [0.01, 0.2, 0.8])
@pytest.mark.parametrize("name", RAW)
def test_weighted_losses_have_their_minimum_at_the_mean_of_noisy_targets(name: Any, truth: Any) -> None:
    half = 0.3 * truth * torch.rand(2000, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    noise = torch.cat([half, -half])
    # in units of the gradient of a residual as large as the noise
    unit = abs(slope_at_the_truth(name, truth, noise.abs()))
    assert abs(slope_at_the_truth(name, truth, noise)) < 1e-9 * unit


def test_the_loss_of_tone_mapped_values_has_not() -> None:
    """The reason for the weighted losses: here the bright half of the noise counts less than the dark half."""
    half = 0.06 * torch.rand(2000, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    noise = torch.cat([half, -half])
    unit = abs(slope_at_the_truth("mse-gamma", 0.2, noise.abs()))
    assert slope_at_the_truth("mse-gamma", 0.2, noise) > 0.01 * unit


@pytest.mark.parametrize("value", [0.05, 0.4])
def test_raw_gamma_acts_as_the_tone_mapped_loss_on_small_residuals(value: Any) -> None:
    found = []
    for name in ("raw-gamma", "mse-gamma"):
        p = torch.tensor([value], dtype=torch.float64, requires_grad=True)
        photometric(name, p, p.detach() - 1e-6).sum().backward()
        found.append(float(p.grad))
    assert found[0] == pytest.approx(found[1], rel=1e-4)


def test_weights_are_squared_slopes_of_the_tone_curves() -> None:
    x = torch.tensor([0.25], dtype=torch.float64)
    # (0.25^(1/2.2 - 1) / 2.2)^2 and 1 / 0.25^2
    assert float(raw_weight("raw-gamma", x)) == pytest.approx(0.93745, abs=1e-5)
    assert float(raw_weight("raw-log", x)) == pytest.approx(16.0, rel=1e-5)
    assert float(raw_weight("mse", x)) == 1


@pytest.mark.parametrize("value", [1e-3, 1e-6, 0.0, -1e-3, -1.0])
def test_weights_are_bounded_where_a_prediction_is_dark_or_negative(value: Any) -> None:
    x = torch.tensor([value])
    assert float(raw_weight("raw-gamma", x)) == pytest.approx(387, abs=1)
    assert float(raw_weight("raw-log", x)) == pytest.approx(1e6, rel=0.01)


@pytest.mark.parametrize("robust", [0.0, 0.1])
@pytest.mark.parametrize("name", ALL)
def test_gradients_are_finite_everywhere(name: Any, robust: Any) -> None:
    values = [-1.0, -1e-3, 0.0, 1e-9, 1e-3, 0.5, 1.0, 3.0]
    predicted, target = torch.meshgrid(torch.tensor(values), torch.tensor(values), indexing="ij")
    p = predicted.clone().requires_grad_()
    loss = photometric(name, p, target, robust)
    loss.sum().backward()
    assert torch.isfinite(loss).all()
    assert torch.isfinite(p.grad).all()
    # a descent step goes towards the target, also from below zero
    assert bool((p.grad * (predicted - target) >= 0).all())


def test_the_tone_curve_is_continued_as_a_line() -> None:
    x = torch.tensor([0.0, 0.999e-3, 1e-3, 1.001e-3, 0.5, 1.0], dtype=torch.float64)
    y = tone(x)
    assert bool((y.diff() > 0).all())
    assert float(y[3] - y[1]) == pytest.approx(2e-6 * 19.66, rel=1e-2)  # slope (1e-3)^(1/2.2 - 1) / 2.2
    assert y[4:].tolist() == pytest.approx([0.5 ** (1 / 2.2), 1.0])


def test_residuals_beyond_the_robust_scale_lose_their_say() -> None:
    target = torch.zeros(1, dtype=torch.float64)
    pulls = []
    for residual in (0.001, 0.1, 1.0):
        p = torch.tensor([residual], dtype=torch.float64, requires_grad=True)
        photometric("mse", p, target, robust=0.1).sum().backward()
        pulls.append(float(p.grad) / (2 * residual))
    # (k^2 / (k^2 + r^2))^2 at r = k / 100, k and 10 k
    assert pulls == pytest.approx([0.9998, 0.25, 9.803e-5], rel=1e-4)


def test_an_unknown_loss_is_refused() -> None:
    with pytest.raises(ValueError, match="expected mse, mse-gamma, raw-gamma or raw-log"):
        photometric("l1", torch.zeros(1), torch.zeros(1))
