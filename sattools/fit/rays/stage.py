"""`fit --field voxel|mlp|neural`: pixels become rays, a field is trained on them, and its surface is read off."""

from __future__ import annotations

import contextlib
import logging
import time
from dataclasses import replace

import torch

from sattools.field import neural
from sattools.field.surface_base import SurfaceBase
from sattools.fit.around import casting, of_the_area
from sattools.fit.combinations import starts_from_prior
from sattools.fit.depth_prior import DepthPrior, reference_height
from sattools.fit.described import Radiance
from sattools.fit.files import CHECKPOINT, Fitted
from sattools.fit.illumination import levels
from sattools.fit.inputs import fingerprint
from sattools.fit.model import FittedModel
from sattools.fit.options import FitOptions
from sattools.fit.rays.job import RayJob
from sattools.fit.rays.judge import begin_uncertainty, judge_heights
from sattools.fit.rays.maps import read_maps
from sattools.fit.rays.reflectance import known_of_start, reflectance_maps
from sattools.fit.rays.start import (
    Beginning,
    base_surface,
    box_over,
    filled_prior,
    known_light,
    make_field,
    ray_set,
)
from sattools.fit.rays.trainer import FieldSteps, RayTrainer
from sattools.fit.trace import Trace
from sattools.progress import Progress
from sattools.render.around import read_around
from sattools.render.visibility import Cast
from sattools.scene import Grid, Scene
from sattools.scene.jsonio import JsonObject
from sattools.views import Source, View, match_colours, views_on

log = logging.getLogger(__name__)
STEPS = {
    "voxel": FieldSteps({"logits": 0.1, "albedo": 0.03}),
    "neural": FieldSteps(neural.RATES, neural.BEGIN, neural.EPSILON),
}


def fit_rays(
    scene: Scene,
    sources: list[Source],
    options: FitOptions,
    prior: DepthPrior | None,
    device: torch.device,
    progress: Progress,
    *,
    radiance: Radiance = "relative",
    start: Beginning | None = None,
    trace: Trace | None = None,
    basis: JsonObject | None = None,
) -> Fitted:
    """Train a field ray by ray.

    Args:
        scene: with grid and height range.
        sources: the training images.
        options: of the fit, checked (`sattools.fit.combinations`).
        prior: depth supervision, or None.
        device: where the field is trained and read off.
        progress: told the share done.
        radiance: what the images' numbers are.
        start: what the field begins as, instead of the prior's surface.
        trace: of what has been done already.
        basis: of a checkpoint, see `Interrupted`.
    """
    trace = trace or Trace()
    asked_at = time.perf_counter() - trace.seconds()
    whole, z_range = scene.require_grid(), scene.require_height_range()
    warm = starts_from_prior(options)  # and so as detailed as the prior
    grid = whole.resized(options.resolution or (1 if warm else 2) * whole.cell_size)
    z_ref = reference_height(prior, z_range)
    first = prior if start is None or prior is None else start.guide(prior)
    prior_here = None if first is None else filled_prior(first, grid)
    around, height = read_around(scene), prior_here.height if prior_here else None
    views = of_the_area(views_on(sources, grid, z_ref, z_range), around, height, grid.cell_size, z_range)
    rays = ray_set(views, grid, z_range, prior_here, normals=options.brdf != "lambert").to(device)
    gain, offset = (torch.from_numpy(a) for a in match_colours(views))
    if radiance != "relative":  # the images have one scale already
        gain, offset = torch.ones_like(gain), torch.zeros_like(offset)
        if options.brdf == "lambert":
            gain = torch.from_numpy(levels(radiance, [view.sun for view in views], gain.shape[1]))
    # a field with neither shadows nor slopes has to begin with the mean image
    coloured = start if start is not None and (options.shadow != "none" or start.reflective is not None) else None
    base = None
    if warm:
        assert prior_here is not None  # `check_combination`
        base = _base_of(options, views, prior_here, z_range, (gain, offset), start=coloured, cast=casting(around))
        base = base.to(device)
        if coloured:
            gain, offset = coloured.surface.gain, coloured.surface.offset
    # whatever is made from here on, is made there; where it is made anyway, to ask for it takes a tenth of a fit
    with device if device != torch.get_default_device() else contextlib.nullcontext():
        there = None if prior_here is None else prior_here.to(device)
        field = make_field(options, grid, z_range, z_ref, views[0].target.shape[-1], there, base=base)
        steps = STEPS.get(options.field, FieldSteps())
        trainer = RayTrainer(field, rays, options, gain, offset, steps, radiance=radiance)
        if coloured:
            trainer.colour["ambient"].data.copy_(coloured.surface.ambient)
        begin_uncertainty(trainer)
        mark = fingerprint(scene, options, sources, prior)
        job = RayJob(scene.output(CHECKPOINT), mark, trainer, grid, z_range, trace, basis)
        begun = time.perf_counter()
        notes = job.run(options, progress)
        ended = time.perf_counter()
        notes += judge_heights(trainer, options.steps)
        model = _model_of(trainer, base, views, grid, z_range)
    notes += _exceeded(options, begun - asked_at, ended - begun, time.perf_counter() - ended)
    model = model.to(torch.device("cpu"))
    extra = {**model.extra, **known_of_start(start, grid)}
    if prior_here is not None and prior_here.normal is not None:
        extra["normal"] = prior_here.normal
    return Fitted(replace(model, extra=extra), trace, notes)


def _base_of(
    options: FitOptions,
    views: list[View],
    prior: DepthPrior,
    z_range: tuple[float, float],
    colours: tuple[torch.Tensor, torch.Tensor],
    *,
    start: Beginning | None,
    cast: Cast,
) -> SurfaceBase:
    """The surface to which a field learns what is different, with its colours and, of a network, its light.

    Args:
        options: of the fit.
        views: of the training, on the prior's grid.
        prior: heights, none unknown.
        z_range: lowest and highest height [m].
        colours: gain and offset ``[V, C]`` of the images where there is no ``start``.
        start: whose colours and light it has, or None = the mean image's.
        cast: sun visibility of heights on cells under a sun.
    """
    gain, offset = (array.numpy() for array in colours)
    base = base_surface(views, prior, z_range, gain, offset, shaded=options.shadow != "none", cast=cast)
    if start is None:
        return base
    base = start.coloured(base, prior.grid)
    if options.field == "mlp" and options.shadow != "none" and options.shadow_start == "geometric":
        learned = options.shadow == "learned"
        base = replace(base, light=known_light(views, base, start.surface.ambient, learned=learned, cast=cast))
    return base


def _exceeded(options: FitOptions, before: float, training: float, after: float) -> list[str]:
    """That a budget was exceeded, and by what: seconds before the training, of it, and of reading off what it left."""
    spent = before + training + after
    if not options.budget or options.resume or spent <= options.budget:
        return []
    text = (
        f"the budget of {options.budget:g} s was exceeded: {spent:.0f} s, of which its start took {before:.0f} and the "
        f"reading off of its surface {after:.0f}"
    )
    log.warning(text)
    return [text]


def _model_of(
    trainer: RayTrainer, base: SurfaceBase | None, views: list[View], grid: Grid, z_range: tuple[float, float]
) -> FittedModel:
    """What a trained field looks like on the ground, and what it takes to show it again."""
    options = trainer.options
    maps = read_maps(trainer, grid, z_range)
    extra = {n: t.detach() for n, t in trainer.tensors.items() if n.startswith("field.")}
    extra["embedding"] = trainer.embedding.detach()
    extra |= {f"base.{n}": t for n, t in base.tensors().items()} if base else {}
    box = box_over(grid, z_range)
    extra["box"] = torch.tensor([box.low, box.high])
    if options.brdf_at == "sample":
        extra["brdf_at_sample"] = torch.ones(1)
    assert options.brdf != "auto"  # `check_combination`
    albedo = maps.albedo
    if options.brdf != "lambert":
        albedo, parameters = reflectance_maps(options.brdf, maps)
        extra |= parameters
    return FittedModel(
        grid=grid,
        items=[v.id for v in views],
        suns=[v.sun for v in views],
        height=maps.height,
        height_std=maps.height_std,
        albedo=albedo,
        gain=trainer.colour["gain"].detach(),
        offset=trainer.colour["offset"].detach(),
        ambient=trainer.colour["ambient"].detach(),
        pose=torch.zeros(len(views), 2),
        slopes=[v.slope for v in views],
        z_ref=views[0].z_ref,
        shadow=options.shadow,
        transient=options.transient,
        field=options.field,
        heights=options.start if trainer.put_back and options.start != "noise" else "own",
        network=options.network if options.field == "mlp" else None,
        radiance=trainer.radiance,
        brdf=options.brdf,
        bands=options.bands,
        s_net=maps.images.get("s_net") if options.shadow == "learned" else None,
        tau=maps.images.get("tau") if options.transient == "on" else None,
        beta=maps.images.get("beta") if options.beta else None,
        extra=extra,
    )


__all__ = ["fit_rays"]
