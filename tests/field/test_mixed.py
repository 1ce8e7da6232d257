"""Of a network in bfloat16 only what layers hand on is rounded; where a point is stays exact."""

from typing import Any

import pytest
import torch
from torch import nn

from sattools.field import mlp
from sattools.field.mixed import mixed_linear
from sattools.field.mlp import W0, MlpField, positional_encoding
from sattools.field.networks import NETWORKS
from sattools.field.protocol import Box

# 512 m: in bfloat16, of 8 bits, places at its edges are 1 m apart
BOX = Box((0.0, -512.0, -20.0), (512.0, 0.0, 30.0))
SUN, EMBEDDING = torch.tensor([[0.0, 0.6, 0.8]]), torch.tensor([[0.1, -0.2, 0.3, 0.0]])


def network(name: Any, hidden: torch.dtype) -> MlpField:
    field = MlpField(NETWORKS[name], BOX, 3, width=64)
    field.hidden = hidden
    return field


def some_points(count: int = 400) -> torch.Tensor:
    shares = torch.rand(count, 3, generator=torch.Generator().manual_seed(3))
    return shares * torch.tensor([512.0, -512.0, 50.0]) - torch.tensor([0.0, 0.0, 20.0])


def a_layer() -> nn.Linear:
    layer = nn.Linear(2, 1)
    with torch.no_grad():
        layer.weight.copy_(torch.tensor([[1.0, 2.0]]))
        layer.bias.fill_(0.25)
    return layer


def test_what_is_float32_is_multiplied_exactly_beside_what_is_rounded() -> None:
    """1 + 2^-9 is no number of bfloat16, which has 8 bits; 2 * (1 + 2^-7) and 0.25 are."""
    fine, coarse = torch.tensor([[1 + 2**-9]]), torch.tensor([[1 + 2**-7]])
    mixed = mixed_linear(a_layer(), [fine, coarse.bfloat16()])
    assert mixed.dtype == torch.float32
    assert mixed.item() == (1 + 2**-9) + 2 * (1 + 2**-7) + 0.25
    exact = mixed_linear(a_layer(), [fine, fine])
    assert exact.item() == 3 * (1 + 2**-9) + 0.25
    rounded = mixed_linear(a_layer(), [torch.cat([fine, coarse], dim=1).bfloat16()])
    assert rounded.dtype == torch.bfloat16
    assert rounded.item() == pytest.approx(1 + 2 * (1 + 2**-7) + 0.25, rel=2**-8)


def test_weights_and_their_gradients_stay_float32() -> None:
    field = network("eonerf", torch.bfloat16)
    sigma, features = field.density(some_points(8))
    (sigma.sum() + features.sum()).backward()
    assert (sigma.dtype, features.dtype) == (torch.float32, torch.float32)
    for name, tensor in field.named_tensors().items():
        assert tensor.dtype == torch.float32, name
        assert tensor.grad is None or tensor.grad.dtype == torch.float32, name


@pytest.mark.parametrize("name", ["eonerf", "spsnerf"])
def test_without_being_asked_nothing_is_rounded(name: Any) -> None:
    """The network as the papers write it down, to the last bit."""
    field, points = MlpField(NETWORKS[name], BOX, 3, width=64), some_points(50)
    start = x = positional_encoding(BOX.scaled(points), NETWORKS[name].frequencies)
    for k, layer in enumerate(field.trunk):
        x = layer(torch.cat([start, x], dim=-1) if k == 4 else x)
        x = torch.sin(W0 * x if k == 0 else x) if NETWORKS[name].siren else torch.relu(x)
    sigma, features = field.density(points)
    assert torch.equal(sigma, torch.nn.functional.softplus(field.sigma(x)[..., 0]) * field.per_metre)
    assert torch.equal(features, x if field.bottleneck is None else field.bottleneck(x))
    first, last = field.head_layers["albedo"]
    hidden = torch.sin(first(features)) if NETWORKS[name].siren else torch.relu(first(features))
    assert torch.equal(field.look(features, None, None)["albedo"], torch.sigmoid(last(hidden)))


def off(found: torch.Tensor, exact: torch.Tensor) -> float:
    """Root mean square difference, as a share of how much the exact values vary from place to place."""
    return float((found - exact).square().mean().sqrt() / exact.std())


@pytest.mark.parametrize("name", list(NETWORKS))
def test_what_comes_from_outside_is_exact_and_what_layers_hand_on_is_bfloat16(
    name: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Where a point is, the sun and the image, to the last bit and wherever they come in; last layers are float32."""
    field, points = network(name, torch.bfloat16), some_points(20)
    read: dict[nn.Linear, list[torch.Tensor]] = {}
    last: dict[nn.Linear, torch.Tensor] = {}

    def watched(layer: nn.Linear, parts: list[torch.Tensor]) -> torch.Tensor:
        read[layer] = parts
        return mixed_linear(layer, parts)

    monkeypatch.setattr(mlp, "mixed_linear", watched)
    ends = [field.sigma, *(layers[-1] for layers in field.head_layers.values())]
    for layer in ends:
        layer.register_forward_hook(lambda layer, given, answer: last.update({layer: given[0]}))
    sun, embedding = SUN.expand(20, 3), EMBEDDING.expand(20, 4)
    field.look(field.density(points)[1], sun, embedding)
    place = positional_encoding(BOX.scaled(points), NETWORKS[name].frequencies)
    expected: dict[nn.Linear, list[Any]] = {layer: [None] for layer in field.trunk}  # None: of bfloat16
    expected |= {field.trunk[0]: [place], field.trunk[4]: [place, None]}
    expected |= {field.bottleneck: [None]} if field.bottleneck is not None else {}
    outside = {"features": None, "sun": sun, "embedding": embedding}
    for head, layers in field.head_layers.items():
        expected |= {layer: [None] for layer in layers[:-1]}
        expected[layers[0]] = [outside[name] for name in NETWORKS[name].heads[head].inputs]
    assert read.keys() == expected.keys()
    for layer, parts in read.items():
        for part, exact in zip(parts, expected[layer], strict=True):
            assert part.dtype == torch.bfloat16 if exact is None else torch.equal(part, exact)
    assert last.keys() == set(ends)
    assert {part.dtype for part in last.values()} == {torch.float32}


def test_rounding_what_layers_hand_on_does_little_and_rounding_where_a_point_is_does_much() -> None:
    """Of a new `eonerf`, whose density is of the point alone.

    Eight layers that round to 2^-9 leave a few hundredths of what the density varies by. A place that is rounded to 1 m
    turns the finest octave of the encoding, whose waves are 1 m long here, at random.
    """
    exact, mixed, points = network("eonerf", torch.float32), network("eonerf", torch.bfloat16), some_points()
    with torch.no_grad():
        sigma, rounded = exact.density(points)[0], mixed.density(points)[0]
        coarse = BOX.scaled(points).bfloat16().float()
        low, high = torch.tensor(BOX.low), torch.tensor(BOX.high)
        moved = exact.density((coarse + 1) / 2 * (high - low) + low)[0]
    assert 1e-4 < off(rounded, sigma) < 0.03
    assert off(moved, sigma) > 0.3


@pytest.mark.parametrize("name", list(NETWORKS))
def test_every_head_answers_nearly_what_it_does_in_float32(name: Any) -> None:
    """Within 0.02 of its range: heads have up to five layers more, of 2^-9 each."""
    exact, mixed, points = network(name, torch.float32), network(name, torch.bfloat16), some_points(50)
    given = SUN.expand(50, 3), EMBEDDING.expand(50, 4)
    with torch.no_grad():
        one, other = (field.look(field.density(points)[1], *given) for field in (exact, mixed))
    assert one.keys() == other.keys() == exact.heads
    assert any(not torch.equal(one[head], other[head]) for head in one)
    for head, value in one.items():
        wide = {"theta": 60.0 if name == "hapke" else 2.0, "k": 2.0}.get(head, 1.0)
        assert float((other[head] - value).abs().max()) < 0.02 * wide, head
        assert other[head].dtype == torch.float32
