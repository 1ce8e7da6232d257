"""Options of `sattools fit`."""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import Literal

from sattools.errors import InputError
from sattools.fit.rays.options import RayOptions
from sattools.settings import option


@dataclass(frozen=True)
class FitOptions(RayOptions):
    """What `fit` does; the field's help texts are the command's help."""

    preset: Literal["fast", "satnerf", "eonerf", "eonerf-learned-shadow", "spsnerf", "rpv-nerf", "hapke-nerf"] = option(
        "fast", "Set of option values, a published method or the default; options given beside it win."
    )
    loss: Literal["mse", "mse-gamma", "raw-gamma", "raw-log"] = option(
        "raw-gamma", "Photometric loss (RawNeRF weights for raw-*)."
    )
    robust: float = option(
        0.1, "Residual from which it counts less, in tone-mapped units at the images' median; 0 = off.", minimum=0
    )
    shadow: Literal["none", "geometric", "learned", "auto"] = option(
        "geometric",
        "Sun visibility: none, cast by the heights, learned from cell and sun; auto = what helps held-out views.",
    )
    shadow_weight: float | None = option(
        None,
        "Weight of the learned shadow's tie to the geometric one (default: 0.01 with raw losses, else 0.0005).",
        minimum=0,
    )
    shadow_start: Literal["geometric", "lit"] = option(
        "geometric",
        "Learned shadows begin as the start surface casts them, a network's light in shade as that of the surface; or "
        "with all lit, and a network's light as noise.",
    )
    transient: Literal["on", "off", "auto"] = option(
        "off", "A darkening of each image's own, for moving objects; auto = where images hold such."
    )
    brdf: Literal["lambert", "rpv", "hapke", "auto"] = option(
        "lambert",
        "Reflectance: lambert = one colour per cell; rpv, hapke = models of normal, sun and view; "
        "auto = the plainest that predicts held-out views as well, by material.",
    )
    sky: Literal["none", "fitted", "auto"] = option(
        "none",
        "With rpv and hapke: light of an even sky on lit and shaded ground, past what hides it; none = only in shade, "
        "auto = fitted, and kept where it is surely there.",
    )
    sky_share: list[float] = option(
        [],
        "Irradiance by the sky of open level ground over that of the sun across its beam, once per band or once for "
        "all, instead of a fitted one.",
        minimum=0,
        maximum=0.6,
    )
    bounce: bool = option(False, "With --sky or --sky-share: so does the ground around, by what it reflects.")
    pretrain: float = option(
        0.2, "Share of the last stage's epochs before the reflectance model comes in.", minimum=0, maximum=0.9
    )
    normals: Literal["analytic", "prior"] = option(
        "analytic", "Normals of the reflectance model: those of the fitted height, or frozen to the prior's."
    )
    materials: int = option(8, "Most endmembers that share b, c, theta (k, asymmetry, rhoc).", minimum=1, maximum=32)
    material_smooth: float = option(0.02, "Weight of the smoothness of w (rho0) within a material.", minimum=0)
    bands: list[str] = option(
        [],
        "Band of the images to fit, by its number from 1 or its name (repeatable, in order; default: all). The "
        "prior is matched on all of them.",
    )
    views: str = option("all", "Images to train on: all, or nearest-nadir:N of the training images.")
    resolution: float | None = option(
        None,
        "Finest cell of the surface [m] (default: fitted on twice the scene grid's, about three pixels, as a "
        "correction of the prior, and given on the prior's).",
        minimum=0.01,
    )
    coarsest: float | None = option(
        None,
        "Cell at which the fit starts [m]; each stage halves it (default: 4 x the finest; the finest with a prior).",
        minimum=0.01,
    )
    epochs: list[int] = option(
        [],
        "Passes over all views per stage, coarse to fine (repeatable; the last holds for all further stages; default: "
        "5 from a prior, 8 of calibrated images or with a reflectance model, 16 from a flat start or where shadows or "
        "transients are learned).",
        minimum=1,
        maximum=100_000,
    )
    softness: list[float] = option(
        [1.5, 0.5],
        "How blurred the surface is in height at the start and, given again, at the end of a stage, in cells: enough "
        "to find its way, then sharp (s in docs/glossary.md).",
        minimum=0.01,
        maximum=1000,
    )
    smooth: float | None = option(
        None, "Weight of the height smoothness (default: 0.4, or 0.05 from a flat start).", minimum=0
    )
    tile: float | Literal["auto"] | None = option(
        None,
        "Fit the area in tiles of at most this edge, joined without seams [m]; 0 = all at once, auto = as the free "
        "memory asks for [default: all at once, but as auto where memory is too small for that].",
        minimum=0,
    )
    overlap: float = option(
        32.0,
        "With --tile: reach into neighbouring tiles, of priors at least 48 [m].",
        minimum=1,
    )
    part: Literal["all", "coarse", "split", "mosaic"] = option(
        "all",
        "With --tile: split = fit the whole coarsely and leave one scene per tile in fit/tiles/*/scene.json, each for "
        "a `fit` of its own, anywhere; mosaic = put fitted tiles together. coarse = of the split the coarse fit alone, "
        "and the scenes of pilot tiles in fit/tiles/pilot.*, for a `fit` each before split --resume.",
        renamed={"join": "mosaic"},
    )
    prior_weight: float = option(
        0.2,
        "Weight of the depth prior, up to 10 times as much where its heights are not noisy; 0 = fit from a flat "
        "surface without one.",
        minimum=0,
    )
    height_rate: float = option(0.15, "Adam step for heights, in softness lengths.", minimum=0)
    pose: bool = option(True, "Refine one shift per view during the fit.")
    budget: float | None = option(
        None, "Seconds after which the fit stops and keeps what it has; 0 = no such limit.", minimum=0
    )
    holdout: list[str] = option([], "Item id to leave out of training (repeatable).")
    reference: str | None = option(
        None, "DSM to score the surface against after every epoch (never used by the fit).", path="file"
    )
    seed: int = option(0, "Seed of everything random.", minimum=0)
    device: Literal["auto", "cpu", "cuda"] = option(
        "auto",
        "Where networks and other fields of rays are trained; auto = on a GPU where there is one. Surfaces: the CPU.",
    )
    resume: bool = option(False, "Continue an interrupted fit from its last checkpoint.")

    def __post_init__(self) -> None:
        parse_views(self.views)
        if len(self.softness) != 2:
            found = " ".join(f"{length:g}" for length in self.softness) or "no number"
            raise InputError(
                f"--softness: found {found}, expected two numbers, of the start and the end of a stage: --softness 1.5 "
                "--softness 0.5"
            )


def parse_views(text: str) -> int | None:
    """How many images are trained on, of ``nearest-nadir:N``; None = ``all``. Raises InputError for another text."""
    match = re.fullmatch(r"nearest-nadir:([1-9]\d*)", text)
    if match is None and text != "all":
        raise InputError(f"--views: found {text!r}, expected all or nearest-nadir:N")
    return int(match[1]) if match else None


__all__ = ["FitOptions", "parse_views"]
