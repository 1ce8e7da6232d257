"""Light of an even sky: how much of it every cell sends up, past ground that hides a part of it; and that ground's.

The sky gives unobstructed level ground the irradiance `share` times that of the sun across its beam. A cell sends
share * gain * diffuse(amplitude) of it up, where `gain` is the model's own reflectance for the part of the sky that the
cell sees, over the plain `diffuse`: so the light follows the amplitude while the gain stays as it is.

Where ground takes the place of the sky it sends light of its own (one bounce): as much as the ground around does in the
mean, for it is not asked which cell sees which (Dozier and Frew 1990; Sandmeier and Itten 1997).
"""

from __future__ import annotations

import functools
import math

import torch
from torch import Tensor
from torch.nn.functional import avg_pool2d, max_pool2d

from sattools.fit.materials.blocks import blocks_of, typical
from sattools.fit.materials.blur import blurred
from sattools.fit.materials.parameters import Kind, diffuse, radiance_factor

SPOKES = 8
EVERY = 2  # cells along each side of a place at which the sky is looked at: its light changes slowly
BRIGHTEST = 0.25  # share of a sky under a clear sun; what is brighter is no shade, but lit ground whose height is wrong
LEAST_RATIO = 3.0  # a sky is taken where its share is more than so many standard deviations from none
LEAST_SHARE = 0.01  # and lights the ground by more than what strays into shade anyway
LEAST_BLOCKS = 5  # of ground in deep shade; fewer say nothing
SHADE = 0.05  # visibility of the sun below which a cell shows the sky's light alone
AROUND_M = 40.0  # standard deviation of the mean over the ground around: slopes face each other over tens of metres
EDGE_CELLS = 2  # shade is deep so far from its border, where neither optics nor a wrong place bring in sunlight


@functools.cache
def sky_directions() -> tuple[tuple[tuple[float, float, float], float], ...]:
    """Unit vectors (east, north, up) over the upper hemisphere, and solid angles over pi, which sum to 2.

    Gauss and Legendre's nodes in the height above the horizon, even steps around.
    """
    nodes = ((0.5 - math.sqrt(0.15), 5 / 18), (0.5, 8 / 18), (0.5 + math.sqrt(0.15), 5 / 18))
    found = []
    for ring, (up, weight) in enumerate(nodes):
        flat = math.sqrt(1 - up * up)
        for spoke in range(SPOKES):
            angle = (spoke + 0.25 + 0.5 * (ring % 2)) * 2 * math.pi / SPOKES  # off the axes, where walls run
            found.append(((flat * math.sin(angle), flat * math.cos(angle), up), 2 * weight / SPOKES))
    return tuple(found)


@torch.no_grad()
def sky_gain(
    kind: Kind,
    height: Tensor,
    normal: Tensor,
    cell_size: float,
    amplitude: Tensor,
    shape: tuple[Tensor, Tensor, Tensor],
    *,
    plain: Tensor | None = None,
) -> tuple[Tensor, Tensor]:
    """Light ``[H, W, C]`` that a cell sends up of a sky of share 1, over `diffuse` of its amplitude, and its open sky.

    The latter ``[H, W]`` is the irradiance over that of level ground under the whole sky; what it lacks to 1 falls on
    the cell from other ground.

    Args:
        kind: reflectance model.
        height: ``[H, W]`` of the surface that hides the sky [m].
        normal: ``[H, W, 3]`` unit vectors.
        cell_size: edge of a cell [m].
        amplitude: ``[H, W, C]`` within its range.
        shape: three ``[H, W]``.
        plain: share ``[H, W]`` of the ground that reflects as Lambert's law has it, or None.
    """
    from sattools.render import sun_visibility

    rows, cols = height.shape
    height, normal, amplitude = (_thinned(part) for part in (height, normal, amplitude))
    normal = normal / normal.norm(dim=-1, keepdim=True).clamp_min(1e-6)
    shape = (_thinned(shape[0]), _thinned(shape[1]), _thinned(shape[2]))
    plain = None if plain is None else _thinned(plain)
    up = normal.new_tensor([0.0, 0.0, 1.0])
    total, opened = torch.zeros_like(amplitude), torch.zeros_like(height)
    for direction, weight in sky_directions():
        seen, towards = sun_visibility(height, EVERY * cell_size, direction), normal.new_tensor(direction)
        light = radiance_factor(kind, normal, towards, up, amplitude, shape, plain=plain)
        total += weight * seen[..., None] * light
        opened += weight * seen * (normal @ towards).clamp_min(0)
    found = total / diffuse(kind, amplitude).clamp_min(1e-4), opened.clamp_max(1.0)
    gain, opened = (part.repeat_interleave(EVERY, 0).repeat_interleave(EVERY, 1)[:rows, :cols] for part in found)
    return gain, opened


def _thinned(values: Tensor) -> Tensor:
    """Means ``[H / EVERY, W / EVERY, ...]`` of cells ``[H, W, ...]``; at an edge, of those that there are."""
    rows, cols = values.shape[:2]
    flat = values.reshape(1, rows, cols, -1).movedim(-1, 1)
    means = avg_pool2d(flat, EVERY, EVERY, ceil_mode=True, count_include_pad=False)
    return means.movedim(1, -1)[0].reshape(*means.shape[2:], *values.shape[2:])


@torch.no_grad()
def light_of_ground(opened: Tensor, irradiance: Tensor, reflected: Tensor, cell_size: float) -> Tensor:
    """Irradiance ``[H, W, C]`` by the ground around, over that of the sun across its beam.

    Args:
        opened: ``[H, W]`` open sky of `sky_gain`.
        irradiance: ``[H, W, C]`` by sun and sky.
        reflected: ``[H, W, C]`` share of it that is sent back.
        cell_size: edge of a cell [m].
    """
    around = blurred((irradiance * reflected).movedim(-1, 0), AROUND_M / cell_size).movedim(0, -1)
    return (1 - opened)[..., None] * around


def deep_shade(visibility: Tensor) -> Tensor:
    """1 where ground lies in shade ``[H, W]``, at least `EDGE_CELLS` cells from light; else 0."""
    size = 2 * EDGE_CELLS + 1
    return (max_pool2d(visibility.detach()[None], size, 1, EDGE_CELLS)[0] < SHADE).to(visibility.dtype)


@torch.no_grad()
def share_in_shade(ratio: Tensor, shade: Tensor, shape: tuple[int, ...]) -> tuple[Tensor, float]:
    """Share of the sky per band ``[C]``, and that over its standard deviation in the surest band.

    What lights shade lights all ground. On lit ground a sky cannot be told from errors of the slopes: noisy normals
    take contrast from the shading just as an even light does, and a joint fit finds a sky where there is none.

    Args:
        ratio: ``[V, N, C]`` what the views show over what a sky of share 1 would show there.
        shade: ``[V, N]`` 1 = in deep shade, else 0.
        shape: of the grid of the N cells; neighbours repeat each other, so that blocks of them count.
    """
    dark = torch.nonzero(shade.sum(0) > 0)[:, 0]
    block = blocks_of((shape[0], shape[1])).to(dark)[dark]
    if len(torch.unique(block)) < LEAST_BLOCKS:
        return ratio.new_zeros(ratio.shape[-1]), 0.0
    weight = shade[:, dark, None]
    light = (weight * ratio[:, dark].nan_to_num(0.0)).sum(0) / weight.sum(0)  # [N, C]
    # sunlight that strays in, past heights and by optics, only ever adds
    found = [typical(light[:, band], block, strayed=True) for band in range(light.shape[1])]
    share = ratio.new_tensor([value for value, _ in found]).clamp_min(0.0)
    if float(share.max()) > BRIGHTEST:
        return torch.zeros_like(share), 0.0
    return share, max(value / max(error, 1e-9) for value, error in found)


__all__ = [
    "LEAST_RATIO", "LEAST_SHARE", "deep_shade", "light_of_ground", "share_in_shade", "sky_directions", "sky_gain",
]  # fmt: skip
