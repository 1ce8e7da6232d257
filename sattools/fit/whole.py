"""The fit of an area all at once: a surface, or a field of rays."""

from __future__ import annotations

import logging
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace

import torch

from sattools.errors import SceneError
from sattools.fit.around import casting
from sattools.fit.combinations import check_combination, check_step
from sattools.fit.depth_prior import DepthPrior, certainty, reference_height
from sattools.fit.described import COLOURS, Radiance
from sattools.fit.files import CHECKPOINT, MODEL, TRACE, Fitted, one_result, save_fit
from sattools.fit.illumination import calibrated, check_light, exposed, radiance_kind
from sattools.fit.inputs import (
    basis_of,
    check_prior,
    check_reference,
    holding_out,
    load_prior,
    may_write,
    warn_of_prior,
)
from sattools.fit.model import FittedModel
from sattools.fit.options import FitOptions
from sattools.fit.rays.precision import check_precision, warn_of_precision
from sattools.fit.rays.start import Beginning
from sattools.fit.resume import check_checkpoint
from sattools.fit.surface.detail import with_detail
from sattools.fit.surface.job import SurfaceJob
from sattools.fit.surface.recolour import Held, recoloured
from sattools.fit.surface.scene import SurfaceScene
from sattools.fit.surface.schedule import own_cell, schedule
from sattools.fit.surface.trainer import StageSettings
from sattools.fit.tiles.shared import PRODUCT, read_coarse
from sattools.fit.tiles.state import end
from sattools.fit.trace import Trace
from sattools.progress import Progress, silent, subprogress
from sattools.radiometry.bands import chosen_bands
from sattools.render.around import read_around
from sattools.scene import Item, Scene
from sattools.scene.dependencies import ALBEDO_SECONDS, EARLIER_SECONDS, PRIOR_SECONDS, begin, seen
from sattools.scene.grid import Grid
from sattools.scene.jsonio import JsonObject
from sattools.views import Opened, Source, load_sources, open_images, warn_of_blank, with_bands

log = logging.getLogger(__name__)
DESCENT = 0.8  # share of a fit at which heights stand, and their albedo is solved for
UNKNOWN = "no uncertainty of the reflectance's parameters is known: the network started from no surface fit"
SURFACE_DEVICE = torch.device("cpu")  # compiled kernels: plain torch on an H200 took about three times as long


@dataclass(frozen=True)
class FitSetup:
    """What is known of a fit before an image is read.

    Attributes:
        items: the images to train on.
        radiance: what their numbers are.
        options: with the weights that go with it.
        device: to compute on.
        notes: for the history.
        images: files of the images.
        basis: what a checkpoint of this fit is known by.
    """

    items: list[Item]
    radiance: Radiance
    options: FitOptions
    device: torch.device
    notes: list[str]
    images: Opened
    basis: JsonObject


def set_up(scene: Scene, options: FitOptions) -> FitSetup:
    """All that may be in the way of a fit, before a pixel is read; a dry run ends with it.

    Raises:
        SceneError: fewer than two training images, or options that do not go with them or with each other.
        InputError: a file of the scene that is none.
    """
    items = scene.train_items()
    if len(items) < 2:
        raise SceneError(f"scene {scene.id}: found {len(items)} training image, expected at least 2")
    radiance = radiance_kind(scene, items)
    notes = check_light(scene, items, radiance, options.brdf)
    device = choose_device(options.device)
    images = open_images(scene, items)
    bands = [len(chosen_bands(item, options.bands, images.bands)) for item in items]
    check_combination(options, bands[0])
    if options.field == "surface":
        if options.device == "cuda":
            log.warning("--device cuda: a surface is fitted on the CPU; a GPU is for --field mlp, neural and voxel")
        stages = schedule(options, own_cell(scene), scene.require_height_range(), options.prior_weight > 0)
        finest = stages[-1].cell_size
        if options.coarsest is not None and options.coarsest < finest * (1 - 1e-9) and not scene.is_part:
            log.warning(
                "--coarsest does nothing here: found %g m, expected more than the finest cell, %g m",
                options.coarsest, finest,
            )  # fmt: skip
    elif device.type == "cpu":
        check_step(options)
    check_precision(options, device)
    warn_of_precision(options, device)
    check_prior(scene, options)
    check_reference(scene, options.reference)
    basis = basis_of(scene, options, images.cameras)
    return FitSetup(items, radiance, calibrated(options, radiance), device, notes, images, basis)


def set_up_whole(scene: Scene, options: FitOptions) -> FitSetup:
    """`set_up` of a fit of the whole area; SceneError, InputError where it cannot go on with a checkpoint, too."""
    setup = set_up(scene, options)
    if options.resume:
        check_checkpoint(scene.path(CHECKPOINT), setup.basis)
    warn_of_prior(scene, options)
    return setup


def fit_whole(scene: Scene, options: FitOptions, progress: Progress = silent, overwrite: bool = True) -> JsonObject:
    """Fit the whole area of a scene, whatever `options.tile` says; see `sattools.fit.stage.fit`.

    Args:
        scene: the scene.
        options: of the fit.
        progress: told the share done and what is being done.
        overwrite: replace outputs that are there.
    """
    may = may_write(scene, options, overwrite)
    begin(scene, "fit", [MODEL, TRACE], may)
    with one_result(scene), holding_out(scene, options.holdout, options.views):
        setup = set_up_whole(scene, options)
        if overwrite and not (options.resume or scene.is_part):
            end(scene.root)  # else an interruption of this fit would go on in the tiles of one before
        read = seen(scene, "fit", setup.items)
        sources = load_sources(scene, setup.items, setup.images)
        blank = [] if scene.is_part else warn_of_blank(sources)
        began = time.perf_counter()
        prior, made = load_prior(scene, setup.options, subprogress(progress, 0.0, 0.2), may, sources)
        # of the command's seconds, those that `prior` would have taken before it
        matching = {PRIOR_SECONDS: round(time.perf_counter() - began, 3)} if made else {}
        sources = with_bands(sources, setup.items, options.bands)  # the prior matches whatever the images show
        told = subprogress(progress, 0.2 if prior else 0.0, 1.0)
        if options.field == "surface":
            fitted = _fit_surface(scene, setup, sources, prior, told)
        else:
            from sattools.fit.rays.stage import fit_rays

            trace = Trace()
            start: Beginning | None = None
            if prior is not None and _starts_from_surface(setup.options):
                start = _beginning(scene, setup, sources, prior)
            given = (scene, sources, setup.options, prior, setup.device, told)
            fitted = fit_rays(*given, radiance=setup.radiance, start=start, trace=trace, basis=setup.basis)
            if setup.options.brdf != "lambert":
                fitted.notes[:0] = start.notes if start else [UNKNOWN]
        fitted.notes[:0] = [*setup.notes, *blank]
        before = fitted.trace.offset
        earlier = {EARLIER_SECONDS: round(before, 3)} if before else {}
        return save_fit(scene, fitted, made, read) | matching | earlier


def _starts_from_surface(options: FitOptions) -> bool:
    """Whether a field begins as the surface that `fit` makes of the prior."""
    return options.field in ("mlp", "neural") and options.start == "surface"


def _beginning(scene: Scene, setup: FitSetup, sources: list[Source], prior: DepthPrior) -> Beginning:
    """What a field begins as: the surface with its colours and light, by the defaults of `fit`, and its reflectance."""
    asked = setup.options
    # rays of a field know no shift per view, so that its start must not either
    plain = FitOptions(seed=asked.seed, prior_weight=asked.prior_weight, pose=False)
    plain = calibrated(replace(plain, views=asked.views, holdout=asked.holdout), setup.radiance)
    plain = replace(plain, prior_weight=asked.prior_weight)  # which knows the radiance already
    if asked.brdf in ("rpv", "hapke"):  # on the network's own cells: what it begins with is what was fitted
        plain = replace(plain, brdf=asked.brdf, resolution=asked.resolution or prior.grid.cell_size)
    fitted = _fit_surface(scene, replace(setup, options=plain), sources, prior, silent, lasting=False)
    assert isinstance(fitted.model, FittedModel)
    return Beginning(fitted.model, [f"the surface fit that the network started from: {text}" for text in fitted.notes])


@contextmanager
def _one_thread() -> Iterator[None]:
    """PyTorch with one thread for a while.

    The maps of a surface are so small that others only wait for each other: two took 1.15 times the seconds, and
    1.2 times the CPU seconds, with reflectance models 1.05 and 1.1 times. The compiled kernels have threads of
    their own.
    """
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(before)


@_one_thread()
def _fit_surface(
    scene: Scene,
    setup: FitSetup,
    sources: list[Source],
    prior: DepthPrior | None,
    progress: Progress,
    *,
    lasting: bool = True,
) -> Fitted:
    radiance = setup.radiance
    # amplitudes of a reflectance model and what tiles share have the unit of the images
    plain = radiance == "relative" and setup.options.brdf == "lambert" and PRODUCT not in scene.products
    sources, exposure = exposed(sources) if plain else (sources, 1.0)
    job, notes = _surface_job(scene, setup, sources, prior, lasting)
    told = subprogress(progress, 0.0, DESCENT) if job.options.brdf == "lambert" else progress
    surface, finest, more = job.run(told)
    options = job.resolved
    model = _model_of(job, surface, finest)
    # who asks for a cell size gets it; reflectances are found with the normals of the fit's own cells
    if prior and options.resolution is None and options.brdf == "lambert" and prior.grid.cell_size < finest.cell_size:
        model = with_detail(model, prior)
    seconds: dict[str, float] = {}
    if options.brdf == "lambert":
        began = time.perf_counter()
        held: Held = "all" if job.coarse is not None else "nothing" if radiance == "relative" else "scale"
        white = exposure if radiance == "relative" else None
        told = subprogress(progress, DESCENT, 1.0)
        model = recoloured(model, sources, casting(job.around), white, held=held, seed=options.seed, progress=told)
        seconds[ALBEDO_SECONDS] = round(time.perf_counter() - began, 3)
    model = replace(model, albedo=model.albedo / exposure, offset=model.offset / exposure)
    progress(1.0, "fitted")
    return Fitted(model, job.trace, notes + more, seconds)


def _surface_job(
    scene: Scene, setup: FitSetup, sources: list[Source], prior: DepthPrior | None, lasting: bool
) -> tuple[SurfaceJob, list[str]]:
    """The fit with its stages, the reflectance model chosen where that was asked for, and notes on the choice."""
    radiance = setup.radiance
    grid, z_range = scene.require_grid(), scene.require_height_range()
    z_ref = reference_height(prior, z_range)
    shortest = min(grid.shape) * grid.cell_size

    def stages_of(options: FitOptions) -> list[StageSettings]:
        relative = radiance == "relative"
        return schedule(options, own_cell(scene), z_range, prior is not None, shortest, relative=relative)

    stages = stages_of(setup.options)
    job = SurfaceJob(scene, sources, setup.options, stages, prior, z_ref, SURFACE_DEVICE, radiance, lasting=lasting)
    job.basis = setup.basis
    job.coarse, job.around = read_coarse(scene, [s.id for s in sources]), read_around(scene)
    if job.coarse is not None:
        job.around = job.coarse.around(job.around)
    notes: list[str] = []
    if job.options.brdf == "auto":
        choice = job.choose_brdf(stages[-1])
        notes += choice.notes
        job.options, job.by_material = replace(job.options, brdf=choice.model), True
        job.stages = stages_of(job.options)
    if prior is not None and radiance == "relative" and job.options.brdf == "lambert":
        job.options = replace(job.options, prior_weight=job.options.prior_weight * certainty(prior))
    return job, notes


def _model_of(job: SurfaceJob, surface: SurfaceScene, grid: Grid) -> FittedModel:
    """What a finished job has found: the surface on its last grid, colours and light of the images, uncertainties."""
    options = job.resolved
    assert options.brdf != "auto"  # it has been chosen
    tensors = {n: t.detach().cpu() for n, t in surface.tensors().items()}
    suns = [v.sun for v in job.views]
    maps = job.illumination.maps(suns)
    extra = {name: tensor for name, tensor in tensors.items() if name not in ("height", "albedo", *COLOURS)}
    extra |= {f"{name}_std": std.cpu() for name, std in job.parameter_std.items()}
    return FittedModel(
        grid=grid,
        items=[s.id for s in job.sources],
        suns=suns,
        height=tensors["height"],
        height_std=job.height_std.cpu(),
        albedo=tensors["albedo"],
        gain=tensors["gain"],
        offset=tensors["offset"],
        ambient=tensors["ambient"],
        pose=tensors["pose"],
        slopes=[v.slope for v in job.views],
        z_ref=job.z_ref,
        softness=job.last_softness,
        shadow=options.shadow,
        transient=options.transient,
        radiance=job.radiance,
        brdf=options.brdf,
        bands=options.bands,
        s_net=maps.get("s_net"),
        tau=maps.get("tau"),
        extra=extra,
    )


def choose_device(name: str) -> torch.device:
    """The device of that name; auto = CUDA where there is one."""
    if name == "cuda" and not torch.cuda.is_available():
        raise SceneError("device: found no CUDA device, expected one for --device cuda (or use --device cpu)")
    if name == "auto":
        name = "cuda" if torch.cuda.is_available() else "cpu"
    return torch.device(name)


__all__ = ["FitSetup", "choose_device", "fit_whole", "set_up", "set_up_whole"]
