"""What a field that is trained ray by ray begins with: rays, the prior along them, and for a network a surface."""

from __future__ import annotations

import functools
from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
import torch
from torch import Tensor

from sattools.field.mlp import MlpField
from sattools.field.networks import NETWORKS
from sattools.field.neural import NeuralField
from sattools.field.protocol import Box, Field
from sattools.field.surface_base import KnownLight, SurfaceBase
from sattools.field.voxel import VoxelField
from sattools.fit.depth_prior import DepthPrior
from sattools.fit.materials.scene import ReflectiveScene
from sattools.fit.model import FittedModel
from sattools.fit.options import FitOptions
from sattools.fit.rays.rays import RaySet
from sattools.render import ParallelRays, Quadrature, plate_slopes, render
from sattools.render.visibility import Cast, sun_visibility
from sattools.scene import Grid
from sattools.scene.regrid import sample_map
from sattools.views import View, shown_on

VOXEL_PLANES_M = 1.0
PRIOR_SOFTNESS = 0.5  # [m]
AMBIENT = 0.2
LEAST_LIGHT = 0.05  # weight of an image that shows a place in shade


def box_over(grid: Grid, z_range: tuple[float, float]) -> Box:
    """The part of space over a grid."""
    east, north = grid.width * grid.cell_size, grid.height * grid.cell_size
    return Box((0.0, -north, z_range[0]), (east, 0.0, z_range[1]))


def base_surface(
    views: Sequence[View],
    prior: DepthPrior,
    z_range: tuple[float, float],
    gain: np.ndarray,
    offset: np.ndarray,
    *,
    shaded: bool,
    cast: Cast = sun_visibility,
) -> SurfaceBase:
    """The prior's surface with the colours that the images show there.

    Args:
        views: of the training, on the prior's grid.
        prior: heights, none unknown.
        z_range: lowest and highest height [m].
        gain: ``[V, C]`` of the images.
        offset: ``[V, C]`` of the images.
        shaded: take cast shadows out of the colours; a network without shadows must begin with the mean image.
        cast: sun visibility of heights on cells under a sun.
    """
    height, grid = prior.height, prior.grid
    lit = {sun: cast(height, grid.cell_size, sun).numpy() for sun in {v.sun for v in views} if sun and shaded}
    total, weight = np.zeros_like(views[0].target), np.zeros((*grid.shape, 1), np.float32)
    for view, a, b in zip(views, gain, offset, strict=True):
        picture, seen = shown_on(view, height.numpy(), grid.cell_size)
        visible = (lit[view.sun] if view.sun in lit else np.ones(grid.shape, np.float32))[..., None]
        counts = seen * (visible**2 + LEAST_LIGHT)
        total += counts * (picture - b) / a / (visible + (1 - visible) * AMBIENT)
        weight += counts
    colour = torch.from_numpy(total / np.maximum(weight, 1e-6)).float().clamp(0, 1)
    return SurfaceBase(box_over(grid, z_range), height, colour, PRIOR_SOFTNESS)


def known_light(
    views: Sequence[View], base: SurfaceBase, ambient: Tensor, *, learned: bool, cast: Cast = sun_visibility
) -> KnownLight | None:
    """How a base is lit under the suns of views, None where no sun is known.

    Args:
        views: of the training.
        base: the surface, on the views' grid.
        ambient: ``[V, C]`` light of the views in shade, as a share of the light in the sun.
        learned: whether a network learns the sun's visibility, and begins with the shadows that the surface casts.
        cast: sun visibility of heights on cells under a sun.
    """
    by_sun: dict[tuple[float, float, float], list[Tensor]] = {}
    for view, share in zip(views, ambient, strict=True):
        if view.sun is not None:
            by_sun.setdefault(view.sun, []).append(share)
    if not by_sun:
        return None
    shade = torch.stack([torch.stack(shares).mean(dim=0) for shares in by_sun.values()])
    cell = (base.box.high[0] - base.box.low[0]) / base.height.shape[1]
    visible = torch.stack([cast(base.height, cell, sun) for sun in by_sun]) if learned else None
    return KnownLight(torch.tensor(list(by_sun), dtype=torch.float32), shade.float(), visible)


@dataclass(frozen=True)
class Beginning:
    """What a field begins as, instead of the prior's surface and the mean image.

    Attributes:
        surface: that `fit` makes of the prior, with the reflectance model that the field has.
        notes: of that fit, for the history.
    """

    surface: FittedModel
    notes: list[str] = field(default_factory=list)

    def guide(self, prior: DepthPrior) -> DepthPrior:
        """What rays are guided by: the surface's heights [m] and normals, the prior's confidence."""
        normal = None if self.reflective is None else self.reflective.normals().detach()
        return DepthPrior(self.surface.height, prior.on(self.surface.grid).confidence, self.surface.grid, normal)

    @functools.cached_property
    def reflective(self) -> ReflectiveScene | None:
        """The surface with its reflectance model, None without."""
        scene = self.surface.surface()
        return scene if isinstance(scene, ReflectiveScene) else None

    def coloured(self, base: SurfaceBase, grid: Grid) -> SurfaceBase:
        """A base on a grid with these colours in [0, 1], or amplitudes, and shape parameters in their own units."""
        if self.reflective is None:
            colour = sample_map(self.surface.albedo.numpy(), self.surface.grid, grid)
            return replace(base, colour=torch.from_numpy(colour).float().clamp(0, 1))
        amplitude, shape = self.reflective.values()
        found = torch.cat([amplitude, torch.stack(list(shape), dim=-1)], dim=-1).detach().cpu()
        values = torch.from_numpy(sample_map(found.numpy(), self.surface.grid, grid)).float()
        return replace(base, colour=values[..., :-3].contiguous(), shape=values[..., -3:].contiguous())


def filled_prior(prior: DepthPrior, grid: Grid) -> DepthPrior:
    """The prior on the grid; unknown heights are the median, without confidence."""
    here = prior.on(grid)
    known = torch.isfinite(here.height)
    height = torch.where(known, here.height, here.height[known].median())
    return DepthPrior(height, torch.where(known, here.confidence.nan_to_num(0.0), 0.0).clamp(0, 1), grid, here.normal)


def ray_set(
    views: list[View], grid: Grid, z_range: tuple[float, float], prior: DepthPrior | None, *, normals: bool = True
) -> RaySet:
    """Every valid cell of every view as a ray through the height range, with the prior's depth along it.

    Args:
        views: the views.
        grid: ground grid.
        z_range: lowest and highest height [m].
        prior: depth supervision, or None.
        normals: of the prior's surface, too.
    """
    low, high = z_range
    rows, cols = grid.shape
    x = ((torch.arange(cols) + 0.5) * grid.cell_size).expand(rows, cols)
    y = (-(torch.arange(rows) + 0.5) * grid.cell_size)[:, None].expand(rows, cols)
    suns = torch.tensor([v.sun or (torch.nan,) * 3 for v in views], dtype=torch.float32)
    slopes = torch.tensor([(*v.slope, 1.0) for v in views], dtype=torch.float32)
    seen = [torch.from_numpy(view.mask) > 0 for view in views]
    count = sum(int(one.sum()) for one in seen)
    # filled view by view: parts beside their whole would need twice the memory
    target = torch.empty(count, views[0].target.shape[-1])
    place, depth, confidence = torch.empty(count, 2), torch.empty(count), torch.empty(count)
    number, normal = torch.empty(count, dtype=torch.int16), torch.empty(count, 3) if normals else None
    first = 0
    for j, (view, one) in enumerate(zip(views, seen, strict=True)):
        part = slice(first, first + int(one.sum()))
        first = part.stop
        rise = high - view.z_ref
        place[part] = torch.stack([x + view.slope.east * rise, y + view.slope.north * rise], dim=-1)[one]
        target[part], number[part] = torch.from_numpy(view.target)[one], j
        share, sure, upright = _prior_along(view, grid, z_range, prior)
        depth[part], confidence[part] = share[one], sure[one]
        if normal is not None:
            normal[part] = upright[one]
    return RaySet(
        place, target, number, depth, confidence, normal, (low - high) * slopes, suns,
        slopes / slopes.norm(dim=1, keepdim=True), high, bool((confidence > 0).any()),
    )  # fmt: skip


def _prior_along(
    view: View, grid: Grid, z_range: tuple[float, float], prior: DepthPrior | None
) -> tuple[Tensor, Tensor, Tensor]:
    """Where the rays of a view meet the prior: share of the path, confidence, normal."""
    low, high = z_range
    if prior is None:
        upright = torch.tensor([0.0, 0.0, 1.0]).expand(*grid.shape, 3)
        return torch.full(grid.shape, 0.5), torch.zeros(grid.shape), upright
    height, confidence = prior.height, prior.confidence
    normal = prior.normal
    if normal is None:
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
    *,
    base: SurfaceBase | None = None,
) -> Field:
    """The untrained field over the grid.

    Args:
        options: of the fit.
        grid: ground grid.
        z_range: lowest and highest height [m].
        z_ref: reference height [m].
        bands: of the images.
        prior: depth supervision, or None.
        base: what a network starts from, or None.
    """
    box = box_over(grid, z_range)
    if options.field == "mlp":
        return MlpField(NETWORKS[options.network], box, bands, options.width, options.seed, base=base)
    if options.field == "neural":
        assert base is not None  # `check` has seen to a prior
        return NeuralField(box, base)
    start = prior.height if prior is not None else torch.full(grid.shape, z_ref)
    planes = max(8, round((z_range[1] - z_range[0]) / VOXEL_PLANES_M))
    return VoxelField(box, (planes, *grid.shape), start, torch.full((*grid.shape, bands), 0.2))


def restored_field(model: FittedModel) -> Field:
    """The field of a model, as it was at the end of its training.

    Raises:
        KeyError, RuntimeError, TypeError: the model lacks what its kind needs.
    """
    own = {name.removeprefix("field."): t for name, t in model.extra.items() if name.startswith("field.")}
    low, high = (tuple(corner) for corner in model.extra["box"].tolist())
    box, bands = Box(low, high), model.albedo.shape[-1]
    field: Field
    start = {name.removeprefix("base."): t for name, t in model.extra.items() if name.startswith("base.")}
    base = SurfaceBase.restored(start, box) if start else None
    if model.field == "neural":
        if base is None:
            raise KeyError("base.height")
        field = NeuralField(box, base)
    elif model.field == "mlp":
        width = own["trunk.0.weight"].shape[0]
        field = MlpField(NETWORKS[str(model.network)], box, bands, width, base=base)
    else:
        planes, rows, cols = own["logits"].shape
        field = VoxelField(box, (planes, rows, cols), model.height, torch.zeros(rows, cols, bands))
    with torch.no_grad():
        for name, tensor in field.named_tensors().items():
            tensor.copy_(own[name])
    return field


__all__ = [
    "Beginning",
    "base_surface",
    "box_over",
    "filled_prior",
    "known_light",
    "make_field",
    "ray_set",
    "restored_field",
]
