"""The networks have the papers' shapes, sizes and initial weights."""

import math
from typing import Any

import pytest
import torch

from sattools.field.mlp import MlpField, positional_encoding
from sattools.field.networks import NETWORKS
from sattools.field.protocol import Box
from sattools.field.voxel import VoxelField

BOX = Box((0.0, -100.0, -20.0), (100.0, 0.0, 30.0))


def field(name: Any, **more: Any) -> Any:
    return MlpField(NETWORKS[name], BOX, **more)


def shapes(found: Any, start: Any) -> Any:
    return [
        tuple(t.shape) for n, t in found.named_tensors().items() if n.startswith(start + ".") and n.endswith("weight")
    ]


def test_sat_nerf_is_eight_layers_of_512_with_the_coordinates_again_at_the_fifth() -> None:
    net = field("satnerf")
    assert shapes(net, "trunk") == [(512, 3), *[(512, 512)] * 3, (512, 515), *[(512, 512)] * 3]
    assert shapes(net, "sigma") == [(1, 512)]
    assert shapes(net, "albedo") == [(256, 512), (3, 256)]
    assert shapes(net, "sun") == [(256, 515), (256, 256), (256, 256), (1, 256)]
    assert shapes(net, "sky") == [(256, 3), (3, 256)]
    assert shapes(net, "beta") == [(256, 516), (1, 256)]
    # weights and biases: trunk, density, bottleneck, colour, sun, sky, beta
    trunk = 3 * 512 + 6 * 512 * 512 + 515 * 512 + 8 * 512
    heads = (512 + 1) + (512 * 512 + 512) + (512 * 256 + 256 + 256 * 3 + 3)
    heads += (515 * 256 + 256 + 2 * (256 * 256 + 256) + 256 + 1) + (3 * 256 + 256 + 256 * 3 + 3)
    heads += 516 * 256 + 256 + 256 + 1
    assert sum(t.numel() for t in net.named_tensors().values()) == trunk + heads == 2_635_785


def test_eo_nerf_is_eight_layers_of_256_on_a_positional_encoding_of_ten_octaves() -> None:
    net = field("eonerf")
    assert shapes(net, "trunk") == [(256, 63), *[(256, 256)] * 3, (256, 319), *[(256, 256)] * 3]
    assert shapes(net, "albedo") == [(128, 256), (3, 128)]
    assert shapes(net, "ambient") == [(128, 3), (3, 128)]
    assert shapes(net, "transient") == [(128, 260), *[(128, 128)] * 3, (2, 128)]  # tau and beta
    # trunk 493056, density 257, albedo 33283, ambient 899, transient 83202
    assert sum(t.numel() for t in net.named_tensors().values()) == 610_697
    learned = field("eonerf-learned-shadow")
    assert shapes(learned, "sun") == [(128, 259), (128, 128), (128, 128), (1, 128)]
    assert learned.heads - net.heads == {"sun"}


@pytest.mark.parametrize(("name", "heads"), [("hapke", "albedo b c theta"), ("rpv", "albedo k theta rhoc")])
def test_reflectance_networks_have_a_small_head_of_256_per_parameter(name: Any, heads: Any) -> None:
    net = field(name)
    assert net.heads == set(heads.split())
    for head in heads.split()[1:]:
        assert shapes(net, head) == [(256, 512), (1, 256)]


def test_initial_weights_of_sine_layers() -> None:
    """Uniform: within 1 / n in the first layer, sqrt(6 / n) in the others (standard deviation: bound / sqrt 3)."""
    weights = field("satnerf").named_tensors()
    for name, bound in (("trunk.0", 1 / 3), ("trunk.1", math.sqrt(6 / 512)), ("trunk.4", math.sqrt(6 / 515))):
        weight = weights[f"{name}.weight"].detach()
        assert float(weight.abs().max()) <= bound
        assert float(weight.std()) == pytest.approx(bound / math.sqrt(3), rel=0.05)


def test_initial_weights_of_relu_layers() -> None:
    """torch's own, which the papers use: uniform within 1 / sqrt(n)."""
    weights = field("eonerf").named_tensors()
    for name, inputs in (("trunk.0", 63), ("trunk.1", 256), ("trunk.4", 319)):
        weight = weights[f"{name}.weight"].detach()
        assert float(weight.abs().max()) <= inputs**-0.5
        assert float(weight.std()) == pytest.approx(inputs**-0.5 / math.sqrt(3), rel=0.05)


def test_activations_keep_their_scale_through_a_sine_network() -> None:
    """What the initial weights are for (Sitzmann et al. 2020, theorem 1.8): every layer's output is sin(N(0, 1))."""
    net = field("satnerf")
    points = torch.rand(500, 3, generator=torch.Generator().manual_seed(0)) * 50 - torch.tensor([0.0, 50.0, 20.0])
    start = BOX.scaled(points)
    x = start
    for k, layer in enumerate(net.trunk):
        x = torch.sin((30 if k == 0 else 1) * layer(torch.cat([start, x], -1) if k == 4 else x))
        assert float(x.detach().std()) == pytest.approx(math.sqrt(0.5), abs=0.12)


def test_same_seed_same_network() -> None:
    one, same, other = (field("eonerf", width=16, seed=seed).named_tensors() for seed in (1, 1, 2))
    assert torch.equal(one["trunk.2.weight"], same["trunk.2.weight"])
    assert not torch.equal(one["trunk.2.weight"], other["trunk.2.weight"])


def test_encoding_and_box() -> None:
    assert BOX.scaled(torch.tensor([[100.0, -100.0, 5.0]])).tolist() == [[1.0, -1.0, 0.0]]
    code = positional_encoding(torch.tensor([[0.5, 0.0, 0.0]]), 2)
    assert code.shape == (1, 15)
    # sin(pi / 2), sin(pi), then cos of the same
    assert code[0, [3, 4, 9, 10]].tolist() == pytest.approx([1.0, 0.0, 0.0, -1.0], abs=1e-6)


@pytest.mark.parametrize("name", list(NETWORKS))
def test_answers_lie_in_their_ranges(name: Any) -> None:
    net = field(name, width=32)
    points = torch.rand(50, 3) * 100 - torch.tensor([0.0, 100.0, 20.0])
    sigma, features = net.density(points)
    assert float(sigma.detach().min()) > 0
    sun, embedding = torch.tensor([[0.0, 0.6, 0.8]]).expand(50, 3), torch.zeros(50, 4)
    look = net.look(features, sun, embedding)
    assert set(look) == net.heads
    limits = {"ambient": 0.2, "k": 2.0, "theta": 60.0 if name == "hapke" else 1.0, "beta": math.inf}
    for head, value in look.items():
        assert value.shape == (50, 3 if head in ("albedo", "sky", "ambient") else 1)
        assert float(value.detach().min()) >= (-1 if (name, head) == ("rpv", "theta") else 0)
        assert float(value.detach().max()) <= limits.get(head, 1.0)
    # without sun and embedding the heads that need them are silent
    assert "albedo" in net.look(features, None, None)
    assert not {"sun", "sky", "ambient", "tau", "beta"} & set(net.look(features, None, None))


def test_a_voxel_field_starts_as_a_surface() -> None:
    surface = torch.zeros(11, 11)
    surface[:, 6:] = 10.0
    voxel = VoxelField(BOX, (51, 11, 11), surface, torch.full((11, 11, 3), 0.3))
    # density in 1 / m is half of 1 / softness at the surface, nothing above, everything below
    points = torch.tensor([[20.0, -50.0, 0.0], [80.0, -50.0, 10.0], [20.0, -50.0, 20.0], [80.0, -50.0, -10.0]])
    sigma, features = voxel.density(points)
    assert (sigma * voxel.softness).tolist() == pytest.approx([0.5, 0.5, 0.0, 1.0], abs=0.01)
    assert voxel.look(features, None, None)["albedo"].flatten().tolist() == pytest.approx([0.3] * 12, abs=1e-5)


def test_a_voxel_field_is_charged_for_fog_above_the_ground() -> None:
    surface = torch.zeros(11, 11)
    voxel = VoxelField(BOX, (51, 11, 11), surface, torch.full((11, 11, 3), 0.3))
    before = float(voxel.penalty())
    voxel.logits[40:43, 5, 5] = 2.0
    assert float(voxel.penalty()) > before
