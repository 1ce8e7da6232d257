"""Volume rendering of single rays: sampling, compositing, light of the sun."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

LOW_SUN = 0.25  # sine of its elevation, 14 degrees


@dataclass(frozen=True)
class RayBatch:
    """Rays of one or several views.

    Attributes:
        start: ``[R, 3]`` where they enter the box at its highest height [m].
        path: ``[R, 3]`` from there to the lowest height [m].
    """

    start: Tensor
    path: Tensor

    def points(self, t: Tensor) -> Tensor:
        """Points ``[R, S, 3]`` at shares ``[R, S]`` of the path."""
        return self.start[:, None] + t[..., None] * self.path[:, None]

    @property
    def rise(self) -> Tensor:
        """Heights ``[R]`` that the paths cross [m].

        Densities are integrated over these: over a slant length, a soft surface would be seen the higher the more
        obliquely it is looked at, at 60 degrees by nine tenths of its softness.
        """
        return self.path[:, 2].abs()


def stratified(rays: int, samples: int, random: torch.Generator | None) -> Tensor:
    """One share in [0, 1] in each of ``samples`` equal parts, ``[R, S]``; in the middle without a generator.

    They are on the generator's device, or on torch's default one.

    Args:
        rays: number of rays.
        samples: number of samples per ray.
        random: random numbers, or None for the middles.
    """
    if random is None:
        inner = torch.full((rays, samples), 0.5)
    else:
        inner = torch.rand(rays, samples, generator=random, device=random.device)
    return (torch.arange(samples, device=inner.device) + inner) / samples


def guided(mean: Tensor, std: Tensor, samples: int, random: torch.Generator | None) -> Tensor:
    """Shares ``[R, S]`` from N(mean, std) within three standard deviations (SparseSat-NeRF, section 3.2), in [0, 1].

    Args:
        mean: ``[R]`` shares of the path.
        std: ``[R]`` shares of the path.
        samples: number of samples per ray.
        random: random numbers, or None for the middles of equally likely parts.
    """
    if random is None:
        shares = (torch.arange(samples, dtype=torch.float64, device=mean.device) + 0.5) / samples
        middles = torch.special.ndtri(shares)
        normal = middles.to(mean).expand(len(mean), samples)
    else:
        normal = torch.randn(len(mean), samples, generator=random, device=random.device).clamp(-3, 3)
    return (mean[:, None] + std[:, None] * normal).clamp(0, 1)


def composite(sigma: Tensor, t: Tensor, rise: Tensor) -> tuple[Tensor, Tensor]:
    """Weights T_i alpha_i ``[R, S]`` and transmittance before each sample ``[R, S]``.

    alpha_i = 1 - exp(-sigma_i delta_i), T_i = prod_{j < i} (1 - alpha_j). A sample stands for the part of the ray that
    is nearer to it than to its neighbours; the last one ends the ray. (NeRF's parts reach from a sample to the next: a
    soft surface seen by few samples moves by half their distance.)

    Args:
        sigma: ``[R, S]`` density per metre of height.
        t: ``[R, S]`` shares of the path, ascending.
        rise: ``[R]`` heights that the path crosses [m].
    """
    optical = sigma * _ends(t).diff(dim=1) * rise[:, None]
    before = torch.cat([torch.zeros_like(optical[:, :1]), optical.cumsum(dim=1)[:, :-1]], dim=1)
    transmittance = torch.exp(-before)
    return transmittance * -torch.expm1(-optical), transmittance


def median_share(weights: Tensor, t: Tensor) -> Tensor:
    """Share ``[R]`` of the path where the transmittance crosses one half, linear within a sample's part; 1 if never.

    Args:
        weights: ``[R, S]`` of `composite`.
        t: ``[R, S]`` shares of the path, ascending.
    """
    return _share_behind(weights, t, torch.full_like(t[:, :1], 0.5))[:, 0]


def _share_behind(weights: Tensor, t: Tensor, level: Tensor) -> Tensor:
    """Shares ``[R, K]`` of the path before which weights add up to levels, linear within a sample's part; 1 if never.

    Args:
        weights: ``[R, S]`` of `composite`.
        t: ``[R, S]`` shares of the path, ascending.
        level: ``[R, K]`` in [0, 1].
    """
    total, ends = weights.cumsum(dim=1), _ends(t)
    index = torch.searchsorted(total, level.contiguous())
    at = index.clamp_max(t.shape[1] - 1)
    before = total.gather(1, at) - weights.gather(1, at)
    start, end = ends.gather(1, at), ends.gather(1, at + 1)
    part = ((level - before) / weights.gather(1, at).clamp_min(1e-9)).clamp(0, 1)
    return start + part * (end - start)


def seen_shares(weights: Tensor, t: Tensor, samples: int, random: torch.Generator | None) -> Tensor:
    """Shares ``[R, K]`` of the path, each of which stands for an equal part of what a ray sees.

    Args:
        weights: ``[R, S]`` of `composite`.
        t: ``[R, S]`` shares of the path, ascending.
        samples: K.
        random: random numbers, or None for the middles of the parts.
    """
    return _share_behind(weights, t, stratified(len(t), samples, random) * weights.sum(dim=1, keepdim=True))


def _ends(t: Tensor) -> Tensor:
    """``[R, S + 1]`` ends of the parts that samples ``[R, S]`` stand for."""
    middle = (t[:, 1:] + t[:, :-1]) / 2
    return torch.cat([torch.zeros_like(t[:, :1]), middle, torch.ones_like(t[:, :1])], dim=1)


def towards_sun(points: Tensor, sun: Tensor, top: float, skip: float = 0.0) -> RayBatch:
    """Rays from points ``[R, 3]`` along unit vectors to the sun ``[R, 3]`` up to the height ``top``.

    Args:
        points: ``[R, 3]`` [m].
        sun: ``[R, 3]`` unit vectors.
        top: height at which a ray ends [m].
        skip: heights that a ray has crossed when it begins [m]; fewer where the sun is lower than `LOW_SUN`.
    """
    if skip:
        points = points + sun * (skip / sun[:, 2:].clamp_min(LOW_SUN))
    climb = (top - points[:, 2]).clamp_min(0.01) / sun[:, 2].clamp_min(0.05)
    return RayBatch(points, sun * climb[:, None])


__all__ = ["LOW_SUN", "RayBatch", "composite", "guided", "median_share", "seen_shares", "stratified", "towards_sun"]
