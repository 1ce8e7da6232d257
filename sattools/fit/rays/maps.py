"""Maps of a field that was trained ray by ray: what vertical rays see, and what every image saw on the ground."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass

import torch
from torch import Tensor

from sattools.field.mlp import MlpField
from sattools.field.neural import NeuralField
from sattools.field.protocol import Field
from sattools.fit.rays.losses import BETA_MIN
from sattools.fit.rays.scene import HAPKE_B_MAX, RayScene
from sattools.fit.rays.scene import SHOWN as RESTING
from sattools.render.volume import RayBatch, composite, median_share, seen_shares, stratified
from sattools.scene import Grid

COARSE, FINE = 64, 48  # samples per vertical ray, and around its median
REACH = 2.0  # of the fine samples, in distances of the coarse ones
FREE, AROUND, FINE_AROUND = 8, 16, 12  # where a network starts from a surface: anywhere, around it, around the median
AROUND_M, FINE_M = 4.0, 1.0
SHOWN = 16  # samples of a vertical ray whose colours count
ROWS = 32  # of columns that are read at once
COLUMNS_ON_DEVICE = 8192  # of a network, of which a layer of 512 then holds 0.5 GB
MAP_HEADS = ("b", "c", "theta", "k", "rhoc")  # parameters of reflectance models, beside the amplitude
IMAGE_HEADS = {"sun": "s_net", "tau": "tau", "beta": "beta"}  # answers that differ between images


@dataclass(frozen=True)
class GroundMaps:
    """What is read off a field.

    Attributes:
        height: ``[H, W]`` median of the transmittance [m].
        height_std: ``[H, W]`` standard deviation of the transmittance's height [m].
        albedo: ``[H, W, C]``.
        heads: ``[H, W]`` parameters of a reflectance model by name.
        images: ``[V, H, W]`` by name of the product: learned sun visibility, transmission of transients, uncertainty.
    """

    height: Tensor
    height_std: Tensor
    albedo: Tensor
    heads: dict[str, Tensor] = dataclasses.field(default_factory=dict)
    images: dict[str, Tensor] = dataclasses.field(default_factory=dict)


@torch.no_grad()
def read_maps(scene: RayScene, grid: Grid, z_range: tuple[float, float], per_image: bool = True) -> GroundMaps:
    """Read a field off on a grid.

    Args:
        scene: the field with its images.
        grid: ground grid.
        z_range: lowest and highest height [m].
        per_image: also what differs between images.
    """
    low, high = z_range
    x = (torch.arange(grid.width) + 0.5) * grid.cell_size
    rows: list[dict[str, Tensor]] = []
    per_image = per_image and not scene.field.heads.isdisjoint(IMAGE_HEADS)
    # a network keeps hundreds of numbers of every point; columns are laid out anew for each question
    at_once = rows_at_once(scene, grid)
    for part in torch.arange(grid.height, device=x.device).split(at_once):
        y, z = -(part + 0.5) * grid.cell_size, x.new_tensor(high)
        start = torch.stack(torch.broadcast_tensors(x, y[:, None], z), dim=-1).flatten(0, 1)
        batch = RayBatch(start, start.new_tensor([0.0, 0.0, low - high]).expand_as(start))
        t, weights, features = _columns(scene, batch, *_first_samples(scene, start, z_range))
        share, total = median_share(weights, t), weights.sum(dim=1).clamp_min(1e-6)
        centre = (weights * t).sum(dim=1) / total
        spread = ((weights * (t - centre[:, None]) ** 2).sum(dim=1) / total).sqrt()
        found = {"height": high - (high - low) * share, "height_std": spread * (high - low)}
        weights, features = _shown(scene, batch, t, weights, features)
        total = weights.sum(dim=1).clamp_min(1e-6)
        answers = scene.field.look(features.flatten(0, 1), None, None)
        for name in ("albedo", *MAP_HEADS):
            if name in answers:
                values = answers[name].reshape(*weights.shape, -1)
                found[name] = (weights[..., None] * values).sum(dim=1) / total[:, None]
        if per_image:
            found |= _per_image(scene, torch.cat([start[:, :2], found["height"][:, None]], dim=1))
        rows.append(found)
    maps = {n: torch.cat([row[n] for row in rows]).unflatten(0, (grid.height, grid.width)) for n in rows[0]}
    heads = {name: maps[name][..., 0] for name in MAP_HEADS if name in maps}
    if "b" in heads:
        heads["b"] = heads["b"].clamp_max(HAPKE_B_MAX)
    images = {name: maps[name].permute(2, 0, 1).contiguous() for name in IMAGE_HEADS.values() if name in maps}
    if "beta" in images:
        images["beta"] += BETA_MIN
    return GroundMaps(maps["height"], maps["height_std"], maps["albedo"], heads, images)


def rows_at_once(scene: RayScene, grid: Grid) -> int:
    """Rows of a grid that are read at once.

    A row of a network is as much as a CPU's caches hold; a GPU would wait for the questions.

    Args:
        scene: the field with its images.
        grid: ground grid.
    """
    if isinstance(scene.field, NeuralField):
        return ROWS
    return 1 if scene.device.type == "cpu" else max(1, COLUMNS_ON_DEVICE // grid.width)


def _first_samples(scene: RayScene, start: Tensor, z_range: tuple[float, float]) -> tuple[Tensor, float, int]:
    """Shares of vertical rays ``[R, S]`` in [0, 1] to look at first; reach and number of those around their median."""
    low, high = z_range
    known = _known_surfaces(scene.field, start)
    if not known:
        return stratified(len(start), COARSE, None), REACH / COARSE, FINE
    t = stratified(len(start), FREE, None)
    for height in known:
        around = _around((high - height) / (high - low), AROUND_M / (high - low), AROUND)
        t = torch.cat([t, around], dim=1).sort(dim=1).values
    return t, FINE_M / (high - low), FINE_AROUND


def _known_surfaces(field: Field, points: Tensor) -> list[Tensor]:
    """Heights ``[N]`` [m] over or under points ``[N, 3]`` [m] that a field can have its surface at, if it knows any."""
    if isinstance(field, NeuralField):
        return list(field.choices(points))
    base = getattr(field, "base", None)
    return [] if base is None else [base.heights(points)]


def _around(share: Tensor, reach: float, count: int) -> Tensor:
    """``count`` shares ``[R, count]`` in [0, 1], evenly within ``reach`` of ``share`` ``[R]``, ascending."""
    near = (torch.arange(count) + 0.5) / count * 2 - 1
    return (share[:, None] + reach * near).clamp(0, 1)


def _columns(
    scene: RayScene, batch: RayBatch, t: Tensor, reach: float, fine: int
) -> tuple[Tensor, Tensor, Tensor | None]:
    """Samples ``[R, S]``, their weights and their features ``[R, S, F]``.

    There are none of a network at rest: its density is that of the surface it starts from, which asks no network.
    """
    if scene.at_rest:

        def weights(t: Tensor) -> Tensor:
            return _weights(batch, t, scene.density(batch.points(t)))

        t = torch.cat([t, _around(median_share(weights(t), t), reach, fine)], dim=1).sort(dim=1).values
        return t, weights(t), None
    known = _seen(scene, batch, t)
    more = _around(median_share(_weights(batch, t, known[0]), t), reach, fine)
    t, (sigma, features) = _merged(t, known, more, _seen(scene, batch, more))
    return t, _weights(batch, t, sigma), features


def _shown(
    scene: RayScene, batch: RayBatch, t: Tensor, weights: Tensor, features: Tensor | None
) -> tuple[Tensor, Tensor]:
    """Weights ``[R, K]`` and features ``[R, K, F]`` of the samples that are seen most.

    The others cost a network as much, and change nothing.
    """
    if features is None:
        t = seen_shares(weights, t, RESTING, None)
        return torch.full_like(t, 1 / RESTING), _seen(scene, batch, t)[1]
    if not isinstance(scene.field, MlpField):
        return weights, features
    weights, most = weights.topk(min(SHOWN, t.shape[1]), dim=1)
    return weights, features.gather(1, most[..., None].expand(-1, -1, features.shape[-1]))


Answers = tuple[Tensor, Tensor]  # densities [R, S], features [R, S, F]


def _seen(scene: RayScene, batch: RayBatch, t: Tensor) -> Answers:
    """What the field answers at samples."""
    sigma, features = scene.field.density(batch.points(t).reshape(-1, 3))
    return sigma.reshape(t.shape), features.reshape(*t.shape, -1)


def _weights(batch: RayBatch, t: Tensor, sigma: Tensor) -> Tensor:
    """Weights ``[R, S]`` of samples."""
    return composite(sigma, t, batch.rise)[0]


def _merged(t: Tensor, answers: Answers, more: Tensor, others: Answers) -> tuple[Tensor, Answers]:
    """Samples and what was answered there, with others among them, ascending: no point is asked twice."""
    t, order = torch.cat([t, more], dim=1).sort(dim=1)
    sigma = torch.cat([answers[0], others[0]], dim=1).gather(1, order)
    features = torch.cat([answers[1], others[1]], dim=1)
    return t, (sigma, features.gather(1, order[..., None].expand_as(features)))


def _per_image(scene: RayScene, surface: Tensor) -> dict[str, Tensor]:
    """Answers ``[W, V]`` at surface points ``[W, 3]`` for every image; nan where its sun is unknown."""
    _, features = scene.field.density(surface)
    found: dict[str, list[Tensor]] = {}
    for sun, embedding in zip(scene.rays.suns, scene.embedding.detach(), strict=True):
        answers = scene.field.look(features, *(v.expand(len(surface), -1) for v in (sun, embedding)))
        for name, product in IMAGE_HEADS.items():
            if name in answers:
                found.setdefault(product, []).append(answers[name][:, 0])
    return {product: torch.stack(views, dim=1) for product, views in found.items()}


__all__ = ["IMAGE_HEADS", "MAP_HEADS", "GroundMaps", "read_maps", "rows_at_once"]
