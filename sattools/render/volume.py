"""Volume rendering of single rays: sampling, compositing, light of the sun."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor


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


def stratified(rays: int, samples: int, random: torch.Generator | None) -> Tensor:
    """One share in [0, 1] in each of ``samples`` equal parts, ``[R, S]``; in the middle without a generator.

    Args:
        rays: number of rays.
        samples: number of samples per ray.
        random: random numbers, or None for the middles.
    """
    inner = torch.full((rays, samples), 0.5) if random is None else torch.rand(rays, samples, generator=random)
    return (torch.arange(samples) + inner) / samples


def guided(mean: Tensor, std: Tensor, samples: int, random: torch.Generator) -> Tensor:
    """Shares ``[R, S]`` from N(mean, std) within three standard deviations (SparseSat-NeRF, section 3.2), in [0, 1].

    Args:
        mean: ``[R]`` shares of the path.
        std: ``[R]`` shares of the path.
        samples: number of samples per ray.
        random: random numbers, or None for the middles.
    """
    normal = torch.randn(len(mean), samples, generator=random).clamp(-3, 3)
    return (mean[:, None] + std[:, None] * normal).clamp(0, 1)


def composite(sigma: Tensor, t: Tensor, length: Tensor) -> tuple[Tensor, Tensor]:
    """Weights T_i alpha_i ``[R, S]`` and transmittance before each sample ``[R, S]``.

    alpha_i = 1 - exp(-sigma_i delta_i), T_i = prod_{j < i} (1 - alpha_j); the last sample ends the ray.

    Args:
        sigma: ``[R, S]`` density per metre.
        t: ``[R, S]`` shares of the path, ascending.
        length: ``[R]`` length of the path [m].
    """
    delta = torch.cat([t.diff(dim=1), 1 - t[:, -1:]], dim=1) * length[:, None]
    optical = sigma * delta
    before = torch.cat([torch.zeros_like(optical[:, :1]), optical.cumsum(dim=1)[:, :-1]], dim=1)
    transmittance = torch.exp(-before)
    return transmittance * -torch.expm1(-optical), transmittance


def median_share(weights: Tensor, t: Tensor) -> Tensor:
    """Share ``[R]`` of the path in [0, 1] where the transmittance crosses one half, linear between samples."""
    total = weights.cumsum(dim=1)
    index = (total < 0.5).sum(dim=1).clamp_max(t.shape[1] - 1)
    at = index[:, None]
    before = torch.where(at > 0, total.gather(1, (at - 1).clamp_min(0)), torch.zeros_like(at, dtype=total.dtype))
    t0 = torch.where(at > 0, t.gather(1, (at - 1).clamp_min(0)), t.gather(1, at))
    part = ((0.5 - before) / weights.gather(1, at).clamp_min(1e-9)).clamp(0, 1)
    return (t0 + part * (t.gather(1, at) - t0))[:, 0]


def towards_sun(points: Tensor, sun: Tensor, top: float) -> RayBatch:
    """Rays from points ``[R, 3]`` along unit vectors to the sun ``[R, 3]`` up to the height ``top``.

    Args:
        points: ``[R, 3]`` [m].
        sun: ``[R, 3]`` unit vectors.
        top: height at which a ray ends [m].
    """
    climb = (top - points[:, 2]).clamp_min(0.01) / sun[:, 2].clamp_min(0.05)
    return RayBatch(points, sun * climb[:, None])


__all__ = ["RayBatch", "composite", "guided", "median_share", "stratified", "towards_sun"]
