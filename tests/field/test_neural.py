"""Columns that choose between heights: where they start, what their gradients are, and that a roof's rim can go."""

from typing import Any

import pytest
import torch

from sattools.field import neural
from sattools.field.neural import NeuralField, columns
from sattools.field.protocol import Box
from sattools.field.surface_base import SurfaceBase
from sattools.render.volume import RayBatch, composite, median_share, stratified

BOX = Box((0.0, -12.0, -5.0), (12.0, 0.0, 25.0))
ROOF, GROUND = (0.8, 0.3, 0.1), (0.1, 0.3, 0.8)


def house(dtype: torch.dtype = torch.float32, cells: int = 24) -> SurfaceBase:
    """Ground at 0 m, a roof of 10 m over the eastern half, on cells that fill the box."""
    height = torch.zeros(cells, cells, dtype=dtype)
    height[:, cells // 2 :] = 10.0
    colour = torch.tensor(GROUND, dtype=dtype).expand(cells, cells, 3).clone()
    colour[:, cells // 2 :] = torch.tensor(ROOF, dtype=dtype)
    return SurfaceBase(BOX, height, colour, 0.5)


def seen_from_above(field: Any, x: Any, y: float) -> tuple[torch.Tensor, torch.Tensor]:
    """Median height and colour of vertical rays at eastings x and one northing [m]."""
    start = torch.stack([x, torch.full_like(x, y), torch.full_like(x, BOX.high[2])], dim=1)
    path = torch.tensor([0.0, 0.0, BOX.low[2] - BOX.high[2]]).expand_as(start)
    t = stratified(len(x), 600, None)
    sigma, features = field.density(RayBatch(start, path).points(t).reshape(-1, 3))
    weights, _ = composite(sigma.reshape(t.shape), t, path[:, 2].abs())
    albedo = field.look(features, None, None)["albedo"].reshape(*t.shape, -1)
    height = BOX.high[2] + median_share(weights, t) * (BOX.low[2] - BOX.high[2])
    return height, (weights[..., None] * albedo).sum(dim=1)


def test_a_column_beside_a_step_knows_both_sides_and_their_colours() -> None:
    base = house()
    heights, colours = columns(base.height, base.colour)
    wall = 12
    assert heights[:, 5, wall - neural.REACH].tolist() == [0, 0, 10]
    assert heights[:, 5, wall + neural.REACH - 1].tolist() == [0, 10, 10]
    assert heights[:, 5, wall - neural.REACH - 1].tolist() == [0, 0, 0]
    assert colours[2, 5, wall - 1].tolist() == pytest.approx(ROOF)
    assert colours[0, 5, wall].tolist() == pytest.approx(GROUND)


def test_a_lonely_peak_is_no_choice_for_its_neighbours_and_its_own_highest() -> None:
    base = house()
    base.height[3, 3] = 20.0
    heights, _ = columns(base.height, base.colour)
    assert heights[:, 3, 3].tolist() == [0, 20, 20]
    assert heights[2, 3, 4].tolist() == 0


def test_the_choices_do_not_depend_on_the_blocks_in_which_they_are_searched(monkeypatch: Any) -> None:
    height = torch.rand(20, 9, generator=torch.Generator().manual_seed(0))
    colour = torch.rand(20, 9, 3, generator=torch.Generator().manual_seed(1))
    whole = columns(height, colour)
    monkeypatch.setattr(neural, "BLOCK", 7)
    for one, other in zip(whole, columns(height, colour), strict=True):
        assert torch.equal(one, other)


def test_an_untrained_field_is_the_surface_it_starts_from() -> None:
    base = house()
    field = NeuralField(BOX, base)
    x = torch.arange(0.25, 12.0, 0.5)  # the middles of cells
    height, colour = seen_from_above(field, x, -5.25)
    # within a hundredth of the softness' metres: shares begin near 0 and 1, not there
    assert height.tolist() == pytest.approx([0.0] * 12 + [10.0] * 12, abs=0.03)
    assert colour[3].tolist() == pytest.approx(GROUND, abs=0.01)
    assert colour[20].tolist() == pytest.approx(ROOF, abs=0.01)


@pytest.mark.parametrize("name", ["presence", "colour", "grid.2"])
def test_gradients_are_those_of_finite_differences(name: Any) -> None:
    base = house(torch.float64, 4)
    field = NeuralField(BOX, base)
    random = torch.Generator().manual_seed(3)
    spread = torch.tensor([11.0, -11.0, 14.0], dtype=torch.float64)
    points = torch.rand(6, 3, generator=random, dtype=torch.float64) * spread
    field.presence += torch.randn(field.presence.shape, generator=random, dtype=torch.float64)
    tensor = field.named_tensors()[name]
    rows = torch.randperm(tensor.numel(), generator=random)[:24]
    if name.startswith("grid"):  # most of its cells are far from the points
        tensor.requires_grad_(True)
        field.look(field.density(points)[1], None, None)["albedo"].sum().backward()
        assert tensor.grad is not None
        rows = tensor.grad.flatten().abs().argsort(descending=True)[:24]
        tensor.requires_grad_(False)

    start = tensor.flatten()[rows].clone().requires_grad_(True)

    def shown(values: Any) -> Any:
        changed = tensor.flatten().scatter(0, rows, values).reshape(tensor.shape)
        if name.startswith("grid"):
            field.grids[int(name[-1])] = changed
        else:
            setattr(field, name, changed)
        sigma, features = field.density(points)
        return sigma, field.look(features, None, None)["albedo"], field.penalty()

    assert torch.autograd.gradcheck(shown, (start,))


def test_a_roofs_rim_that_no_image_shows_becomes_ground() -> None:
    """The images see ground one metre further than the prior's roof; its colours stay, so that only the rim can go."""
    field = NeuralField(BOX, house())
    x = torch.arange(4.25, 8.0, 0.5)
    truth = torch.where(x[:, None] < 7.0, torch.tensor(GROUND), torch.tensor(ROOF))
    field.presence.requires_grad_(True)
    adam = torch.optim.Adam([field.presence], lr=0.3, eps=neural.EPSILON)
    for _ in range(80):
        adam.zero_grad()
        ((seen_from_above(field, x, -5.25)[1] - truth) ** 2).mean().backward()
        adam.step()
    height, _ = seen_from_above(field, x.detach(), -5.25)
    assert height.tolist() == pytest.approx([0.0] * 6 + [10.0] * 2, abs=0.3)


def test_a_wall_has_colours_of_its_own() -> None:
    """Two places of one wall, one column but five metres apart, learn different colours."""
    field = NeuralField(BOX, house())
    points = torch.tensor([[6.0, -5.0, 2.0], [6.0, -5.0, 7.0]])
    wanted = torch.tensor([[0.9, 0.9, 0.9], [0.2, 0.2, 0.2]])
    for grid in field.grids:
        grid.requires_grad_(True)
    adam = torch.optim.Adam(field.grids, lr=0.05)
    for _ in range(100):
        adam.zero_grad()
        _, features = field.density(points)
        ((field.look(features, None, None)["albedo"] - wanted) ** 2).mean().backward()
        adam.step()
    _, features = field.density(points)
    assert torch.allclose(field.look(features, None, None)["albedo"], wanted, atol=0.05)


def test_what_the_images_do_not_ask_for_has_its_price() -> None:
    field = NeuralField(BOX, house())
    start = float(field.penalty())
    for part in (0, 1):
        kept = field.presence.clone()
        field.presence[part, 5, 11:13] *= -1
        assert float(field.penalty()) > start
        field.presence.copy_(kept)


def roof_with_noise(random: torch.Generator) -> NeuralField:
    field = NeuralField(BOX, house())
    for tensor in field.named_tensors().values():
        tensor += 0.5 * torch.randn(tensor.shape, generator=random)
        tensor.requires_grad_(True)
    return field


def test_the_kernels_are_their_twin_and_so_are_their_gradients() -> None:
    random = torch.Generator().manual_seed(5)
    field = roof_with_noise(random)
    # inside the box and around it
    points = torch.rand(400, 3, generator=random) * torch.tensor([14.0, -14.0, 34.0]) + torch.tensor([-1.0, 1.0, -7.0])
    weights = torch.rand(400, 4, generator=random)

    def answers(plain: bool) -> list[torch.Tensor]:
        if plain:
            sigma, parts = field.plain_density(field.presence + field.half, points)
            features = torch.cat([points, parts], dim=1)
            colour = field.plain_colours(features)
        else:
            sigma, features = field.density(points)
            colour = field.look(features, None, None)["albedo"]
        total = (weights[:, :3] * colour * (1 + sigma[:, None])).sum() + (weights[:, 3] * sigma).sum()
        return [sigma, features, colour, *torch.autograd.grad(total, list(field.named_tensors().values()))]

    for kernel, twin in zip(answers(False), answers(True), strict=True):
        assert torch.allclose(kernel, twin, atol=1e-4, rtol=1e-4)


def test_gradients_do_not_depend_on_the_number_of_threads() -> None:
    import numba

    random = torch.Generator().manual_seed(6)
    field = roof_with_noise(random)
    points = torch.rand(300, 3, generator=random) * torch.tensor([12.0, -12.0, 30.0]) + torch.tensor([0.0, 0.0, -5.0])
    before, found = numba.get_num_threads(), []
    try:
        for threads in (1, before):
            numba.set_num_threads(threads)
            sigma, features = field.density(points)
            colour = field.look(features, None, None)["albedo"]
            found.append(torch.autograd.grad((colour * sigma[:, None]).sum(), list(field.named_tensors().values())))
    finally:
        numba.set_num_threads(before)
    assert all(torch.equal(one, other) for one, other in zip(*found, strict=True))


def test_a_hidden_sample_is_not_asked_for_its_colour() -> None:
    field = NeuralField(BOX, house())
    points = torch.tensor([[3.0, -3.0, 0.0], [3.0, -3.0, -1.0], [3.0, -3.0, 20.0]])
    sigma, features = field.density(points)
    assert sigma[2] == 0  # nothing is that high
    features = field.shown(features, torch.tensor([0.6, 1e-5, 1.0]))
    colour = field.look(features, None, None)["albedo"]
    assert colour[0].tolist() == pytest.approx(GROUND, abs=0.01)
    assert colour[1:].tolist() == [[0, 0, 0], [0, 0, 0]]
