"""The networks of the papers as descriptions: widths, heads, activations.

| name | source |
|---|---|
| satnerf | Marí, Facciolo & Ehret 2022, "Sat-NeRF", CVPR Workshops, and its public code |
| eonerf | Marí, Facciolo & Ehret 2023, "Multi-Date Earth Observation NeRF", CVPR Workshops |
| eonerf-learned-shadow | "HDR Radiance Learning and Shadow Regularization for Satellite NeRF", figure 1 |
| spsnerf | Zhang & Rupnik 2023, "SparseSat-NeRF", ISPRS Annals |
| rpv | Zhang et al. 2025, "BRDF-NeRF", parameters of Rahman, Pinty & Verstraete 1993 |
| hapke | "Hapke-NeRF": small heads for w, b, c and the roughness |
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal

EMBEDDING = 4
DEPTH, AGAIN = 8, 4  # layers of a trunk; the one (from 0) that gets the input again


@dataclass(frozen=True)
class Head:
    """A small network on the features and perhaps the sun's direction or the image's embedding.

    Attributes:
        inputs: any of ``features``, ``sun``, ``embedding``.
        hidden: widths of the hidden layers, as shares of the trunk's width.
        outputs: numbers that come out.
        activation: of the output; ``tau and beta``: a sigmoid and a softplus, answered under these names.
        low, high: range of a sigmoid output.
        relu: hidden layers are ReLU whatever the trunk is.
    """

    inputs: tuple[str, ...]
    hidden: tuple[float, ...]
    outputs: int
    activation: Literal["sigmoid", "softplus", "tau and beta"] = "sigmoid"
    low: float = 0.0
    high: float = 1.0
    relu: bool = False


@dataclass(frozen=True)
class Network:
    """A trunk of `DEPTH` layers with the input again at one of them, a density, and heads.

    Attributes:
        width: of the trunk.
        siren: sine activations (first frequency 30) on bare coordinates, else ReLU on a positional encoding.
        frequencies: octaves of the positional encoding.
        bottleneck: a linear layer between trunk and heads (Sat-NeRF).
    """

    width: int
    siren: bool
    frequencies: int
    bottleneck: bool
    heads: dict[str, Head] = field(default_factory=dict)


def _half(*inputs: str, outputs: int = 1, layers: int = 1, **more: object) -> Head:
    return Head(inputs, (0.5,) * layers, outputs, **more)  # type: ignore[arg-type]


_ALBEDO = _half("features", outputs=3)
_SKY = Head(("sun",), (0.5,), 3, relu=True)
_EO_HEADS = {
    "albedo": _ALBEDO,
    "ambient": Head(("sun",), (0.5,), 3, high=0.2, relu=True),
    "transient": _half("features", "embedding", outputs=2, layers=4, activation="tau and beta"),
}
NETWORKS: dict[str, Network] = {
    "satnerf": Network(512, True, 0, True, {
        "albedo": _ALBEDO,
        "sun": _half("features", "sun", layers=3),
        "sky": _SKY,
        "beta": Head(("features", "embedding"), (0.5,), 1, "softplus"),
    }),
    "eonerf": Network(256, False, 10, False, _EO_HEADS),
    "eonerf-learned-shadow": Network(
        256, False, 10, False, {**_EO_HEADS, "sun": _half("features", "sun", layers=3)}
    ),
    "spsnerf": Network(512, True, 0, True, {"albedo": _ALBEDO}),
    "rpv": Network(512, True, 0, True, {
        "albedo": _ALBEDO,
        "k": _half("features", high=2.0),
        "theta": _half("features", low=-1.0),
        "rhoc": _half("features"),
    }),
    "hapke": Network(512, True, 0, True, {
        "albedo": Head(("features",), (0.5,), 3, high=0.8),  # w; the Lambertian pre-training takes it for the albedo
        "b": _half("features"),
        "c": _half("features"),
        "theta": _half("features", high=60.0),
    }),
}  # fmt: skip


__all__ = ["AGAIN", "DEPTH", "EMBEDDING", "NETWORKS", "Head", "Network"]
