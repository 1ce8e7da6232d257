"""Hapke's macroscopic roughness: effective cosines and shadowing of a facet whose slopes scatter by theta-bar.

Hapke (1984), Icarus 59, 41-59, with the azimuth function f = exp(-2 tan(psi/2)); also Hapke, Theory of Reflectance
and Emittance Spectroscopy, chapter 12. Its two cases i <= e and e < i are one formula in (lo, hi), the directions
nearer to and farther from the normal; with t = tan(theta-bar), u(x) = cot(theta-bar) cot(x), E1 = exp(-2u/pi), E2 =
exp(-u^2/pi), h = sin^2(psi/2):

    D = 2 - E1(hi) - (psi/pi) E1(lo)
    a_lo = cos lo + (t/D) (sin lo cos psi E2(hi) + sin lo h E2(lo))
    a_hi = cos hi + (t/D) sin hi (E2(hi) - h E2(lo))         effective cosines are χ a, χ = (1 + pi t^2)^(-1/2)
    r_x  = t sin x E2(x) / (2 - E1(x))                       eta(x) = χ (cos x + r_x)
    mu0e mue S / (mu0 (mu0e + mue)) = K,   K = a_lo a_hi / ((a_lo + a_hi) (cos hi + r_hi) (cos lo + (1 - f) r_lo))

so that the cosine of incidence cancels, sun and view can be exchanged exactly, and nothing is divided by a cosine
that may vanish. `forward` and `reverse` are written out by hand because this is the costly part of the model (about
two thirds of the time and an eighth of the memory of automatic differentiation).
"""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch import Tensor

from sattools.reflectance.angles import Angles
from sattools.reflectance.hapke_limits import (
    A_MIN,
    D_MIN,
    EXPONENT_MAX,
    R2_MIN,
    SIN2_MIN,
    T_MAX,
    THETA_MAX,
    THETA_MIN,
    U_MAX,
    Z_MIN,
)


class Facet(NamedTuple):
    """What `forward` found out; all ``[...]``, lo and hi as in the module's docstring."""

    lit: Tensor
    order: Tensor
    side: Tensor
    c_lo: Tensor
    c_hi: Tensor
    slo: Tensor
    shi: Tensor
    ulo: Tensor
    uhi: Tensor
    x1lo: Tensor
    x1hi: Tensor
    e2lo: Tensor
    e2hi: Tensor
    x: Tensor
    y: Tensor
    r: Tensor
    gap: Tensor
    h: Tensor
    tangent: Tensor
    f: Tensor
    d: Tensor
    n1: Tensor
    n2: Tensor
    rlo: Tensor
    rhi: Tensor
    yhi: Tensor
    zlo: Tensor
    a_lo: Tensor
    a_hi: Tensor
    k: Tensor


def tangent_of(theta_deg: Tensor) -> Tensor:
    """tan(theta-bar) of a roughness [degrees], held within its bounds."""
    return torch.tan(theta_deg.clamp(THETA_MIN, THETA_MAX) * (math.pi / 180))


def forward(angles: Angles, t: Tensor) -> Facet:
    """Roughness of a facet, unitless; ``t`` = tan(theta-bar), at least about 1e-6."""
    low = torch.minimum(angles.mu0, angles.mu)
    lit = (torch.sgn(low) + 1).clamp_max(1)  # 0 below the horizon, else 1; NaN stays NaN
    order = torch.sgn(angles.mu0 - angles.mu)
    c_lo, c_hi = torch.maximum(angles.mu0, angles.mu).clamp_min(0), low.clamp_min(0)
    slo = ((1 - c_lo) * (1 + c_lo)).clamp_min(SIN2_MIN).sqrt()
    shi = ((1 - c_hi) * (1 + c_hi)).clamp_min(SIN2_MIN).sqrt()
    ulo = (c_lo / (slo * t)).clamp_max(U_MAX)
    uhi = (c_hi / (shi * t)).clamp_max(U_MAX)
    # 1 - E1, so that D keeps its digits near the horizon
    x1lo, x1hi = -torch.expm1(ulo * (-2 / math.pi)), -torch.expm1(uhi * (-2 / math.pi))
    e2lo = torch.exp((ulo * ulo * (-1 / math.pi)).clamp_min(-EXPONENT_MAX))
    e2hi = torch.exp((uhi * uhi * (-1 / math.pi)).clamp_min(-EXPONENT_MAX))

    # projections onto the facet: x = sin i sin e cos psi, y = sin i sin e |sin psi|
    side = torch.sgn(angles.triple)
    x = (angles.plus2 - angles.minus2) * 0.25 - c_lo * c_hi
    y = angles.triple.abs()
    r = (x * x + y * y).clamp_min(R2_MIN).sqrt()
    gap = torch.atan2(y, -x) * (1 / math.pi)  # 1 - psi / pi
    h = 0.5 - 0.5 * x / r
    # tan(psi/2) in a form that loses no digits at either end
    top = r - x + y
    tangent = top / torch.maximum(r + x + y, top * (1 / T_MAX))
    f = torch.exp(-2 * tangent)

    d = (x1lo + x1hi + gap * (1 - x1lo)).clamp_min(D_MIN)
    q = t / d
    n1 = x / shi * e2hi + slo * h * e2lo
    n2 = shi * (e2hi - h * e2lo)
    a_lo, a_hi = (c_lo + q * n1).clamp_min(A_MIN), (c_hi + q * n2).clamp_min(A_MIN)
    rlo, rhi = slo * t * e2lo / (1 + x1lo), shi * t * e2hi / (1 + x1hi)
    yhi = c_hi + rhi
    zlo = (c_lo + (1 - f) * rlo).clamp_min(Z_MIN)
    k = a_lo * a_hi / ((a_lo + a_hi) * yhi * zlo)
    return Facet(
        lit, order, side, c_lo, c_hi, slo, shi, ulo, uhi, x1lo, x1hi, e2lo, e2hi, x, y, r, gap, h, tangent, f,
        d, n1, n2, rlo, rhi, yhi, zlo, a_lo, a_hi, k,
    )  # fmt: skip


def reverse(
    facet: Facet, t: Tensor, g_a_lo: Tensor, g_a_hi: Tensor, g_k: Tensor, geometry: bool
) -> tuple[Tensor, Angles | None]:
    """Gradients (unitless) of t and, if ``geometry``, of the `Angles`, from those of a_lo, a_hi and K.

    Those of ``minus2`` and ``plus2`` are what comes through cos g = (plus2 - minus2) / 4.

    Args:
        facet: of the forward pass.
        t: tan of the roughness.
        g_a_lo: gradient of a_lo.
        g_a_hi: gradient of a_hi.
        g_k: gradient of K.
        geometry: whether the angles need theirs.
    """
    o = facet
    g_kk = g_k * o.k
    g_y = -g_kk / o.yhi
    g_z = -g_kk / o.zlo
    total = o.a_lo + o.a_hi
    g_j = g_k / (o.yhi * o.zlo)
    share = o.a_hi / total
    g_a_lo = g_a_lo + g_j * share * share
    share = o.a_lo / total
    g_a_hi = g_a_hi + g_j * share * share

    # a = c + (t / D) n
    q = t / o.d
    g_q = g_a_lo * o.n1 + g_a_hi * o.n2
    g_d = -g_q * q / o.d
    g_n1, g_n2 = g_a_lo * q, g_a_hi * q

    # r = s t E2 / (1 + x1), z = c_lo + (1 - f) r_lo, y = c_hi + r_hi
    g_rlo = g_z * (1 - o.f)
    rate_lo, rate_hi = g_rlo / (1 + o.x1lo), g_y / (1 + o.x1hi)
    e2lo_rate, e2hi_rate = rate_lo * o.e2lo, rate_hi * o.e2hi
    g_t = g_q / o.d + e2lo_rate * o.slo + e2hi_rate * o.shi

    swing_lo, swing_hi = g_n1 * o.slo, g_n2 * o.shi
    swing = swing_lo - swing_hi
    stilt = o.x / o.shi
    g_e2lo = rate_lo * o.slo * t + swing * o.h
    g_e2hi = rate_hi * o.shi * t + g_n1 * stilt + swing_hi
    e1lo = 1 - o.x1lo
    g_x1lo = g_d * (1 - o.gap) - rate_lo * o.rlo
    g_x1hi = g_d - rate_hi * o.rhi
    g_ulo = (2 / math.pi) * (g_x1lo * e1lo - o.ulo * g_e2lo * o.e2lo)
    g_uhi = (2 / math.pi) * (g_x1hi * (1 - o.x1hi) - o.uhi * g_e2hi * o.e2hi)
    bend_lo, bend_hi = g_ulo * o.ulo, g_uhi * o.uhi
    g_t = g_t - (bend_lo + bend_hi) / t
    if not geometry:
        return g_t, None

    g_tilt = g_n1 * o.e2hi
    g_x = g_tilt / o.shi
    g_slo = e2lo_rate * t + g_n1 * o.h * o.e2lo - bend_lo / o.slo
    g_shi = e2hi_rate * t + g_n2 * (o.e2hi - o.h * o.e2lo) - (g_tilt * stilt + bend_hi) / o.shi
    # azimuth: through psi in D, sin^2(psi/2) and f
    g_psi = (
        swing * o.e2lo * o.y * 0.5 / o.r - g_d * e1lo * (1 / math.pi) + g_z * o.rlo * o.f * (1 + o.tangent * o.tangent)
    ) / (o.r * o.r)
    g_x = g_x - g_psi * o.y
    g_triple = g_psi * o.x * o.side
    g_clo = g_a_lo + g_z + g_ulo / (o.slo * t) - g_slo * o.c_lo / o.slo - g_x * o.c_hi
    g_chi = g_a_hi + g_y + g_uhi / (o.shi * t) - g_shi * o.c_hi / o.shi - g_x * o.c_lo
    mean, half = 0.5 * (g_clo + g_chi), 0.5 * o.order * (g_clo - g_chi)
    quarter = 0.25 * g_x
    return g_t, Angles(mean + half, mean - half, g_triple, -quarter, quarter)
