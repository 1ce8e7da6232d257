"""`fit --field voxel|mlp`: pixels become rays, a field is trained on them, and its surface is read off."""

from __future__ import annotations

import logging
from typing import Any

import numpy as np
import torch
from torch import Tensor

from sattools.errors import SceneError
from sattools.field.mlp import MlpField
from sattools.field.networks import NETWORKS
from sattools.field.protocol import Box, Field
from sattools.field.voxel import VoxelField
from sattools.fit import checkpoint
from sattools.fit.files import CHECKPOINT
from sattools.fit.inputs import OTHER_FIT, PriorMaps, fingerprint
from sattools.fit.options import FitOptions
from sattools.fit.rays import RaySet, RayTrainer, join
from sattools.progress import Progress, subprogress
from sattools.render import ParallelRays, Quadrature, plate_slopes, render
from sattools.scene import Grid, Scene
from sattools.views import Source, View, match_colours, views_on

log = logging.getLogger(__name__)
NOTES, SAVE_EVERY = 20, 5  # rows of the trace per fit; checkpoints among them
GROUND_SAMPLES = 128
VOXEL_PLANES_M = 1.0
VOXEL_RATES = {"logits": 0.1, "albedo": 0.03}
PRIOR_SOFTNESS = 0.5


def fit_rays(
    scene: Scene,
    sources: list[Source],
    options: FitOptions,
    prior: PriorMaps | None,
    device: torch.device,
    trace: Any,
    progress: Progress,
) -> tuple[dict[str, Tensor], dict[str, Any], list[str]]:
    """Train a field ray by ray.

    Returns:
        Tensors and description of the model file (height, height_std, albedo as of the surface field, and the field's
        own), and notes.

    Raises:
        SceneError: a combination of options that cannot work.
    """
    check(options, prior is not None, sources)
    grid, z_range = (
        scene.require_grid().resized(options.resolution or 2 * scene.require_grid().cell_size),
        scene.require_height_range(),
    )
    z_ref = float(np.nanmedian(prior[0])) if prior else z_range[0] + 0.3 * (z_range[1] - z_range[0])
    views = views_on(sources, grid, z_ref, z_range)
    heights = prior_maps(prior, grid)
    rays = ray_set(views, grid, z_range, heights)
    gain, offset = (torch.from_numpy(a) for a in match_colours(views))
    if options.shadow == "auto" or options.transient == "auto":
        raise SceneError("--shadow auto, --transient auto: expected --field surface; name the model for other fields")
    field = make_field(options, grid, z_range, z_ref, views[0].target.shape[-1], heights)
    rates = VOXEL_RATES if options.field == "voxel" else None
    trainer = RayTrainer(field, rays, options, gain, offset, rates)
    notes = ["computed on the CPU, where this field runs alone"] if device.type != "cpu" else []
    notes += _train(scene, trainer, options, trace, progress, sources, prior, grid, z_range)
    maps = read_surface(trainer, grid, z_range)
    tensors = dict(zip(("height", "height_std", "albedo"), maps, strict=True))
    tensors |= {n: t.detach() for n, t in trainer.colour.items()}
    tensors["pose"] = torch.zeros(len(views), 2)
    tensors |= {n: t.detach() for n, t in trainer.tensors.items() if n.startswith("field.")}
    meta = {
        "field": options.field,
        "network": options.network if options.field == "mlp" else None,
        "grid": grid.to_dict(),
        "softness": 0.0,
        "items": [s.id for s in sources],
        "suns": [v.sun for v in views],
        "slopes": [v.slope for v in views],
        "z_ref": z_ref,
        "shadow": options.shadow,
        "transient": options.transient,
    }
    return tensors, meta, notes


def check(options: FitOptions, has_prior: bool, sources: list[Source]) -> None:
    """Refuse what cannot work."""
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


def prior_maps(prior: PriorMaps | None, grid: Grid) -> tuple[Tensor, Tensor] | None:
    """The prior's height and confidence ``[H, W]`` on the grid; unknown heights are the median, without confidence."""
    if prior is None:
        return None
    from sattools.fit.resample import resample_map

    height, confidence = (resample_map(m, prior[2], grid) for m in prior[:2])
    known = torch.isfinite(height)
    height = torch.where(known, height, height[known].median())
    return height, torch.where(known, confidence.nan_to_num(0.0), 0.0).clamp(0, 1)


def ray_set(
    views: list[View], grid: Grid, z_range: tuple[float, float], heights: tuple[Tensor, Tensor] | None
) -> RaySet:
    """Every valid cell of every view as a ray through the height range, with the prior's depth along it."""
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
        depth, confidence, normal = _prior_along(view, grid, z_range, heights)
        seen = torch.from_numpy(view.mask) > 0
        parts.append(
            RaySet(
                ends[0][seen], (ends[1] - ends[0])[seen], torch.from_numpy(view.target)[seen],
                torch.full((int(seen.sum()),), j), depth[seen], confidence[seen], normal[seen], suns, view_vectors,
                high,
            )
        )  # fmt: skip
    return join(parts)


def _prior_along(
    view: View, grid: Grid, z_range: tuple[float, float], heights: tuple[Tensor, Tensor] | None
) -> tuple[Tensor, Tensor, Tensor]:
    """Where the rays of a view meet the prior: share of the path, confidence, normal."""
    low, high = z_range
    if heights is None:
        upright = torch.tensor([0.0, 0.0, 1.0]).expand(*grid.shape, 3)
        return torch.full(grid.shape, 0.5), torch.zeros(grid.shape), upright
    height, confidence = heights
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
    heights: tuple[Tensor, Tensor] | None,
) -> Field:
    """The untrained field over the grid."""
    east, north = grid.width * grid.cell_size, grid.height * grid.cell_size
    box = Box((0.0, -north, z_range[0]), (east, 0.0, z_range[1]))
    if options.field == "mlp":
        return MlpField(NETWORKS[options.network], box, bands, options.width, options.seed)
    start = heights[0] if heights is not None else torch.full(grid.shape, z_ref)
    planes = max(8, round((z_range[1] - z_range[0]) / VOXEL_PLANES_M))
    return VoxelField(box, (planes, *grid.shape), start, torch.full((*grid.shape, bands), 0.2))


def read_surface(trainer: RayTrainer, grid: Grid, z_range: tuple[float, float]) -> tuple[Tensor, Tensor, Tensor]:
    """Height, its spread and albedo on the grid."""
    x = (torch.arange(grid.width) + 0.5) * grid.cell_size
    y = -(torch.arange(grid.height) + 0.5) * grid.cell_size
    return trainer.ground_maps(x, y, z_range, GROUND_SAMPLES)


def _train(
    scene: Scene,
    trainer: RayTrainer,
    options: FitOptions,
    trace: Any,
    progress: Progress,
    sources: list[Source],
    prior: PriorMaps | None,
    grid: Grid,
    z_range: tuple[float, float],
) -> list[str]:
    path, print_ = scene.output(CHECKPOINT), fingerprint(scene, options, sources, prior)
    start = 0
    if options.resume and path.exists():
        tensors, meta = checkpoint.load(path)
        if meta.get("fingerprint") != print_:
            raise SceneError(f"{path}: {OTHER_FIT}")
        trainer.load(tensors)
        start, trace.rows, trace.offset = meta["step"], meta["rows"], meta["rows"][-1]["seconds"]
    elif options.resume:
        log.warning("%s: no checkpoint, the fit starts anew", path)
    note = max(1, min(options.steps // NOTES, 500))
    total, count = 0.0, 0
    watch = subprogress(progress, 0.0, 0.95)
    for number in range(start, options.steps):
        begun = trace.seconds()
        total, count = total + trainer.step(number), count + 1
        done, now = number + 1, trace.seconds()
        # a step of a network can take a minute: none begins that would end after the budget
        over = bool(options.budget) and 2 * now - begun > (options.budget or 0) and done < options.steps
        if done % note == 0 or done == options.steps or over:
            row = {"seconds": round(trace.seconds(), 3), "step": done, "loss": total / count}
            row |= _score(trainer, options, grid, z_range, trace)
            trace.rows.append(row)
            watch(done / options.steps, f"step {done}/{options.steps}, loss {total / count:.5f}")
            total, count = 0.0, 0
            if done % (SAVE_EVERY * note) == 0 and done < options.steps:
                checkpoint.save(path, trainer.state(), {"step": done, "fingerprint": print_, "rows": trace.rows})
        if over:
            return [f"stopped by the budget of {options.budget:g} s at step {done} of {options.steps}"]
    return []


def _score(
    trainer: RayTrainer, options: FitOptions, grid: Grid, z_range: tuple[float, float], trace: Any
) -> dict[str, float]:
    if options.reference is None:
        return {}
    import time

    from sattools.compare import compare_dsm, read_reference

    pause = time.perf_counter()
    height, _, _ = read_surface(trainer, grid, z_range)
    error = float(compare_dsm(height.numpy(), read_reference(options.reference), grid).figures["mae"])
    trace.started += time.perf_counter() - pause  # watching must not count as fitting
    return {"mae_m": error}


__all__ = ["fit_rays", "make_field", "ray_set", "read_surface"]
