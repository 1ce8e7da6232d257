"""The surface renderer: what it must show by hand, and the compiled path against its readable twin.

The compiled path leaves out what lies more than 6 softness lengths above the surface and stops at a transmittance of
1e-3. The first hides an optical depth of ln(1 + e^-6) = 2.5e-3, the second a share of 1e-3 of what is behind: 4e-3 in
all at most. Tables and float32 add about 1e-4.
"""

from typing import Any

import numpy as np
import pytest
import torch
from scipy.ndimage import gaussian_filter

from sattools.render import ParallelRays, Quadrature, render
from sattools.render.reference import render_planes

TRUNCATION = 4e-3


def vertical(z_ref: Any = 0.0) -> Any:
    return ParallelRays((0.0, 0.0), z_ref)


def town(seed: Any = 0, shape: Any = (40, 48)) -> Any:
    """Rolling ground with two blocks, [H, W] in metres, and a colour [H, W, 3] in [0, 1]."""
    rng = np.random.default_rng(seed)
    height = gaussian_filter(rng.normal(size=shape), 4) * 8
    height[8:20, 10:24] = 9.0
    height[24:34, 30:36] = 17.0
    colour = rng.uniform(0.1, 0.9, (*shape, 3))
    return torch.from_numpy(height).float(), torch.from_numpy(colour).float()


@pytest.mark.parametrize("softness", [0.3, 1.0, 4.0])
def test_a_vertical_ray_is_half_gone_at_the_surface_for_every_softness(softness: Any) -> None:
    step = softness / 200
    height = torch.full((2, 2), 7.3, dtype=torch.float64)
    # samples in the middle of their steps, the last one half a step above the surface
    q = Quadrature(softness, step, 7.3 + step / 2 + 4000 * step, 7.3)
    _, _, opacity = render_planes(height, torch.zeros(2, 2, 1, dtype=torch.float64), vertical(), q, 1.0)
    # 2e-9 is above the first sample; the midpoint rule is off by step^2/24 = 1e-6
    assert opacity.numpy() == pytest.approx(0.5, abs=2e-6)


@pytest.mark.parametrize("softness", [0.3, 1.0, 4.0])
@pytest.mark.parametrize("slope", [(0.0, 0.0), (0.4, -0.25)])
def test_the_mean_depth_of_a_flat_surface_is_its_height(softness: Any, slope: Any) -> None:
    """The weights are logistic around h, whose mean is h; oblique rays too, as density counts per metre of height."""
    step = softness / 20
    height = torch.full((12, 12), 3.0, dtype=torch.float64)
    q = Quadrature(softness, step, 3 + 30 * softness + step / 2, 3 - 40 * softness)
    _, depth, opacity = render_planes(
        height, torch.ones(12, 12, 1, dtype=torch.float64), ParallelRays(slope, 0.0), q, 1.0
    )
    assert opacity.numpy() == pytest.approx(1.0, abs=1e-9)
    # the rectangle rule places a step's weight at its middle: second order in the step
    assert depth.numpy() == pytest.approx(3.0, abs=1e-3 * softness)


def test_a_view_shows_the_roof_displaced_along_the_line_of_sight() -> None:
    """A roof 10 m above the reference plane, seen along 0.5 m east per metre of height: 5 m west of where it stands."""
    height = torch.zeros(30, 60)
    height[10:20, 30:40] = 10.0
    colour = torch.zeros(30, 60, 1)
    colour[10:20, 30:40] = 1.0
    rgb, _, _ = render(height, colour, ParallelRays((0.5, 0.0), 0.0), Quadrature(0.2, 0.1, 13.0, -3.0), 1.0)
    columns = rgb[15, :, 0].numpy()
    # a ray at column c reaches the roof's height at c + 5; east of the roof the wall facing the sensor is coloured too
    assert columns[26:34].min() > 0.95
    assert columns[:23].max() < 0.05
    assert columns[42:].max() < 0.05


def test_offset_moves_all_rays_east_and_north() -> None:
    height = torch.zeros(20, 20)
    colour = torch.zeros(20, 20, 1)
    colour[8, 12] = 1.0
    q = Quadrature(0.2, 0.1, 2.0, -3.0)
    rgb, _, _ = render(height, colour, ParallelRays((0.0, 0.0), 0.0, (4.0, 2.0)), q, 2.0)
    # 4 m east = 2 columns, 2 m north = 1 row up: the ray of (9, 10) meets cell (8, 12)
    assert tuple(np.unravel_index(int(rgb.argmax()), (20, 20))) == (9, 10)


CASES = [
    ((0.0, 0.0), (0.0, 0.0), 0.5, 1.0),
    ((0.35, -0.2), (0.0, 0.0), 0.5, 1.0),
    ((-0.6, 0.5), (0.37, -0.81), 1.5, 2.0),
    ((0.2, 0.45), (0.0, 0.25), 4.0, 4.0),
]


@pytest.mark.parametrize(("slope", "offset", "softness", "cell"), CASES)
def test_compiled_and_readable_renderer_show_the_same(slope: Any, offset: Any, softness: Any, cell: Any) -> None:
    height, colour = town()
    rays = ParallelRays(slope, 2.0, offset)
    q = Quadrature(softness, softness / 1.5, 17 + 6 * softness, -8 - 10 * softness)
    rgb, depth, opacity = render(height, colour, rays, q, cell)
    twin_rgb, twin_depth, twin_opacity = render_planes(height.double(), colour.double(), rays, q, cell)
    assert float((twin_opacity - opacity).max()) < TRUNCATION
    assert float((opacity - twin_opacity).max()) < 1e-4
    assert float((rgb - twin_rgb).abs().max()) < TRUNCATION
    # what is left out weighs TRUNCATION at most and lies within the sampled heights
    assert float((depth - twin_depth).abs().max()) < TRUNCATION * (q.z_top - q.z_bottom)


def gradients(function: Any, kind: Any, case: Any, loss: Any) -> Any:
    """Gradients of loss(rgb, depth, opacity) with respect to height and colour, as float64."""
    slope, offset, softness, cell = case
    height, colour = (t.to(kind, copy=True).requires_grad_() for t in town())
    q = Quadrature(softness, softness / 1.5, 17 + 6 * softness, -8 - 10 * softness)
    loss(*function(height, colour, ParallelRays(slope, 2.0, offset), q, cell)).backward()
    return height.grad.double(), None if colour.grad is None else colour.grad.double()


def likeness(a: Any, b: Any) -> Any:
    return float(torch.nn.functional.cosine_similarity(a.flatten(), b.flatten(), dim=0))


@pytest.mark.parametrize("case", CASES)
def test_compiled_gradients_are_those_of_the_readable_renderer(case: Any) -> None:
    weight = torch.randn(40, 48, 3, generator=torch.Generator().manual_seed(1))
    softness = case[2]
    # what is left out, a share of TRUNCATION, changes with the height by that share per softness; the rays that meet
    # a cell through its corners add up to about two
    share = 2 * TRUNCATION
    strongest = float(weight.abs().sum(-1).max())

    mine, twin = (
        gradients(f, kind, case, lambda rgb, depth, opacity: (rgb * weight).sum())
        for f, kind in ((render, torch.float32), (render_planes, torch.float64))
    )
    assert float((mine[0] - twin[0]).abs().max()) < share / softness * strongest
    assert float((mine[1] - twin[1]).abs().max()) < share * strongest
    assert likeness(mine[1], twin[1]) > 0.9999
    if case[0] != (0.0, 0.0):  # looking straight down, the colour does not depend on the height
        assert likeness(mine[0], twin[0]) > 0.999

    mine, twin = (
        gradients(f, kind, case, lambda rgb, depth, opacity: depth.sum() + 0 * rgb.sum())
        for f, kind in ((render, torch.float32), (render_planes, torch.float64))
    )
    assert likeness(mine[0], twin[0]) > 0.999
    assert float(mine[0].sum() / twin[0].sum()) == pytest.approx(1, abs=0.04)

    mine, twin = (
        gradients(f, kind, case, lambda rgb, depth, opacity: opacity.sum() + 0 * rgb.sum())
        for f, kind in ((render, torch.float32), (render_planes, torch.float64))
    )
    assert float((mine[0] - twin[0]).abs().max()) < share / softness


def test_gradients_of_the_readable_renderer_are_finite_differences() -> None:
    generator = torch.Generator().manual_seed(0)
    height = torch.rand(4, 5, generator=generator, dtype=torch.float64).requires_grad_()
    colour = torch.rand(4, 5, 2, generator=generator, dtype=torch.float64).requires_grad_()
    q = Quadrature(0.5, 0.25, 3.0, -3.0)
    rays = ParallelRays((0.3, -0.2), 0.1, (0.05, 0.0))
    assert torch.autograd.gradcheck(lambda h, c: render_planes(h, c, rays, q, 1.0), (height, colour))


def test_rays_that_are_not_wanted_cost_nothing_and_change_nothing() -> None:
    height, colour = town()
    q = Quadrature(0.5, 0.3, 20.0, -12.0)
    rays = ParallelRays((0.3, 0.1), 0.0)
    mask = torch.zeros(height.shape, dtype=torch.uint8)
    mask[5:30, 7:40] = 1
    h, c = height.clone().requires_grad_(), colour.clone().requires_grad_()
    rgb, depth, opacity = render(h, c, rays, q, 1.0, mask)
    everything, *_ = render(height, colour, rays, q, 1.0)
    assert torch.equal(rgb[mask == 1], everything[mask == 1])
    for picture in (rgb, depth, opacity):
        assert not picture[mask == 0].any()
    rgb.sum().backward()
    corner = c.grad[-4:, :2]  # nothing that is wanted looks here
    assert float(corner.abs().max()) == 0


def test_the_number_of_threads_does_not_change_the_picture() -> None:
    height, colour = town()
    q = Quadrature(0.5, 0.3, 20.0, -12.0)
    before = torch.get_num_threads()
    pictures = []
    try:
        for count in (1, 2):
            torch.set_num_threads(count)
            pictures.append(render(height, colour, ParallelRays((0.3, 0.1), 0.0), q, 1.0)[0])
    finally:
        torch.set_num_threads(before)
    assert torch.equal(*pictures)


@pytest.mark.parametrize(
    ("colour", "mask", "what"),
    [((9, 20, 3), (10, 20), "colour"), ((10, 20), (10, 20), "colour"), ((10, 20, 3), (10, 19), "mask")],
)
def test_maps_of_other_shapes_are_told(colour: Any, mask: Any, what: str) -> None:
    """Kernels would read beyond them."""
    maps = torch.zeros(10, 20), torch.zeros(colour)
    with pytest.raises(ValueError, match=f"{what}: found shape"):
        render(*maps, vertical(), Quadrature(0.5, 0.5, 5.0, -5.0), 1.0, torch.ones(mask, dtype=torch.uint8))
