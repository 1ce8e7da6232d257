"""Hapke and RPV as their papers print them, with automatic differentiation: the readable twins of the fast forms.

Slow, and singular where an angle is 0 or 90 degrees; everywhere else values and gradients are those of `hapke` and
`rpv`. All angles in radians unless said otherwise; ``[...]`` is the common shape of directions and parameters.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor


def measured(normal: Tensor, sun: Tensor, view: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Incidence, emission, azimuth between sun and view, and phase angle ``[...]`` [radians] of unit vectors."""
    cos_i = (normal * sun).sum(-1)  # [...]
    cos_e = (normal * view).sum(-1)  # [...]
    cos_g = (sun * view).sum(-1)  # [...]
    i, e, g = torch.acos(cos_i), torch.acos(cos_e), torch.acos(cos_g)  # [...]
    psi = torch.acos((cos_g - cos_i * cos_e) / (torch.sin(i) * torch.sin(e)))  # [...]
    return i, e, psi, g


def hapke(
    normal: Tensor, sun: Tensor, view: Tensor, w: Tensor, b: Tensor, c: Tensor, theta_deg: Tensor,
    b0: Tensor | float = 0.0, h: Tensor | float = 1.0,
) -> Tensor:  # fmt: skip
    """BRF of Hapke (1981, 1984), with the H function of Hapke (2002); arguments as of `sattools.reflectance.hapke`."""
    i, e, psi, g = measured(normal, sun, view)  # [...]
    mu0e, mue, shadowing = rough(i, e, psi, torch.deg2rad(theta_deg))  # [...]
    front = (1 - b**2) / (1 + 2 * b * torch.cos(g) + b**2) ** 1.5  # [...] away from the sun
    back = (1 - b**2) / (1 - 2 * b * torch.cos(g) + b**2) ** 1.5  # [...] towards the sun
    p = (1 - c) * front + c * back  # [...] phase function
    opposition = b0 / (1 + torch.tan(g / 2) / h)  # [...]
    scattered = p * (1 + opposition) + h_function(mu0e, w) * h_function(mue, w) - 1  # [...]
    return w / 4 / torch.cos(i) * mu0e / (mu0e + mue) * scattered * shadowing  # [...]


def h_function(x: Tensor, w: Tensor) -> Tensor:
    """Ambartsumian's and Chandrasekhar's H ``[...]`` by Hapke (2002), eq. 13, unitless; ``x`` an effective cosine."""
    r0 = (1 - torch.sqrt(1 - w)) / (1 + torch.sqrt(1 - w))  # [...] diffusive reflectance
    return 1 / (1 - w * x * (r0 + (1 - 2 * r0 * x) / 2 * torch.log((1 + x) / x)))  # [...]


def rough(i: Tensor, e: Tensor, psi: Tensor, theta: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Effective cosines and shadowing function ``[...]`` of angles in radians (Hapke 1984)."""
    t = torch.tan(theta)  # [...]
    chi = 1 / torch.sqrt(1 + math.pi * t**2)  # [...]
    near, far = torch.minimum(i, e), torch.maximum(i, e)  # [...] of sun and view, from the normal

    def e1(x: Tensor) -> Tensor:
        return torch.exp(-2 / math.pi / t / torch.tan(x))  # [...]

    def e2(x: Tensor) -> Tensor:
        return torch.exp(-1 / math.pi / t**2 / torch.tan(x) ** 2)  # [...]

    def eta(x: Tensor) -> Tensor:
        return chi * (torch.cos(x) + torch.sin(x) * t * e2(x) / (2 - e1(x)))  # [...]

    half = torch.sin(psi / 2) ** 2  # [...]
    d = 2 - e1(far) - psi / math.pi * e1(near)  # [...]
    mu_near = chi * (torch.cos(near) + torch.sin(near) * t * (torch.cos(psi) * e2(far) + half * e2(near)) / d)  # [...]
    mu_far = chi * (torch.cos(far) + torch.sin(far) * t * (e2(far) - half * e2(near)) / d)  # [...]
    mu0e, mue = torch.where(i <= e, mu_near, mu_far), torch.where(i <= e, mu_far, mu_near)  # [...]
    f = torch.exp(-2 * torch.tan(psi / 2))  # [...] how much the views of both share their shadows
    lit = chi * torch.cos(near) / eta(near)  # [...]
    return mu0e, mue, mue / eta(e) * torch.cos(i) / eta(i) * chi / (1 - f + f * lit)  # [...]


def rpv(normal: Tensor, sun: Tensor, view: Tensor, rho0: Tensor, k: Tensor, theta: Tensor, rhoc: Tensor) -> Tensor:
    """BRF of Rahman, Pinty and Verstraete (1993), eq. 2-5; arguments as of `sattools.reflectance.rpv`."""
    i, e, psi, g = measured(normal, sun, view)  # [...]
    mu0, mu = torch.cos(i), torch.cos(e)  # [...]
    bowl = (mu0 * mu * (mu0 + mu)) ** (k - 1)  # [...]
    lobe = (1 - theta**2) / (1 + 2 * theta * torch.cos(g) + theta**2) ** 1.5  # [...]
    tan_i, tan_e = torch.tan(i), torch.tan(e)  # [...]
    distance = torch.sqrt(tan_i**2 + tan_e**2 - 2 * tan_i * tan_e * torch.cos(psi))  # [...] from the hot spot
    return rho0 * bowl * lobe * (1 + (1 - rhoc) / (1 + distance))  # [...]


__all__ = ["h_function", "hapke", "measured", "rough", "rpv"]
