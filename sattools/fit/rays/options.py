"""Options of fields that are trained ray by ray."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from sattools.settings import option


@dataclass(frozen=True)
class RayOptions:
    """What fields that are trained ray by ray use, and which field it is."""

    field: Literal["surface", "voxel", "mlp", "neural"] = option(
        "surface",
        "What is fitted: a surface, a density grid, a network of points, or columns that choose between heights, with "
        "colours along walls (neural; with values of its own for the options below).",
    )
    network: Literal["satnerf", "eonerf", "eonerf-learned-shadow", "spsnerf", "rpv", "hapke"] = option(
        "eonerf", "Network of --field mlp."
    )
    width: int | None = option(None, "Width of the network's trunk (default: the paper's).", minimum=8, maximum=4096)
    start: Literal["surface", "prior", "noise"] = option(
        "surface",
        "What a network starts from: the surface that `fit` makes of the prior, with its colours and light, or the "
        "prior's own, to which it learns what is different, seen by few samples around it; or noise, with the paper's "
        "samples and steps (days on a CPU).",
    )
    rays: int = option(1024, "Rays per step.", minimum=1, maximum=1 << 20)
    samples: int = option(64, "Stratified samples per ray.", minimum=2, maximum=4096)
    guided: int = option(0, "More samples around the prior's depth; needs a prior.", minimum=0, maximum=4096)
    steps: int = option(300000, "Steps of a fit ray by ray.", minimum=1, maximum=100_000_000)
    rate: float = option(5e-4, "Adam step of the network (times 0.9 every epoch).", minimum=0)
    precision: Literal["float32", "tf32", "bf16"] = option(
        "float32",
        "How a network's layers are multiplied in training: as float32; in TF32, on a GPU; or in bfloat16, twice as "
        "fast on CPUs with AMX. Weights, coordinates, densities, losses and what is read off stay float32.",
    )
    depth_weight: float = option(1 / 3, "Weight of the prior's depths where a ray disagrees with them.", minimum=0)
    brdf_at: Literal["ray", "sample"] = option(
        "ray",
        "Where a network's reflectance model is evaluated: once a ray with the mean parameters, or at every sample as "
        "in the papers, about twice as slow.",
    )
    beta: bool = option(False, "Learn an uncertainty per pixel (Sat-NeRF's loss), from the third epoch.")
    solar_weight: float = option(0.0, "Weight of Sat-NeRF's solar correction of learned shadows.", minimum=0)


__all__ = ["RayOptions"]
