"""A field as a network of points: the papers' own architectures."""

from __future__ import annotations

import math
from dataclasses import replace
from itertools import pairwise

import torch
from torch import Tensor, nn
from torch.nn.functional import relu, softplus

from sattools.field.mixed import mixed_linear
from sattools.field.networks import AGAIN, DEPTH, EMBEDDING, Head, Network
from sattools.field.protocol import Box
from sattools.field.surface_base import SurfaceBase, before_sigmoid, before_softplus

AMBIENT_HEADS = ("sky", "ambient")  # light in shade, by the sun
TAU_START = 4.0  # logit of what is let through where nothing is known to move: 0.98
SHAPES = ("b", "c", "k", "theta", "rhoc")  # heads for shape parameters of reflectance models
WIDE = 0.99  # end of the range of an amplitude that starts above the paper's
W0 = 30.0  # frequency of the first sine layer (Sitzmann et al. 2020, section 3.2)


def positional_encoding(x: Tensor, frequencies: int) -> Tensor:
    """Coordinates x in [-1, 1] with sin, cos of 2^k pi x: ``[N, 3 + 6 L]`` (Mildenhall et al. 2020, eq. 4)."""
    if frequencies == 0:
        return x
    angle = x[..., None] * (math.pi * 2.0 ** torch.arange(frequencies, dtype=x.dtype, device=x.device))
    return torch.cat([x, angle.sin().flatten(-2), angle.cos().flatten(-2)], dim=-1)


class MlpField:
    """A network over the box.

    Args:
        network: its description.
        box: the part of space.
        bands: colours of the images (the papers have 3).
        width: of the trunk instead of the paper's.
        seed: of the initial weights.
        base: a surface to start from: the network's answers for density, albedo and shape parameters are added to its
            own, and begin at 0.
    """

    def __init__(
        self,
        network: Network,
        box: Box,
        bands: int = 3,
        width: int | None = None,
        seed: int = 0,
        *,
        base: SurfaceBase | None = None,
    ) -> None:
        self.base, self.bands = base, bands
        self.network = replace(network, width=width or network.width)
        if base is not None and base.shape is not None and float(base.colour.max()) > network.heads["albedo"].high:
            # images of unknown scale have amplitudes above the paper's 0.8
            albedo = replace(network.heads["albedo"], high=WIDE)
            self.network = replace(self.network, heads={**network.heads, "albedo": albedo})
        self.box = box
        self.hidden = torch.float32  # type of what layers hand on to each other; see `sattools.field.mixed`
        self.heads = frozenset(network.heads) - {"transient"}
        if "transient" in network.heads:
            self.heads |= {"tau", "beta"}
        # the papers' rays are scaled to unit length; a box of this many metres has optical depth 1 at density 1
        self.per_metre = 2.0 / (box.high[2] - box.low[2])
        random = torch.Generator("cpu").manual_seed(seed)  # the same first weights on every device
        wide = self.network.width
        inputs = 3 + 6 * network.frequencies
        self.trunk = [
            self._layer(inputs if k == 0 else wide + (inputs if k == AGAIN else 0), wide, random, k == 0)
            for k in range(DEPTH)
        ]
        self.sigma = self._layer(wide, 1, random)
        self.bottleneck = self._layer(wide, wide, random) if network.bottleneck else None
        self.head_layers: dict[str, list[nn.Linear]] = {}
        for name, head in network.heads.items():
            sizes = [sum({"features": wide, "sun": 3, "embedding": EMBEDDING}[i] for i in head.inputs)]
            sizes += [int(share * wide) for share in head.hidden]
            sizes += [bands if head.outputs == 3 else head.outputs]
            self.head_layers[name] = [self._layer(a, b, random) for a, b in pairwise(sizes)]
        self.known: list[str] = []  # heads whose answers are added to what the base has
        if base is not None:
            shapes = [name for name in network.heads if name in SHAPES] if base.shape is not None else []
            self.known = ["albedo", *shapes]
            self.lit: list[str] = []  # and those that are added to the base's light
            if base.light is not None:
                self.lit = [name for name in network.heads if name in AMBIENT_HEADS]
                self.lit += ["sun"] if base.light.visible is not None and "sun" in network.heads else []
            with torch.no_grad():
                for layer in (self.sigma, *(self.head_layers[name][-1] for name in (*self.known, *self.lit))):
                    layer.weight.zero_()
                    layer.bias.zero_()
                if "transient" in self.head_layers and base.light is not None:
                    last = self.head_layers["transient"][-1]
                    last.weight[0].zero_()
                    last.bias[0] = TAU_START

    def _layer(self, inputs: int, outputs: int, random: torch.Generator, first: bool = False) -> nn.Linear:
        """First weights, of a SIREN or as torch has them.

        SIREN: uniform within sqrt(6 / n), 1 / n in the first layer (its frequency comes with the sine); else within 1 /
        sqrt(n).
        """
        layer = nn.Linear(inputs, outputs)
        bound = inputs**-0.5
        scale = bound
        if self.network.siren:
            scale = 1 / inputs if first else (6 / inputs) ** 0.5
        with torch.no_grad():
            layer.weight.copy_((2 * torch.rand(outputs, inputs, generator=random, device="cpu") - 1) * scale)
            layer.bias.copy_((2 * torch.rand(outputs, generator=random, device="cpu") - 1) * bound)
        return layer

    @torch.no_grad()
    def begin_beta(self, beta: float) -> None:
        """Let the head of the uncertainty, if there is one, answer this everywhere, in the images' unit."""
        name, row = ("transient", 1) if "transient" in self.head_layers else ("beta", 0)
        if name in self.head_layers:
            last = self.head_layers[name][-1]
            last.weight[row].zero_()
            last.bias[row] = before_softplus(torch.tensor(beta))

    def density(self, points: Tensor) -> tuple[Tensor, Tensor]:
        """See `Field.density` [1/m] at points [m]."""
        network = self.network
        start = positional_encoding(self.box.scaled(points), network.frequencies)
        x = start
        for k, layer in enumerate(self.trunk):
            x = mixed_linear(layer, [start, x] if k == AGAIN else [x])
            x = (torch.sin(W0 * x if k == 0 else x) if network.siren else relu(x)).to(self.hidden)
        raw = self.sigma(x.float())[..., 0]
        features = (mixed_linear(self.bottleneck, [x]) if self.bottleneck is not None else x).float()
        if self.base is not None:
            density, colour = self.base.at(points)
            raw = raw + before_softplus(density / self.per_metre)
            features = torch.cat([features, colour], dim=-1)
        return softplus(raw) * self.per_metre, features

    def at_rest(self, points: Tensor) -> Tensor:
        """Density ``[N]`` [1/m] at points ``[N, 3]`` [m] while the network adds nothing to that of its base."""
        assert self.base is not None
        return softplus(before_softplus(self.base.density(points) / self.per_metre)) * self.per_metre

    def rests(self) -> bool:
        """Whether it adds nothing to the density of its base."""
        return self.base is not None and not any(bool(t.any()) for t in self.sigma.parameters())

    def shown(self, features: Tensor, transmittance: Tensor) -> Tensor:
        """See `Field.shown`: all of them, whatever the share in [0, 1]."""
        return features

    def look(self, features: Tensor, sun: Tensor | None, embedding: Tensor | None) -> dict[str, Tensor]:
        """See `Field.look`: colours and visibility."""
        begun: dict[str, Tensor] = {}
        if self.base is not None:
            light = self.base.light
            suns = 0 if light is None or light.visible is None else len(light.suns)
            sizes = [self.bands] + [1] * (len(self.known) - 1) + [suns]
            features, *values, visible = features.split([features.shape[-1] - sum(sizes), *sizes], dim=-1)
            begun = dict(zip(self.known, values, strict=True))
            if light is not None and sun is not None:
                shares = light.shares(sun)
                begun |= dict.fromkeys((n for n in self.lit if n != "sun"), shares @ light.ambient)
                if "sun" in self.lit:
                    begun["sun"] = (shares * visible).sum(dim=-1, keepdim=True)
        given = {"features": features, "sun": sun, "embedding": embedding}
        outputs: dict[str, Tensor] = {}
        for name, head in self.network.heads.items():
            parts = [given[i] for i in head.inputs]
            if any(part is None for part in parts):
                continue
            if self.base is not None and "embedding" in head.inputs:
                # what an image has of its own is no reason to move the surface: the logarithm of the uncertainty has
                # the steepest gradient of all, and through the trunk, which the density reads too, all would sink
                parts[0] = features.detach()
            raw = self._raw(head, self.head_layers[name], parts)  # type: ignore[arg-type]
            if name in begun:
                raw = raw + before_sigmoid(begun[name], head.low, head.high)
            answer = self._answer(head, raw)
            if head.activation == "tau and beta":
                outputs |= {"tau": torch.sigmoid(answer[..., :1]), "beta": softplus(answer[..., 1:])}
            else:
                outputs[name] = answer
        return outputs

    def _raw(self, head: Head, layers: list[nn.Linear], parts: list[Tensor]) -> Tensor:
        """What a head answers before its activation, of features and what else it reads."""
        if head.inputs[0] == "features":
            parts = [parts[0].to(self.hidden), *parts[1:]]
        for layer in layers[:-1]:
            x = mixed_linear(layer, parts)
            parts = [(torch.sin(x) if self.network.siren and not head.relu else relu(x)).to(self.hidden)]
        return layers[-1](parts[0].float())

    def _answer(self, head: Head, raw: Tensor) -> Tensor:
        if head.activation == "tau and beta":
            return raw
        if head.activation == "softplus":
            return softplus(raw)
        return head.low + (head.high - head.low) * torch.sigmoid(raw)

    def penalty(self) -> float:
        """None."""
        return 0.0

    def start_density(self) -> dict[str, Tensor]:
        """See `Field.start_density`: a network that adds nothing to it."""
        if self.base is None:
            return {}
        return {f"sigma.{part}": torch.zeros_like(t) for part, t in self.sigma.named_parameters()}

    def named_tensors(self) -> dict[str, Tensor]:
        """Weights and biases by name, unitless."""
        named = {f"trunk.{k}": layer for k, layer in enumerate(self.trunk)} | {"sigma": self.sigma}
        if self.bottleneck is not None:
            named["bottleneck"] = self.bottleneck
        named |= {f"{n}.{k}": layer for n, layers in self.head_layers.items() for k, layer in enumerate(layers)}
        return {f"{n}.{part}": t for n, layer in named.items() for part, t in layer.named_parameters()}


__all__ = ["W0", "MlpField", "positional_encoding"]
