"""Derivatives that come with the values of the compiled model, against finite differences."""

import pytest
import torch

from sattools.fit.materials.inversion import Samples, differences, predict, start_endmembers, with_slope, with_slopes


def samples(sky: bool, plain: bool) -> Samples:
    torch.manual_seed(3)
    count, bands = 60, 3
    normal = torch.randn(count, 3, dtype=torch.float64) * 0.3 + torch.tensor([0.0, 0.0, 1.0])
    shares = torch.rand(count, 2, dtype=torch.float64)
    vectors = torch.tensor([[0.5, 0.3, 0.8], [-0.4, 0.1, 0.9], [0.1, -0.3, 0.95]], dtype=torch.float64)
    vectors = vectors / vectors.norm(dim=-1, keepdim=True)
    return Samples(
        normal / normal.norm(dim=-1, keepdim=True),
        shares / shares.sum(-1, keepdim=True),
        torch.rand(2, count, bands, dtype=torch.float64),
        torch.ones(2, count, dtype=torch.float64),
        [vectors[0], vectors[0]],
        [vectors[1], vectors[2]],
        0.5 + torch.rand(count, bands, dtype=torch.float64) if sky else None,
        torch.tensor([0.03, 0.04, 0.05], dtype=torch.float64) if sky else torch.zeros(0),
        plain=torch.tensor([0.0, 1.0], dtype=torch.float64) if plain else None,
    )


@pytest.mark.parametrize(("sky", "plain"), [(False, False), (True, False), (False, True), (True, True)])
def test_slopes_of_the_compiled_model_are_its_finite_differences(sky: bool, plain: bool) -> None:
    s = samples(sky, plain)
    amplitude = torch.randn(60, 3, dtype=torch.float64)
    endmembers = start_endmembers("hapke", 2, amplitude) + 0.3 * torch.randn(2, 3, dtype=torch.float64)
    here, slopes = with_slopes("hapke", s, amplitude, endmembers)
    again, expected = differences("hapke", s, amplitude, endmembers)
    torch.testing.assert_close(here, predict("hapke", s, amplitude, endmembers))
    torch.testing.assert_close(here, again)
    # differences of 1e-3 err by half of that times the curvature
    torch.testing.assert_close(slopes, expected, rtol=2e-3, atol=2e-4)
    value, slope = with_slope("hapke", s, amplitude, endmembers)
    torch.testing.assert_close(value, here)
    torch.testing.assert_close(slope, slopes[..., 0])
    assert (slopes.abs().amax((0, 1, 2)) > 1e-3).all()  # all four are there to compare
