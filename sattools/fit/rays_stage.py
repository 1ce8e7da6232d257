"""`fit --field voxel|mlp`: pixels become rays, a field is trained on them, and its surface is read off."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import torch
from torch import Tensor

from sattools.errors import SceneError
from sattools.field.mlp import MlpField
from sattools.field.networks import NETWORKS
from sattools.field.protocol import Box, Field
from sattools.field.voxel import VoxelField
from sattools.fit.depth_prior import DepthPrior, reference_height
from sattools.fit.files import CHECKPOINT, Fitted
from sattools.fit.inputs import fingerprint
from sattools.fit.model import FittedModel
from sattools.fit.options import FitOptions
from sattools.fit.rays import RaySet, RayTrainer, concatenated
from sattools.fit.resume import Interrupted
from sattools.fit.trace import Row, Trace
from sattools.progress import Progress, subprogress
from sattools.render import ParallelRays, Quadrature, plate_slopes, render
from sattools.scene import Grid, Scene
from sattools.views import Source, View, match_colours, views_on

ROWS, SAVE_EVERY = 20, 5  # rows of the trace per fit; checkpoints among them
GROUND_SAMPLES = 128
VOXEL_PLANES_M = 1.0
VOXEL_RATES = {"logits": 0.1, "albedo": 0.03}
PRIOR_SOFTNESS = 0.5


def fit_rays(
    scene: Scene,
    sources: list[Source],
    options: FitOptions,
    prior: DepthPrior | None,
    device: torch.device,
    progress: Progress,
) -> Fitted:
    """Train a field ray by ray.

    Args:
        scene: with grid and height range.
        sources: the training images.
        options: of the fit.
        prior: depth supervision, or None.
        device: asked for; the fields run on the CPU.
        progress: told the share done.

    Raises:
        SceneError: a combination of options that cannot work.
    """
    trace = Trace()
    check(options, prior is not None, sources)
    grid, z_range = (
        scene.require_grid().resized(options.resolution or 2 * scene.require_grid().cell_size),
        scene.require_height_range(),
    )
    z_ref = reference_height(prior, z_range)
    views = views_on(sources, grid, z_ref, z_range)
    prior_here = None if prior is None else filled_prior(prior, grid)
    rays = ray_set(views, grid, z_range, prior_here)
    gain, offset = (torch.from_numpy(a) for a in match_colours(views))
    if options.shadow == "auto" or options.transient == "auto":
        raise SceneError("--shadow auto, --transient auto: expected --field surface; name the model for other fields")
    field = make_field(options, grid, z_range, z_ref, views[0].target.shape[-1], prior_here)
    rates = VOXEL_RATES if options.field == "voxel" else None
    trainer = RayTrainer(field, rays, options, gain, offset, rates)
    notes = ["computed on the CPU, where this field runs alone"] if device.type != "cpu" else []
    job = _RayJob(scene.output(CHECKPOINT), fingerprint(scene, options, sources, prior), trainer, grid, z_range, trace)
    notes += job.run(options, progress)
    height, height_std, albedo = read_surface(trainer, grid, z_range)
    model = FittedModel(
        grid=grid,
        items=[s.id for s in sources],
        suns=[v.sun for v in views],
        height=height,
        height_std=height_std,
        albedo=albedo,
        gain=trainer.colour["gain"].detach(),
        offset=trainer.colour["offset"].detach(),
        ambient=trainer.colour["ambient"].detach(),
        pose=torch.zeros(len(views), 2),
        slopes=[v.slope for v in views],
        z_ref=z_ref,
        shadow=options.shadow,
        transient=options.transient,
        field=options.field,
        network=options.network if options.field == "mlp" else None,
        extra={n: t.detach() for n, t in trainer.tensors.items() if n.startswith("field.")},
    )
    return Fitted(model, trace, notes)


def check(options: FitOptions, has_prior: bool, sources: list[Source]) -> None:
    """Refuse what cannot work.

    Args:
        options: of the fit.
        has_prior: whether there is one.
        sources: the images.
    """
    if options.guided and not has_prior:
        raise SceneError("--guided: found no prior to sample around, expected --prior-weight above 0")
    if options.field == "mlp" and options.shadow == "learned" and "sun" not in NETWORKS[options.network].heads:
        raise SceneError(f"--shadow learned: network {options.network} has no head for it, expected --shadow geometric")
    if options.solar_weight > 0 and (options.field != "mlp" or "sun" not in NETWORKS[options.network].heads):
        raise SceneError("--solar-weight: expected a network with learned shadows, --network satnerf")
    if options.field == "voxel" and options.shadow == "learned":
        raise SceneError("--shadow learned: a voxel field has no head for it, expected --shadow geometric")
    if options.brdf == "lambert":
        return
    if options.brdf == "auto":
        raise SceneError("--brdf auto: expected --field surface; name the model for other fields")
    if options.field == "voxel":
        raise SceneError(f"--brdf {options.brdf}: a voxel field has no head for it, expected --brdf lambert")
    if options.network != options.brdf:
        raise SceneError(
            f"--brdf {options.brdf}: network {options.network} has no head for it, expected --network {options.brdf}"
        )
    if options.normals != "prior" or not has_prior:
        raise SceneError(
            f"--brdf {options.brdf} with --field mlp: found no prior for its normals, expected --normals prior and a "
            "--prior-weight above 0"
        )


def filled_prior(prior: DepthPrior, grid: Grid) -> DepthPrior:
    """The prior on the grid; unknown heights are the median, without confidence."""
    here = prior.on(grid)
    known = torch.isfinite(here.height)
    height = torch.where(known, here.height, here.height[known].median())
    return DepthPrior(height, torch.where(known, here.confidence.nan_to_num(0.0), 0.0).clamp(0, 1), grid)


def ray_set(views: list[View], grid: Grid, z_range: tuple[float, float], prior: DepthPrior | None) -> RaySet:
    """Every valid cell of every view as a ray through the height range, with the prior's depth along it.

    Args:
        views: the views.
        grid: ground grid.
        z_range: lowest and highest height [m].
        prior: depth supervision, or None.
    """
    low, high = z_range
    rows, cols = grid.shape
    x = ((torch.arange(cols) + 0.5) * grid.cell_size).expand(rows, cols)
    y = (-(torch.arange(rows) + 0.5) * grid.cell_size)[:, None].expand(rows, cols)
    suns = torch.tensor([v.sun or (torch.nan,) * 3 for v in views], dtype=torch.float32)
    view_vectors = torch.tensor([(*v.slope, 1.0) for v in views], dtype=torch.float32)
    view_vectors = view_vectors / view_vectors.norm(dim=1, keepdim=True)
    parts = []
    for j, view in enumerate(views):
        slope = torch.tensor(view.slope)
        z = torch.tensor([high, low])
        ends = [
            torch.stack([x + slope[0] * (h - view.z_ref), y + slope[1] * (h - view.z_ref), h.expand(rows, cols)], -1)
            for h in z
        ]
        depth, confidence, normal = _prior_along(view, grid, z_range, prior)
        seen = torch.from_numpy(view.mask) > 0
        parts.append(
            RaySet(
                ends[0][seen], (ends[1] - ends[0])[seen], torch.from_numpy(view.target)[seen],
                torch.full((int(seen.sum()),), j), depth[seen], confidence[seen], normal[seen], suns, view_vectors,
                high,
            )
        )  # fmt: skip
    return concatenated(parts)


def _prior_along(
    view: View, grid: Grid, z_range: tuple[float, float], prior: DepthPrior | None
) -> tuple[Tensor, Tensor, Tensor]:
    """Where the rays of a view meet the prior: share of the path, confidence, normal."""
    low, high = z_range
    if prior is None:
        upright = torch.tensor([0.0, 0.0, 1.0]).expand(*grid.shape, 3)
        return torch.full(grid.shape, 0.5), torch.zeros(grid.shape), upright
    height, confidence = prior.height, prior.confidence
    # a wall is a step, not a slope: light that falls on a roof's rim is the roof's
    along, down = (slope / grid.cell_size for slope in plate_slopes(height))
    normal = torch.stack([-along, down, torch.ones_like(height)], dim=-1)  # rows run south
    normal = normal / normal.norm(dim=-1, keepdim=True)
    shown = torch.cat([height[..., None], confidence[..., None], normal], dim=-1).contiguous()
    soft = PRIOR_SOFTNESS
    quadrature = Quadrature(soft, soft / 1.5, high + 6 * soft, low - 10 * soft)
    maps, _, opacity = render(height, shown, ParallelRays(view.slope, view.z_ref), quadrature, grid.cell_size)
    maps = maps / opacity.clamp_min(1e-3)[..., None]
    share = ((high - maps[..., 0]) / (high - low)).clamp(0, 1)
    normal = maps[..., 2:] / maps[..., 2:].norm(dim=-1, keepdim=True).clamp_min(1e-6)
    return share, torch.where(opacity > 0.5, maps[..., 1], 0.0).clamp(0, 1), normal


def make_field(
    options: FitOptions,
    grid: Grid,
    z_range: tuple[float, float],
    z_ref: float,
    bands: int,
    prior: DepthPrior | None,
) -> Field:
    """The untrained field over the grid.

    Args:
        options: of the fit.
        grid: ground grid.
        z_range: lowest and highest height [m].
        z_ref: reference height [m].
        bands: of the images.
        prior: depth supervision, or None.
    """
    east, north = grid.width * grid.cell_size, grid.height * grid.cell_size
    box = Box((0.0, -north, z_range[0]), (east, 0.0, z_range[1]))
    if options.field == "mlp":
        return MlpField(NETWORKS[options.network], box, bands, options.width, options.seed)
    start = prior.height if prior is not None else torch.full(grid.shape, z_ref)
    planes = max(8, round((z_range[1] - z_range[0]) / VOXEL_PLANES_M))
    return VoxelField(box, (planes, *grid.shape), start, torch.full((*grid.shape, bands), 0.2))


def read_surface(trainer: RayTrainer, grid: Grid, z_range: tuple[float, float]) -> tuple[Tensor, Tensor, Tensor]:
    """Height, its spread and albedo on the grid.

    Args:
        trainer: of the field.
        grid: ground grid.
        z_range: lowest and highest height [m].
    """
    x = (torch.arange(grid.width) + 0.5) * grid.cell_size
    y = -(torch.arange(grid.height) + 0.5) * grid.cell_size
    return trainer.ground_maps(x, y, z_range, GROUND_SAMPLES)


@dataclass
class _RayJob:
    """One fit of a field from the first step to the last, with checkpoints.

    Attributes:
        path, fingerprint: of the checkpoint.
        trainer: of the field.
        grid, z_range: where its surface is read off to be scored.
        trace: of the fit.
    """

    path: Path
    fingerprint: str
    trainer: RayTrainer
    grid: Grid
    z_range: tuple[float, float]
    trace: Trace

    def run(self, options: FitOptions, progress: Progress) -> list[str]:
        """Train; notes."""
        trace, steps, start = self.trace, options.steps, 0
        if options.resume and (saved := Interrupted.load(self.path, self.fingerprint)):
            self.trainer.load(saved.tensors)
            trace.go_on(saved.rows)
            start = saved.step
        every = max(1, min(steps // ROWS, 500))
        total, count = 0.0, 0
        watch = subprogress(progress, 0.0, 0.95)
        for number in range(start, steps):
            begun = trace.seconds()
            total, count = total + self.trainer.step(number), count + 1
            done, now = number + 1, trace.seconds()
            # a step of a network can take a minute: none begins that would end after the budget
            over = bool(options.budget) and 2 * now - begun > (options.budget or 0) and done < steps
            if done % every == 0 or done == steps or over:
                row: Row = {"seconds": round(trace.seconds(), 3), "step": done, "loss": total / count}
                trace.rows.append(row | self._score(options.reference))
                watch(done / steps, f"step {done}/{steps}, loss {total / count:.5f}")
                total, count = 0.0, 0
                if done % (SAVE_EVERY * every) == 0 and done < steps:
                    Interrupted(self.trainer.state(), self.fingerprint, trace.rows, step=done).save(self.path)
            if over:
                return [f"stopped by the budget of {options.budget:g} s at step {done} of {steps}"]
        return []

    def _score(self, reference: str | None) -> Row:
        if reference is None:
            return {}
        import time

        from sattools.compare import compare_dsm, read_reference

        pause = time.perf_counter()
        height, _, _ = read_surface(self.trainer, self.grid, self.z_range)
        error = float(compare_dsm(height.numpy(), read_reference(reference), self.grid).figures["mae"])
        self.trace.started += time.perf_counter() - pause  # watching must not count as fitting
        return {"mae_m": error}


__all__ = ["fit_rays", "make_field", "ray_set", "read_surface"]
