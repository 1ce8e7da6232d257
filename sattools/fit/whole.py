"""The fit of an area all at once: a surface, or a field of rays."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch

from sattools.errors import SceneError
from sattools.fit.coarse import PRODUCT, read_coarse
from sattools.fit.files import CHECKPOINT, MODEL, STATE, TRACE, save_fit
from sattools.fit.illumination import Radiance, calibrated, check_light, exposed, radiance_kind
from sattools.fit.inputs import PriorMaps, holding_out, load_prior, may_write
from sattools.fit.options import FitOptions
from sattools.fit.schedule import schedule
from sattools.fit.surface_job import SurfaceJob
from sattools.fit.trace import Trace
from sattools.progress import Progress, silent, subprogress
from sattools.scene import Item, Scene
from sattools.scene.dependencies import begin
from sattools.views import Source, load_sources

# tensors and description of the model, what happened, notes
Fitted = tuple[dict[str, torch.Tensor], dict[str, Any], Trace, list[str]]


@dataclass(frozen=True)
class FitSetup:
    """What is known of a fit before an image is read.

    Attributes:
        items: the images to train on.
        radiance: what their numbers are.
        options: with the weights that go with it.
        device: to compute on.
        notes: for the history.
    """

    items: list[Item]
    radiance: Radiance
    options: FitOptions
    device: torch.device
    notes: list[str]


def set_up(scene: Scene, options: FitOptions) -> FitSetup:
    """Raises SceneError: fewer than two training images, or options that do not go with them."""
    items = scene.train_items()
    if len(items) < 2:
        raise SceneError(f"scene {scene.id}: found {len(items)} training image, expected at least 2")
    radiance = radiance_kind(scene, items)
    notes = check_light(scene, items, radiance, options.brdf)
    return FitSetup(items, radiance, calibrated(options, radiance), choose_device(options.device), notes)


def fit_whole(scene: Scene, options: FitOptions, progress: Progress = silent, overwrite: bool = True) -> dict[str, Any]:
    """Fit the whole area of a scene, whatever `options.tile` says; see `sattools.fit.stage.fit`."""
    may = may_write(scene, options, overwrite, (CHECKPOINT, STATE))
    path = begin(scene, "fit", [MODEL, TRACE], may)[MODEL]
    with holding_out(scene, options.holdout, options.views):
        setup = set_up(scene, options)
        sources = load_sources(scene, setup.items)
        prior, made = load_prior(scene, setup.options, subprogress(progress, 0.0, 0.2), may)
        told = subprogress(progress, 0.2 if prior else 0.0, 1.0)
        fitted = _fit_surface if options.field == "surface" else _fit_rays
        tensors, meta, trace, more = fitted(scene, setup, sources, prior, told)
        return save_fit(scene, path, tensors, meta, trace, setup.notes + more, made)


def _fit_rays(
    scene: Scene, setup: FitSetup, sources: list[Source], prior: PriorMaps | None, progress: Progress
) -> Fitted:
    from sattools.fit.rays_stage import fit_rays

    trace = Trace()
    tensors, meta, more = fit_rays(scene, sources, setup.options, prior, setup.device, trace, progress)
    return tensors, meta, trace, more


def _fit_surface(
    scene: Scene, setup: FitSetup, sources: list[Source], prior: PriorMaps | None, progress: Progress
) -> Fitted:
    options, radiance = setup.options, setup.radiance
    notes: list[str] = []
    grid, z_range = scene.require_grid(), scene.require_height_range()
    # amplitudes of a reflectance model and what tiles share have the unit of the images
    plain = radiance == "relative" and options.brdf == "lambert" and PRODUCT not in scene.products
    sources, exposure = exposed(sources) if plain else (sources, 1.0)
    z_ref = float(np.nanmedian(prior[0])) if prior else z_range[0] + 0.3 * (z_range[1] - z_range[0])
    stages = schedule(options, grid.cell_size, z_range, prior is not None)
    job = SurfaceJob(scene, sources, options, stages, prior, z_ref, setup.device, radiance)
    job.coarse = read_coarse(scene, [s.id for s in sources])
    if options.brdf == "auto":
        choice = job.choose_brdf(stages[-1])
        notes += choice.notes
        options = job.options = replace(options, brdf=choice.model)
        job.stages = schedule(options, grid.cell_size, z_range, prior is not None)
    surface, finest, more = job.run(progress)
    options = job.resolved
    tensors = {n: t.detach().cpu() for n, t in surface.tensors().items()}
    for name in ("albedo", "offset") if plain else ():
        tensors[name] = tensors[name] / exposure
    tensors["height_std"] = job.height_std.cpu()
    tensors |= {f"{name}_std": std.cpu() for name, std in job.parameter_std.items()}
    tensors |= job.illumination.maps([v.sun for v in job.views])
    meta = {
        "field": "surface",
        "grid": finest.to_dict(),
        "softness": job.last_softness,
        "items": [s.id for s in sources],
        "suns": [v.sun for v in job.views],
        "slopes": [v.slope for v in job.views],
        "z_ref": z_ref,
        "shadow": options.shadow,
        "transient": options.transient,
        "radiance": radiance,
        "brdf": options.brdf,
    }
    return tensors, meta, job.trace, notes + more


def choose_device(name: str) -> torch.device:
    """The device of that name; auto = CUDA where there is one."""
    if name == "cuda" and not torch.cuda.is_available():
        raise SceneError("device: found no CUDA device, expected one for --device cuda (or use --device cpu)")
    if name == "auto":
        name = "cuda" if torch.cuda.is_available() else "cpu"
    return torch.device(name)


__all__ = ["FitSetup", "choose_device", "fit_whole", "set_up"]
