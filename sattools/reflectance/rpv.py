"""Rahman-Pinty-Verstraete reflectance (Rahman, Pinty, Verstraete 1993, J. Geophys. Res. 98(D11), equations 2-5).

BRF = rho0 [mu0 mu (mu0 + mu)]^(k-1) (1 - Theta^2) / (1 + 2 Theta cos g + Theta^2)^(3/2) [1 + (1 - rhoc) / (1 + G)],
G^2 = tan^2 i + tan^2 e - 2 tan i tan e cos psi. Theta < 0 scatters back, Theta > 0 forward; k < 1 is a bowl, k > 1 a
bell.

Bounds, all outside or on the edge of the valid range: the first bracket is 0 or infinite at the horizon, so cosines
below `COS_MIN` count as `COS_MIN` (without gradient); |Theta| is held at `THETA_MAX`, where the lobe is a spike.

Kinks: the horizon; and sun = view, where G is a cone over sun and view and 0 is returned as its gradient (with
respect to the normal this is exact: G = 0 for every normal).
"""

from __future__ import annotations

import torch
from torch import Tensor

from sattools.reflectance.angles import as_tensors, measure

COS_MIN = 1e-4
THETA_MAX = 0.999


def rpv(
    normal: Tensor,
    sun: Tensor,
    view: Tensor,
    rho0: Tensor | float,
    k: Tensor | float,
    theta: Tensor | float,
    rhoc: Tensor | float,
) -> Tensor:
    """BRF of the Rahman-Pinty-Verstraete model; Lambert is k = 1, theta = 0, rhoc = 1.

    Args:
        normal: unit vectors ``[..., 3]`` away from the surface.
        sun: unit vectors ``[..., 3]`` away from the surface.
        view: unit vectors ``[..., 3]`` away from the surface.
        rho0: amplitude, 0 to 1; this and all that follow broadcastable to ``[...]``.
        k: exponent, 0 to 2; below 1 a bowl, above 1 a bell.
        theta: asymmetry, -1 (back) to 1 (forward).
        rhoc: hot spot, 0 to 1; 1 = none.

    Returns:
        Bidirectional reflectance factor pi L / E, E the irradiance of the facet; 0 where the facet faces
        away from sun or sensor.

    Raises:
        TypeError, ValueError: see `sattools.reflectance.angles.as_tensors`.
    """
    normal, sun, view, rho0, k, theta, rhoc = as_tensors(normal, sun, view, rho0, k, theta, rhoc)
    angles = measure(normal, sun, view)
    beyond = (angles.mu0 < 0) | (angles.mu < 0)
    mu0, mu = angles.mu0.clamp_min(COS_MIN), angles.mu.clamp_min(COS_MIN)

    bowl = torch.exp((k - 1) * torch.log(mu0 * mu * (mu0 + mu)))

    theta = theta.clamp(-THETA_MAX, THETA_MAX)
    # both arms are sums of positive terms, and they and their derivatives agree at theta = 0
    back = (1 + theta) ** 2 - theta * angles.minus2
    forward = (1 - theta) ** 2 + theta * angles.plus2
    lobe = (1 - theta) * (1 + theta) * torch.where(theta < 0, back, forward) ** -1.5

    # G mu0 mu = |mu sun - mu0 view|, written without the cancellation near sun = view
    g2 = (angles.mu0 - angles.mu) ** 2 + mu0 * mu * angles.minus2
    g = g2.clamp_min(torch.finfo(g2.dtype).tiny).sqrt()
    hot_spot = 1 + (1 - rhoc) * (mu0 * mu) / (mu0 * mu + g)
    return (rho0 * bowl * lobe * hot_spot).masked_fill(beyond, 0)
