"""Presets: the published configurations as values of the options.

Sources:
    satnerf: Marí, Facciolo & Ehret 2022, "Sat-NeRF: Learning Multi-View Satellite Photogrammetry With Transient Objects
        and Shadow Modeling Using RPC Cameras", CVPR Workshops (its public code for widths and rates).
    eonerf: Marí, Facciolo & Ehret 2023, "Multi-Date Earth Observation NeRF: The Detail Is in the Shadows", CVPR
        Workshops.
    eonerf-learned-shadow: "HDR Radiance Learning and Shadow Regularization for Satellite NeRF 3D Reconstruction":
        EO-NeRF' with the logarithmic RawNeRF loss and shadow regularisation, no transients.
    spsnerf: Zhang & Rupnik 2023, "SparseSat-NeRF: Dense Depth Supervised Neural Radiance Fields for Sparse Satellite
        Images", ISPRS Annals.
    rpv-nerf: Zhang et al. 2025, "BRDF-NeRF: Neural Radiance Fields with Optical Satellite Images and BRDF Modelling".
    hapke-nerf: "Hapke-NeRF", sections 2 and 3: 64 stratified and 64 guided samples, dense depths, Lambertian
        pre-training.

`DIFFERENCES` says what differs from the papers; ``--print-config`` shows it.
"""

from __future__ import annotations

from typing import Any

from sattools.fit.options import FitOptions
from sattools.scene.jsonio import JsonObject

DIFFERENCES = """\
What differs from the papers: with `--start surface` (the default) a network learns what is different from the surface
that `fit` makes of the prior, with its albedo (or w, b, c, theta; rho0, k, theta, rhoc), light and colour relations.
With `--start prior` it begins with the prior's surface and the mean image; without shadows and reflectance model its
colours always do. Both are added to its answers before their activations, the answers begin at zero, and 8 free samples
and 16 around that surface with a smaller rate replace the papers' 64 to 128; `--start noise` has the papers' numbers.
Learned shadows begin as that surface casts them, skies and ambient light as its light in shade, transients at rest
(`--shadow-start lit`: as the papers have them, untrained); between the images' suns, the nearest count.
There, shadows count from the first step; the papers without any (`spsnerf`, `rpv-nerf`, `hapke-nerf`) have those that
the heights cast (`--shadow none`: none), a surface's colours being those in the sun; w may reach 0.99 where the surface
has more than the papers' 0.8, as images of unknown scale make it; transients and uncertainties learn from the trunk
without changing it; one block of an image in ten is held out, and the field keeps its own heights only if they explain
these rays better, by a hundredth and two standard errors. A network is asked for that halfway, too: if it does not, its
colours alone are trained from there, by two samples of what a ray sees, many more rays a step and five times the rate.
Densities are per metre of height, whatever the angle of a ray. Rays to the sun begin 2 m above the surface point.
A sample stands for the part of the ray nearer to it than to its neighbours. The reflectance models are evaluated once a
ray (`--brdf-at sample`: at every sample, as the papers have it), on the normals of the surface it starts from, instead
of a head's that follows a matched surface's, times cos(incidence) / cos(sun zenith), and without a Lambertian phase
where they begin with a fit's parameters. Further, every image has a gain and an offset per band whatever the network
(the papers leave them out or normalise the images beforehand), rays start at the scene's height range, and a surface is
read where the transmittance crosses one half.
One epoch is one pass over the pixels, or a tenth of the steps if that is shorter. From noise, cast shadows come in
after 10,000 steps, or half of them if that is less (EO-NeRF's authors: after two epochs).
"""
_NERF: dict[str, Any] = {"field": "mlp", "loss": "mse", "robust": 0.0, "pose": False}
_GUIDED = {**_NERF, "samples": 64, "guided": 64, "prior_weight": 0.2, "depth_weight": 1 / 3, "shadow": "none"}
PRESETS: dict[str, dict[str, Any]] = {
    "fast": {},
    "satnerf": {
        **_NERF, "network": "satnerf", "samples": 64, "shadow": "learned", "shadow_weight": 0.0, "beta": True,
        "solar_weight": 0.05, "prior_weight": 0.0,
    },
    "eonerf": {
        **_NERF, "network": "eonerf", "samples": 128, "shadow": "geometric", "transient": "on", "beta": True,
        "prior_weight": 0.0,
    },
    "eonerf-learned-shadow": {
        **_NERF, "network": "eonerf-learned-shadow", "samples": 128, "shadow": "learned", "loss": "raw-log",
        "shadow_weight": 0.01, "prior_weight": 0.0,
    },
    "spsnerf": {**_GUIDED, "network": "spsnerf"},
    "rpv-nerf": {**_GUIDED, "network": "rpv", "brdf": "rpv", "normals": "prior", "pretrain": 0.2},
    "hapke-nerf": {**_GUIDED, "network": "hapke", "brdf": "hapke", "normals": "prior", "pretrain": 0.2},
}  # fmt: skip
# of a network that starts from a surface, instead of the paper's values
WARM: dict[str, Any] = {"samples": 8, "guided": 16, "rays": 256, "steps": 2000, "rate": 1e-4, "prior_weight": 0.2}
# of `--field neural`; its rates are its own
NEURAL: dict[str, Any] = {
    "samples": 16, "guided": 16, "rays": 2048, "steps": 1500, "depth_weight": 0.0, "pose": False,
}  # fmt: skip


def resolve(preset: str, given: JsonObject) -> FitOptions:
    """Options of a preset; what is ``given`` wins."""
    start, field = given.get("start", "surface"), given.get("field", "")
    return FitOptions(**{**with_preset(preset, start, field), **given})


def with_preset(preset: str, start: str = "surface", field: str = "") -> JsonObject:
    """The values that a preset sets, for a network that starts from a ``surface``, the ``prior`` or ``noise``.

    Args:
        preset: its name.
        start: of a network.
        field: that is asked for beside it.
    """
    values = PRESETS[preset]
    if start != "noise" and values.get("field") == "mlp":
        # a paper without dense depths keeps its losses: the prior is where its network starts, and no more
        values = {**values, **WARM, "depth_weight": values.get("depth_weight", 0.0)}
    if start == "surface" and values.get("field") == "mlp" and values["shadow"] == "none":
        values = {**values, "shadow": "geometric"}  # the surface's colours are those that it has in the sun
    if start == "surface" and "brdf" in values:
        # it begins with the parameters of a fit, which a Lambertian phase would undo
        values = {**values, "pretrain": 0.0}
    if field == "neural":
        values = {**values, **NEURAL}
    return {"preset": preset, **values}


__all__ = ["DIFFERENCES", "PRESETS", "resolve", "with_preset"]
