"""The start of a fit with a reflectance model: materials by colour, parameters by inversion."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from sattools.fit.materials.endmembers import cluster_endmembers
from sattools.fit.materials.inversion import start_endmembers
from sattools.fit.materials.normals import surface_normals
from sattools.fit.materials.parameters import AMPLITUDE, Kind, diffuse
from sattools.fit.materials.scene import LIT, ReflectiveScene, Sky
from sattools.fit.materials.selection import draw, plain_materials
from sattools.fit.materials.sky import deep_shade
from sattools.fit.materials.steps import normals_within, smooth_heights
from sattools.fit.surface.scene import SurfaceScene
from sattools.render.visibility import Cast, sun_visibility
from sattools.views import View, shown_on

LOW_LIGHT = 0.15  # cosine of incidence below which a first albedo is not divided further
LEAST_SHADE = 30  # cells in deep shade that say how light it is there


def reflective(
    scene: SurfaceScene,
    kind: Kind,
    views: Sequence[View],
    scale: Sequence[float],
    cell_size: float,
    frozen: Tensor | None = None,
    *,
    endmembers: int,
    smooth: float,
    seed: int,
    solve: bool = True,
    sky: Sky = "none",
    bounce: bool = False,
    by_material: bool = False,
    cast: Cast = sun_visibility,
) -> tuple[ReflectiveScene, list[Tensor]]:
    """A scene with a reflectance model from one without: materials by colour, parameters by inversion.

    Args:
        scene: heights and albedo found so far.
        kind: model.
        views: images on the scene's grid; all with a known sun.
        scale: see `ReflectiveScene`.
        cell_size: [m].
        frozen: normals that stay, or None = those of the height.
        endmembers: most endmembers.
        smooth: weight of the amplitudes' smoothness.
        seed: of the clustering.
        solve: find endmembers and amplitudes, too.
        sky: light of the sky: none, fitted, auto = fitted and kept if it is surely there, or its share per band.
        bounce: with a sky, the ground around sends light as well.
        by_material: let materials that do without the model reflect as Lambert's law has it.
        cast: sun visibility of heights on cells under a sun.

    Returns:
        The scene, and the sun's visibility in every view.
    """
    height = scene.height.detach()
    suns = height.new_tensor([view.sun for view in views])
    view_vectors = height.new_tensor([view.slope.unit() for view in views])
    casting, steps = smooth_heights(height, cell_size)
    lit = {sun: cast(casting, cell_size, sun) for view in views if (sun := view.sun) is not None}
    visibility = [lit[view.sun] for view in views if view.sun is not None]
    normal = frozen
    if normal is None:
        normal = surface_normals(height, cell_size) if steps is None else normals_within(casting, cell_size, steps)
    cosines = [normal @ sun for sun in suns]
    colour, known, shaded = _first_colours(scene, views, scale, cell_size, visibility, cosines)
    abundances = cluster_endmembers(colour.cpu().numpy(), known.cpu().numpy(), endmembers, seed)
    modelled = ReflectiveScene(
        **scene.tensors(),
        absolute=scene.absolute,
        kind=kind,
        amplitude=torch.zeros_like(scene.albedo),
        endmembers=start_endmembers(kind, abundances.shape[-1], height),
        abundances=torch.from_numpy(abundances).to(height),
        suns=suns,
        view_vectors=view_vectors,
        scale=height.new_tensor(scale),
        cell_size=cell_size,
        frozen=frozen,
        smooth=smooth,
    )
    if solve:
        whole, _ = modelled.solve(views, visibility, 8, amplitudes=True)
        if by_material:
            cells, block = draw(whole, (height.shape[0], height.shape[1]), seed)
            plain, modelled.reasons = plain_materials(kind, cells, block, not scene.absolute)
            if plain.any():
                modelled.plain = plain
                modelled.solve(views, visibility, 8, amplitudes=True)
        if sky != "none":
            modelled.add_sky(views, visibility, sky, bounce)
        modelled.ambient = ambient_in_shade(modelled, shaded)
    return modelled, visibility


def _first_colours(
    scene: SurfaceScene,
    views: Sequence[View],
    scale: Sequence[float],
    cell_size: float,
    visibility: Sequence[Tensor],
    cosines: Sequence[Tensor],
) -> tuple[Tensor, Tensor, list[tuple[Tensor, Tensor]]]:
    """Albedo ``[H, W, C]`` without shading, by the views that see a cell in the sun, to tell materials by.

    Args:
        scene: heights and colours of the images.
        views: images on the scene's grid.
        scale: see `ReflectiveScene`.
        cell_size: [m].
        visibility: of the sun per view, ``[H, W]``.
        cosines: of the incidence per view, ``[H, W]``.

    Returns:
        It, where it is known ``[H, W]`` bool, and what `ambient_in_shade` takes of each view.
    """
    height = scene.height.detach()
    mean = torch.zeros_like(scene.albedo)
    total = torch.zeros_like(height)
    shaded: list[tuple[Tensor, Tensor]] = []
    for j, view in enumerate(views):
        picture, shown = shown_on(view, height.cpu().numpy(), cell_size)
        weight = torch.from_numpy(shown[..., 0]).to(height) * (visibility[j] > LIT)
        light = (torch.from_numpy(picture).to(height) - scene.offset[j]) / (scene.gain[j] * scale[j])
        mean += weight[..., None] * light / cosines[j].clamp_min(LOW_LIGHT)[..., None]
        shaded.append((light, torch.from_numpy(shown[..., 0]).to(height) * deep_shade(visibility[j])))
        total += weight
    return mean / total.clamp_min(1)[..., None], total > 0, shaded


@torch.no_grad()
def ambient_in_shade(scene: ReflectiveScene, shaded: Sequence[tuple[Tensor, Tensor]]) -> Tensor:
    """Light that reaches shade, per view and band ``[V, C]``, as deep shade shows it.

    Shade under a clear sky is far darker than any fit from a common start comes to be in a few passes, and ground that
    a fit takes for lighter than it is spoils every view that shows more of it. Where an image shows too little of it,
    the others' mean counts; where all do, the light stays.

    Args:
        scene: with its amplitudes.
        shaded: per view, light ``[H, W, C]`` as pi L / E, and 1 in deep shade ``[H, W]``, else 0.
    """
    usual = diffuse(scene.kind, AMPLITUDE[scene.kind].bounded(scene.amplitude)).clamp_min(1e-3)
    ambient, told = scene.ambient.clone(), []
    for j, (light, deep) in enumerate(shaded):
        ratio = (light / usual)[deep > 0]
        ratio = ratio[ratio.isfinite().all(-1)]
        if len(ratio) >= LEAST_SHADE:
            ambient[j] = ratio.median(0).values.clamp(0.02, 1.0)
            told.append(j)
    if told:
        others = [j for j in range(len(shaded)) if j not in told]
        ambient[others] = ambient[told].mean(0)
    return ambient


__all__ = ["ambient_in_shade", "reflective"]
