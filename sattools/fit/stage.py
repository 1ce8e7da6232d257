"""The stage `fit`: a scene with images and cameras becomes a fitted model."""

from __future__ import annotations

import hashlib
import json
import logging
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from sattools.errors import SceneError
from sattools.fit import checkpoint
from sattools.fit.auto import Choice, choose_model, draw
from sattools.fit.coarse import PRODUCT, Coarse, read_coarse
from sattools.fit.illumination import (
    Radiance,
    calibrated,
    check_light,
    choose_views,
    exposed,
    light_scale,
    material_remarks,
    prior_normals,
    radiance_kind,
)
from sattools.fit.irradiance import Light
from sattools.fit.irradiance_choice import choose_light
from sattools.fit.options import FitOptions
from sattools.fit.reflective import ReflectiveScene, reflective, restored
from sattools.fit.resample import resample_map
from sattools.fit.schedule import schedule
from sattools.fit.surface import SurfaceScene, start_scene
from sattools.fit.trace import Trace
from sattools.fit.train import REFRESH, Prior, StageSettings, StageTrainer
from sattools.progress import Progress, part, silent
from sattools.render import sun_visibility
from sattools.scene import Grid, Scene
from sattools.scene.raster import write_text
from sattools.views import Source, View, load_sources, match_colours, shown_on, views_on

log = logging.getLogger(__name__)
MODEL, TRACE, CHECKPOINT = "fit/model.safetensors", "fit/trace.csv", "fit/checkpoint.safetensors"
START_AMBIENT = 0.4


def fit(scene: Scene, options: FitOptions, progress: Progress = silent, overwrite: bool = True) -> dict[str, Any]:
    """Fit a surface to the scene's training images; writes the model and the trace below the root.

    Returns:
        Remarks and figures for the history.

    Raises:
        SceneError: fewer than two usable images, or unknown held-out ids.
    """
    model_path = scene.output(MODEL, overwrite or options.resume)
    for item in scene.items:
        if item.id in options.holdout:
            item.properties["sattools:role"] = "test"
    unknown = set(options.holdout) - {item.id for item in scene.items}
    if unknown:
        raise SceneError(f"scene {scene.id}: found no item {sorted(unknown)[0]!r} to hold out")
    choose_views(scene, options.views)
    items = scene.train_items()
    if len(items) < 2:
        raise SceneError(f"scene {scene.id}: found {len(items)} training image, expected at least 2")
    radiance = radiance_kind(scene, items)
    remarks = check_light(scene, items, radiance, options.brdf)
    options = calibrated(options, radiance)
    device = choose_device(options.device)
    if options.tile and PRODUCT not in scene.products:
        from sattools.fit.tiles import fit_tiled

        return fit_tiled(scene, options, progress)
    sources = load_sources(scene, items)
    grid, z_range = scene.need_grid(), scene.need_height_range()
    prior = load_prior(scene, options, part(progress, 0.0, 0.2))
    if options.field != "surface":
        from sattools.fit.rays_stage import fit_rays

        trace = Trace()
        progress = part(progress, 0.2 if prior else 0.0, 1.0)
        tensors, meta, more = fit_rays(scene, sources, options, prior, device, trace, progress)
        return save_fit(scene, model_path, tensors, meta, trace, remarks + more)
    # amounts of a reflectance model and what tiles share have the unit of the images
    plain = radiance == "relative" and options.brdf == "lambert" and PRODUCT not in scene.products
    sources, exposure = exposed(sources) if plain else (sources, 1.0)
    z_ref = float(np.nanmedian(prior[0])) if prior else z_range[0] + 0.3 * (z_range[1] - z_range[0])
    stages = schedule(options, grid.cell_size, z_range, prior is not None)
    job = _Job(scene, sources, options, stages, prior, z_ref, device, radiance)
    job.coarse = read_coarse(scene, [s.id for s in sources])
    if options.brdf == "auto":
        choice = job.choose_brdf(stages[-1])
        remarks += choice.remarks
        options = job.options = replace(options, brdf=choice.model)
        job.stages = schedule(options, grid.cell_size, z_range, prior is not None)
    surface, finest, more = job.run(part(progress, 0.2 if prior else 0.0, 1.0))
    options = job.resolved
    tensors = {n: t.detach().cpu() for n, t in surface.tensors().items()}
    for name in ("albedo", "offset") if plain else ():
        tensors[name] = tensors[name] / exposure
    tensors["height_std"] = job.height_std.cpu()
    tensors |= {f"{name}_std": std.cpu() for name, std in job.parameter_std.items()}
    tensors |= job.light.maps([v.sun for v in job.views])
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
    return save_fit(scene, model_path, tensors, meta, job.trace, remarks + more)


def save_fit(
    scene: Scene, path: Path, tensors: dict[str, Tensor], meta: dict[str, Any], trace: Trace, remarks: list[str]
) -> dict[str, Any]:
    """Write model and trace; figures for the history."""
    checkpoint.save(path, tensors, meta)
    write_text(scene.output(TRACE), trace.to_csv())
    scene.output(CHECKPOINT).unlink(missing_ok=True)
    scene.products.update(model=MODEL, trace=TRACE)
    return {"remarks": remarks, "fit": {"loss": trace.rows[-1]["loss"], "epochs": len(trace.rows)}}


def choose_device(name: str) -> torch.device:
    """The device of that name; auto = CUDA where there is one."""
    if name == "cuda" and not torch.cuda.is_available():
        raise SceneError("device: found no CUDA device, expected one for --device cuda (or use --device cpu)")
    if name == "auto":
        name = "cuda" if torch.cuda.is_available() else "cpu"
    return torch.device(name)


def load_prior(scene: Scene, options: FitOptions, progress: Progress) -> tuple[np.ndarray, np.ndarray, Grid] | None:
    """Height, confidence and grid of the scene's depth prior; made with its defaults where it is missing."""
    if options.prior_weight == 0:
        return None
    from sattools.prior.files import read_prior

    if "prior_dsm" not in scene.products:
        from sattools.prior import PriorOptions
        from sattools.prior.stage import prior

        prior(scene, PriorOptions(), progress)
    within = scene.need_grid() if PRODUCT in scene.products else None  # that of a whole area is larger than a tile
    return read_prior(scene, within)


@dataclass
class _Job:
    """One fit from the first stage to the last, with checkpoints."""

    scene: Scene
    sources: list[Source]
    options: FitOptions
    stages: list[StageSettings]
    prior: tuple[np.ndarray, np.ndarray, Grid] | None
    z_ref: float
    device: torch.device
    radiance: Radiance = "relative"
    trace: Trace = field(default_factory=Trace)
    views: list[View] = field(default_factory=list)
    last_softness: float = 0.0
    height_std: Tensor = field(default_factory=lambda: torch.zeros(0))
    parameter_std: dict[str, Tensor] = field(default_factory=dict)
    light: Light = field(default_factory=lambda: Light({}))
    settled: dict[str, Any] = field(default_factory=dict)
    coarse: Coarse | None = None

    def run(self, progress: Progress) -> tuple[SurfaceScene, Grid, list[str]]:
        remarks: list[str] = []
        saved = self._resume() if self.options.resume else None
        score = self._scorer()
        total = sum(s.epochs / s.cell_size**2 for s in self.stages)
        surface: SurfaceScene | None = None
        grid = self.scene.need_grid()
        for k, stage in enumerate(self.stages):
            grid = self.scene.need_grid().resized(stage.cell_size)
            self.last_softness = stage.softness[1]
            if saved and k < saved[1]["stage"]:
                continue
            self.views = views_on(self.sources, grid, self.z_ref, stage.z_range)
            self._warn_spread(stage.cell_size, remarks)
            if surface is None:
                surface = self._start(grid)
                remarks += self._choose_light(surface, stage.cell_size, saved)
                self.light = Light.start(self.resolved, grid.shape, len(self.views), self.device)
                if self.light.learned and self.prior is not None and self.options.shadow_start == "geometric":
                    self._follow(surface, stage.cell_size)
            elif surface.height.shape != grid.shape:
                ratio = stage.cell_size / self.stages[k - 1].cell_size
                surface = surface.resized(grid.shape, (ratio, ratio))
                self.light = self.light.resized(grid.shape, ratio)
            if stage.reflective:
                surface = self._reflective(surface, grid, saved[0] if saved else None)
            cast = self.coarse.cast if self.coarse else sun_visibility
            trainer = StageTrainer(surface, self.views, stage, self.resolved, self._prior_on(grid), k, self.light, cast)
            start = 0
            if saved:
                start = saved[1]["epoch"]
                trainer.load(saved[0])
                saved = None
            before = sum(s.epochs / s.cell_size**2 for s in self.stages[:k])
            if not trainer.run(start, self._after_epoch(trainer, stage, k, before, total, grid, score, progress)):
                remarks.append(f"stopped by the budget of {self.options.budget:g} s at cell {stage.cell_size:g} m")
                break
        assert surface is not None
        self.height_std = trainer.height_std()
        if isinstance(surface, ReflectiveScene):
            remarks += self._finish(surface, trainer, grid)
        progress(1.0, "fitted")
        return surface, grid, remarks

    @property
    def resolved(self) -> FitOptions:
        """The options with everything that was `auto` settled."""
        return replace(self.options, **self.settled)

    def _choose_light(self, surface: SurfaceScene, cell: float, saved: tuple[Any, dict[str, Any]] | None) -> list[str]:
        """Settle the model of the light, as an interrupted fit did; says why."""
        if saved or self.coarse:
            self.settled = self.coarse.settled if self.coarse else saved[1]["settled"]  # type: ignore[index]
            return []
        chosen, why = choose_light(surface, self.views, cell, self.options)
        self.settled = {"shadow": chosen.shadow, "transient": chosen.transient}
        return why

    def _follow(self, surface: SurfaceScene, cell: float) -> None:
        """Learned shadows begin at those of the start surface."""
        cast = self.coarse.cast if self.coarse else sun_visibility
        suns = [view.sun for view in self.views if view.sun]
        if suns:
            with torch.no_grad():
                found = {sun: cast(surface.casting(), cell, sun) for sun in set(suns)}
            self.light.follow(suns, [found[sun] for sun in suns], self.options.seed)

    def _start(self, grid: Grid) -> SurfaceScene:
        """The prior's surface, or a flat one; albedo = mean of the colour-matched images where they show it."""
        if self.prior is None:
            height = torch.full(grid.shape, self.z_ref)
        else:
            height = resample_map(self.prior[0], self.prior[2], grid).nan_to_num(self.z_ref)
        gain, offset = match_colours(self.views)
        if self.coarse:
            gain, offset = (self.coarse.colours[name].numpy() for name in ("gain", "offset"))
        elif self.radiance != "relative":
            gain, offset = np.ones_like(gain), np.zeros_like(offset)
        total = np.zeros_like(self.views[0].target)
        weight = np.zeros((*grid.shape, 1), np.float32)
        for view, a, b in zip(self.views, gain, offset, strict=True):
            picture, seen = shown_on(view, height.numpy(), grid.cell_size)
            total += seen * (picture - b) / a
            weight += seen
        albedo = torch.from_numpy(total / np.maximum(weight, 1)).float()
        scene = start_scene(height, albedo, torch.from_numpy(gain), torch.from_numpy(offset), START_AMBIENT)
        scene.absolute = self.radiance != "relative"
        return (self.coarse.hold(scene) if self.coarse else scene).to(self.device)

    def _reflective(self, surface: SurfaceScene, grid: Grid, saved: dict[str, Tensor] | None) -> ReflectiveScene:
        options = self.options
        assert options.brdf in ("rpv", "hapke")  # the schedule asks for a model only then
        if saved is not None:
            own = {name.removeprefix("scene."): t for name, t in saved.items() if name.startswith("scene.")}
            found = restored(own, options.brdf, grid.cell_size, options.material_smooth, surface.absolute)
            return found.to(self.device)  # type: ignore[return-value]
        frozen = None
        if options.normals == "prior":
            frozen = prior_normals(self.prior, grid).to(self.device)
        scale = [light_scale(self.radiance, view.sun) for view in self.views]
        found, _ = reflective(
            surface, options.brdf, self.views, scale, grid.cell_size, frozen, options.materials,
            options.material_smooth, options.seed,
        )  # fmt: skip
        return found

    def choose_brdf(self, stage: StageSettings) -> Choice:
        """Settle ``--brdf auto`` on the prior's surface.

        Raises:
            SceneError: there is no prior, or a sun is unknown.
        """
        grid = self.scene.need_grid().resized(stage.cell_size)
        self.views = views_on(self.sources, grid, self.z_ref, stage.z_range)
        scale = [light_scale(self.radiance, view.sun) for view in self.views]
        surface, lit = reflective(
            self._start(grid), "rpv", self.views, scale, grid.cell_size,
            prior_normals(self.prior, grid).to(self.device), self.options.materials, 0.0, self.options.seed, False,
        )  # fmt: skip
        cells, block = draw(surface.samples(self.views, lit, grid.cell_size), grid.shape, self.options.seed)
        return choose_model(cells, block, self.radiance == "relative")

    def _finish(self, surface: ReflectiveScene, trainer: StageTrainer, grid: Grid) -> list[str]:
        """Last inversion on the final heights; replaces the albedo by the reflectance at standard geometry."""
        self.parameter_std = surface.finish(self.views, trainer.visibility, grid.cell_size)
        return material_remarks(surface, self.parameter_std)

    def _prior_on(self, grid: Grid) -> Prior | None:
        if self.prior is None:
            return None
        height, confidence, own = self.prior
        return Prior(*(resample_map(m, own, grid).to(self.device) for m in (height, confidence)))

    def _after_epoch(
        self,
        trainer: StageTrainer,
        stage: StageSettings,
        k: int,
        before: float,
        total: float,
        grid: Grid,
        score: Callable[[Tensor, Grid], float | None],
        progress: Progress,
    ) -> Callable[[int, float], bool]:
        def call(done: int, loss: float) -> bool:
            row: dict[str, Any] = {"seconds": round(self.trace.seconds(), 3), "stage": k, "cell_m": stage.cell_size}
            row |= {"epoch": done, "softness_m": round(trainer.quadrature.softness, 4), "loss": loss}
            error = score(trainer.scene.height, grid)
            if error is not None:
                row["mae_m"] = error
            self.trace.rows.append(row)
            text = f"{stage.cell_size:g} m, epoch {done}/{stage.epochs}, loss {loss:.4f}"
            progress((before + done / stage.cell_size**2) / total, text + (f", mae {error:.2f} m" if error else ""))
            if done % REFRESH == 0 and done < stage.epochs:
                self._save(trainer, k, done)
            return not (self.options.budget and self.trace.seconds() > self.options.budget)

        return call

    def _scorer(self) -> Callable[[Tensor, Grid], float | None]:
        if self.options.reference is None:
            return lambda height, grid: None
        from sattools.compare import compare_dsm, read_reference

        truth = read_reference(self.options.reference)

        def call(height: Tensor, grid: Grid) -> float:
            # watching must not count as fitting
            pause = time.perf_counter()
            found = float(compare_dsm(height.detach().cpu().numpy(), truth, grid).figures["mae"])
            self.trace.started += time.perf_counter() - pause
            return found

        return call

    def _warn_spread(self, cell: float, remarks: list[str]) -> None:
        worst = max(self.views, key=lambda v: v.spread_m)
        if worst.spread_m > 0.5 * cell:
            text = f"{worst.id}: lines of sight are parallel only to {worst.spread_m:.2f} m over this area"
            log.warning(text)
            remarks.append(text)

    # ---- checkpoints ------------------------------------------------------------------------------------

    def _fingerprint(self) -> str:
        """Hash of everything that a continued fit must share with the interrupted one."""
        options = asdict(self.options)
        for name in ("resume", "budget", "reference"):
            options.pop(name)
        what = [options, [s.id for s in self.sources], self.scene.need_grid().to_dict(), self.z_ref]
        what.append([hashlib.sha256(s.radiance.tobytes()).hexdigest() for s in self.sources])
        return hashlib.sha256(json.dumps(what, sort_keys=True, default=str).encode()).hexdigest()

    def _save(self, trainer: StageTrainer, stage: int, epoch: int) -> None:
        meta = {"stage": stage, "epoch": epoch, "fingerprint": self._fingerprint(), "rows": self.trace.rows}
        meta["settled"] = self.settled
        checkpoint.save(self.scene.output(CHECKPOINT), trainer.state(), meta)

    def _resume(self) -> tuple[dict[str, Tensor], dict[str, Any]] | None:
        path = self.scene.output(CHECKPOINT)
        if not path.exists():
            log.warning("%s: no checkpoint, the fit starts anew", path)
            return None
        tensors, meta = checkpoint.load(path)
        if meta["fingerprint"] != self._fingerprint():
            raise SceneError(f"{path}: found a checkpoint of other options or images, expected the same; drop --resume")
        self.trace.rows = meta["rows"]
        self.trace.offset = self.trace.rows[-1]["seconds"]
        return tensors, meta


__all__ = ["Trace", "choose_device", "fit", "resample_map", "save_fit"]
