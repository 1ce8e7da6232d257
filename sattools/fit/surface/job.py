"""The fit of a surface, stage by stage."""

from __future__ import annotations

import functools
import logging
import time
from collections.abc import Callable
from dataclasses import dataclass, field, replace

import numpy as np
import torch
from torch import Tensor

from sattools.fit.around import casting, of_the_area
from sattools.fit.depth_prior import DepthPrior
from sattools.fit.described import Radiance
from sattools.fit.files import CHECKPOINT
from sattools.fit.illumination import levels, light_scale, material_notes, prior_normals
from sattools.fit.inputs import fingerprint
from sattools.fit.materials.scene import ReflectiveScene, restored
from sattools.fit.materials.selection import Choice, choose_model, draw
from sattools.fit.materials.start import reflective
from sattools.fit.options import FitOptions
from sattools.fit.resume import IlluminationOptions, Interrupted
from sattools.fit.surface.light import IlluminationModel
from sattools.fit.surface.light_selection import choose_light
from sattools.fit.surface.scene import SurfaceScene, start_scene
from sattools.fit.surface.trainer import REFRESH, StageSettings, StageTrainer
from sattools.fit.tiles.shared import Coarse
from sattools.fit.trace import Row, Trace
from sattools.progress import Progress
from sattools.render.around import Around
from sattools.render.visibility import Cast
from sattools.scene import Grid, Scene
from sattools.scene.jsonio import JsonObject
from sattools.views import Source, View, match_colours, shown_on, views_on

log = logging.getLogger(__name__)
START_AMBIENT = 0.4
WORTH_SAYING = 0.01  # share of the cells
STRAY_M = 2.0  # distance from the prior beyond which a cell of the fit is a step moved to the wrong place, mostly


@dataclass
class SurfaceJob:
    """One fit of a surface from the first stage to the last, with checkpoints."""

    scene: Scene
    sources: list[Source]
    options: FitOptions
    stages: list[StageSettings]
    prior: DepthPrior | None
    z_ref: float
    device: torch.device
    radiance: Radiance = "relative"
    trace: Trace = field(default_factory=Trace)
    views: list[View] = field(default_factory=list)
    last_softness: float = 0.0
    height_std: Tensor = field(default_factory=lambda: torch.zeros(0))
    parameter_std: dict[str, Tensor] = field(default_factory=dict)
    illumination: IlluminationModel = field(default_factory=lambda: IlluminationModel({}))
    chosen: IlluminationOptions | None = None
    why_light: list[str] = field(default_factory=list)
    coarse: Coarse | None = None
    around: Around | None = None
    basis: JsonObject = field(default_factory=dict)  # of a checkpoint, see `Interrupted`
    by_material: bool = False  # the reflectance model may be left out for materials that do without it
    lasting: bool = True  # leaves checkpoints; the start of another field is fitted anew

    def run(self, progress: Progress) -> tuple[SurfaceScene, Grid, list[str]]:
        """Fit all stages; the surface, its grid, and notes."""
        notes: list[str] = []
        saved = self._resume() if self.options.resume else None
        score = self._scorer()
        surface: SurfaceScene | None = None
        grid = self.scene.require_grid()
        for k, stage in enumerate(self.stages):
            grid = self.scene.require_grid().resized(stage.cell_size)
            self.last_softness = stage.softness[1]
            if saved and k < saved.stage:
                continue
            self.views = self._views_on(grid, stage)
            self._warn_parallel(stage.cell_size, notes)
            surface = self._begin_stage(surface, k, grid, saved, notes)
            trainer = self._trainer(surface, k, grid)
            start = 0
            if saved:
                start = saved.epoch
                trainer.load(saved.tensors)
                saved = None
            if not trainer.run(start, self._after_epoch(trainer, k, grid, score, progress)):
                notes.append(f"stopped by the budget of {self.options.budget:g} s at cell {stage.cell_size:g} m")
                break
        assert surface is not None
        notes += self._put_back(surface, grid)
        self.height_std = trainer.height_std()
        if isinstance(surface, ReflectiveScene):
            notes += self._finish(surface, trainer)
        return surface, grid, notes

    def _begin_stage(
        self, surface: SurfaceScene | None, k: int, grid: Grid, saved: Interrupted | None, notes: list[str]
    ) -> SurfaceScene:
        """The surface that stage ``k`` starts from: a new one, or the last stage's on the grid of this one."""
        stage = self.stages[k]
        if surface is None:
            surface = self._start(grid)
            notes += self._choose_light(surface, stage.cell_size, saved)
            self.illumination = IlluminationModel.start(self.resolved, grid.shape, len(self.views), self.device)
            if self.illumination.learned and self.prior is not None and self.options.shadow_start == "geometric":
                self._follow(surface, stage.cell_size)
        elif surface.height.shape != grid.shape:
            ratio = stage.cell_size / self.stages[k - 1].cell_size
            surface = surface.resized(grid.shape, (ratio, ratio))
            self.illumination = self.illumination.resized(grid.shape, ratio)
        if stage.reflective:
            surface = self._reflective(surface, grid, saved)
        return surface

    def _views_on(self, grid: Grid, stage: StageSettings) -> list[View]:
        """The images on the cells of a stage, without what they show of the ground around the area."""
        views = views_on(self.sources, grid, self.z_ref, stage.z_range)
        height = None if self.prior is None else self.prior.on(grid).height.nan_to_num(self.z_ref)
        return of_the_area(views, self.around, height, grid.cell_size, stage.z_range)

    @property
    def _cast(self) -> Cast:
        return casting(self.around)

    def _trainer(self, surface: SurfaceScene, k: int, grid: Grid) -> StageTrainer:
        prior = self.prior.on(grid, self.device) if self.prior else None
        return StageTrainer(
            surface,
            self.views,
            self.stages[k],
            self.resolved,
            prior,
            k,
            illumination=self.illumination,
            cast=self._cast,
        )

    def _work(self, stages: int) -> float:
        """Work of the first stages, in epochs times cells per square metre."""
        return sum(s.epochs / s.cell_size**2 for s in self.stages[:stages])

    @property
    def resolved(self) -> FitOptions:
        """The options with everything that was `auto` chosen."""
        return replace(self.options, **vars(self.chosen)) if self.chosen else self.options

    def _choose_light(self, surface: SurfaceScene, cell: float, saved: Interrupted | None) -> list[str]:
        """Choose the illumination model, or take that of the interrupted fit; the reasons."""
        if self.coarse:
            self.chosen = self.coarse.illumination
            return []
        if saved:
            self.chosen, self.why_light = saved.illumination, saved.light
            return self.why_light
        chosen, self.why_light = choose_light(surface, self.views, cell, self.options, self._cast)
        self.chosen = IlluminationOptions(chosen.shadow, chosen.transient)
        return self.why_light

    def _follow(self, surface: SurfaceScene, cell: float) -> None:
        """Learned shadows begin at those of the start surface."""
        suns = [view.sun for view in self.views if view.sun]
        if suns:
            with torch.no_grad():
                visibility = {sun: self._cast(surface.casting(), cell, sun) for sun in set(suns)}
            self.illumination.follow(suns, [visibility[sun] for sun in suns], self.options.seed)

    def _start(self, grid: Grid) -> SurfaceScene:
        """The prior's surface, or a flat one; albedo = mean of the colour-matched images where they show it."""
        if self.prior is None:
            height = torch.full(grid.shape, self.z_ref)
        else:
            height = self.prior.on(grid).height.nan_to_num(self.z_ref)
        gain, offset = match_colours(self.views)
        if self.coarse:
            gain, offset = (self.coarse.colours[name].numpy() for name in ("gain", "offset"))
        elif self.radiance != "relative":
            # a reflectance model has the cosine of the incidence itself
            gain, offset = np.ones_like(gain), np.zeros_like(offset)
            if self.options.brdf == "lambert":
                gain = levels(self.radiance, [view.sun for view in self.views], gain.shape[1])
        total = np.zeros_like(self.views[0].target)
        weight = np.zeros((*grid.shape, 1), np.float32)
        for view, a, b in zip(self.views, gain, offset, strict=True):
            picture, seen = shown_on(view, height.numpy(), grid.cell_size)
            total += seen * (picture - b) / a
            weight += seen
        albedo = torch.from_numpy(total / np.maximum(weight, 1)).float()
        absolute = self.radiance != "relative"
        scene = start_scene(height, albedo, torch.from_numpy(gain), torch.from_numpy(offset), START_AMBIENT, absolute)
        return (self.coarse.hold(scene) if self.coarse else scene).to(self.device)

    def _reflective(self, surface: SurfaceScene, grid: Grid, saved: Interrupted | None) -> ReflectiveScene:
        options = self.options
        assert options.brdf in ("rpv", "hapke")  # the schedule asks for a model only then
        if saved is not None:
            own = {n.removeprefix("scene."): t for n, t in saved.tensors.items() if n.startswith("scene.")}
            modelled = restored(own, options.brdf, grid.cell_size, options.material_smooth, surface.absolute)
            modelled = modelled.to(self.device)  # type: ignore[assignment]
            modelled.reasons, modelled.sky_ratio = saved.reasons, saved.sky_ratio
            return modelled
        frozen = None
        if options.normals == "prior":
            frozen = prior_normals(self.prior, grid).to(self.device)
        scale = [light_scale(self.radiance, view.sun) for view in self.views]
        modelled, _ = reflective(
            surface,
            options.brdf,
            self.views,
            scale,
            grid.cell_size,
            frozen,
            endmembers=options.materials,
            smooth=options.material_smooth,
            seed=options.seed,
            sky=options.sky_share or options.sky,
            bounce=options.bounce,
            by_material=self.by_material,
            cast=self._cast,
        )
        return modelled

    def choose_brdf(self, stage: StageSettings) -> Choice:
        """Choose the model for ``--brdf auto`` on the prior's surface.

        Raises:
            SceneError: there is no prior, or a sun is unknown.
        """
        grid = self.scene.require_grid().resized(stage.cell_size)
        self.views = self._views_on(grid, stage)
        scale = [light_scale(self.radiance, view.sun) for view in self.views]
        surface, lit = reflective(
            self._start(grid),
            "rpv",
            self.views,
            scale,
            grid.cell_size,
            prior_normals(self.prior, grid).to(self.device),
            endmembers=self.options.materials,
            smooth=0.0,
            seed=self.options.seed,
            solve=False,
            cast=self._cast,
        )
        cells, block = draw(surface.samples(self.views, lit), grid.shape, self.options.seed)
        return choose_model(cells, block, self.radiance == "relative")

    def _put_back(self, surface: SurfaceScene, grid: Grid) -> list[str]:
        """Cells that ended far from the prior get its height back; says so if many do.

        All views at once place steps better than a loss that can trade a wall's place for the colour of its facade. A
        height of no confidence is the prior's guess, for the fit to judge.
        """
        if self.prior is None:
            return []
        prior = self.prior.on(grid, self.device)
        with torch.no_grad():
            stray = ((surface.height - prior.height).abs() > STRAY_M) & (prior.confidence > 0)
            # matching tries a plane beyond either end of the heights; the surface keeps to them
            surface.height[stray] = prior.height[stray].clamp(*self.stages[-1].z_range)
        share = float(stray.float().mean())
        if share < WORTH_SAYING:
            return []
        return [f"{100 * share:.1f} % of the cells strayed from the prior by more than {STRAY_M:g} m: put back"]

    def _finish(self, surface: ReflectiveScene, trainer: StageTrainer) -> list[str]:
        """Last inversion on the final heights; replaces the albedo by the reflectance at standard geometry."""
        self.parameter_std = surface.finish(self.views, trainer.visibility)
        return material_notes(surface, self.parameter_std, self.options.sky)

    def _after_epoch(
        self,
        trainer: StageTrainer,
        k: int,
        grid: Grid,
        score: Callable[[Tensor, Grid], float | None],
        progress: Progress,
    ) -> Callable[[int, float], bool]:
        stage, before, total = self.stages[k], self._work(k), self._work(len(self.stages))

        def call(done: int, loss: float) -> bool:
            row: Row = {"seconds": round(self.trace.seconds(), 3), "stage": k, "cell_m": stage.cell_size}
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
            error = float(compare_dsm(height.detach().cpu().numpy(), truth, grid).figures["mae"])
            self.trace.started += time.perf_counter() - pause
            return error

        return call

    def _warn_parallel(self, cell: float, notes: list[str]) -> None:
        worst = max(self.views, key=lambda v: v.parallel_ray_error_m)
        if worst.parallel_ray_error_m > 0.5 * cell:
            text = f"{worst.id}: lines of sight are parallel only to {worst.parallel_ray_error_m:.2f} m over this area"
            log.warning(text)
            notes.append(text)

    # ---- checkpoints ------------------------------------------------------------------------------------

    @functools.cached_property
    def _print(self) -> str:
        return fingerprint(self.scene, self.options, self.sources, self.prior)

    def _save(self, trainer: StageTrainer, stage: int, epoch: int) -> None:
        if not self.lasting:
            return
        where = (self.trace.rows, stage, epoch)
        state = Interrupted(
            trainer.state(), self._print, *where, illumination=self.chosen, light=self.why_light, basis=self.basis,
            seconds=self.trace.seconds(),
        )  # fmt: skip
        if isinstance(trainer.scene, ReflectiveScene):
            state = replace(state, reasons=trainer.scene.reasons, sky_ratio=trainer.scene.sky_ratio)
        state.save(self.scene.output(CHECKPOINT))

    def _resume(self) -> Interrupted | None:
        saved = Interrupted.load(self.scene.output(CHECKPOINT), self._print)
        if saved:
            self.trace.go_on(saved.rows, saved.seconds)
        return saved


__all__ = ["SurfaceJob"]
