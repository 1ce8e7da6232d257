"""One facet of Hapke's model for compiled kernels: roughness, phase function and H, each with its reverse.

The same formulas as in `hapke` and `roughness`, whose plain form is what the kernels are tested against, free of
branches, so that samples are worked out side by side. Every part hands its intermediate values to its reverse; a sample
of one band (`hapke_kernel`) and a cell of many bands (`hapke_bands`) are put together from them.
"""

from __future__ import annotations

import math

import numpy as np

from sattools.compiled import njit
from sattools.reflectance.elementary import angle, at_least, at_most, exp, expm1, log, sign, tan
from sattools.reflectance.hapke_limits import (
    A_MIN,
    B_MAX,
    D_MIN,
    EXPONENT_MAX,
    R2_MIN,
    SIN2_MIN,
    T_MAX,
    THETA_MAX,
    THETA_MIN,
    U_MAX,
    W_MAX,
    Z_MIN,
)

DEGREE = math.pi / 180
TINY = float(np.finfo(np.float64).tiny)


@njit(forceinline=True)
def facet(mu0, mu, triple, plus2, minus2, theta):
    """K and the effective cosines of a rough facet, and what `facet_reverse` needs of them.

    Args: cosines of incidence and emission, triple product of normal, sun and view, squares of |sun + view| and |sun -
    view|, theta-bar [degrees].
    """
    low, wide = (mu0, mu) if mu0 < mu else (mu, mu0)
    t = tan(at_most(at_least(theta, THETA_MIN), THETA_MAX) * DEGREE)
    c_lo, c_hi = at_least(wide, 0.0), at_least(low, 0.0)
    slo = math.sqrt(at_least((1 - c_lo) * (1 + c_lo), SIN2_MIN))
    shi = math.sqrt(at_least((1 - c_hi) * (1 + c_hi), SIN2_MIN))
    # what is divided by more than once is inverted: divisions are most of the time that the functions leave
    per_t, per_slo, per_shi = 1 / t, 1 / slo, 1 / shi
    ulo, uhi = at_most(c_lo * per_slo * per_t, U_MAX), at_most(c_hi * per_shi * per_t, U_MAX)
    x1lo, x1hi = -expm1(ulo * (-2 / math.pi)), -expm1(uhi * (-2 / math.pi))
    e2lo = exp(at_least(ulo * ulo * (-1 / math.pi), -EXPONENT_MAX))
    e2hi = exp(at_least(uhi * uhi * (-1 / math.pi), -EXPONENT_MAX))
    x, y = (plus2 - minus2) * 0.25 - c_lo * c_hi, abs(triple)
    r = math.sqrt(at_least(x * x + y * y, R2_MIN))
    gap = angle(y, -x) * (1 / math.pi)
    per_r = 1 / r
    hh = 0.5 - 0.5 * x * per_r
    top = r - x + y
    tangent = top / at_least(r + x + y, top * (1 / T_MAX))
    f = exp(-2 * tangent)
    d = at_least(x1lo + x1hi + gap * (1 - x1lo), D_MIN)
    per_d = 1 / d
    q = t * per_d
    tilt = x * per_shi
    n_lo = tilt * e2hi + slo * hh * e2lo
    n_hi = shi * (e2hi - hh * e2lo)
    a_lo, a_hi = at_least(c_lo + q * n_lo, A_MIN), at_least(c_hi + q * n_hi, A_MIN)
    damp_lo, damp_hi = 1 / (1 + x1lo), 1 / (1 + x1hi)
    r_lo, r_hi = slo * t * e2lo * damp_lo, shi * t * e2hi * damp_hi
    y_hi = c_hi + r_hi
    z_lo = at_least(c_lo + (1 - f) * r_lo, Z_MIN)
    per_total, per_y, per_z = 1 / (a_lo + a_hi), 1 / y_hi, 1 / z_lo
    k = a_lo * a_hi * per_total * per_y * per_z
    shrink = 1 / math.sqrt(1 + math.pi * t * t)
    ends = (a_lo, a_hi, c_lo, c_hi, slo, shi, per_slo, per_shi, ulo, uhi, x1lo, x1hi, e2lo, e2hi)
    turn = (x, y, gap, per_r, hh, tangent, f)
    rest = (t, per_t, per_d, q, tilt, n_lo, n_hi, damp_lo, damp_hi, r_lo, r_hi, per_total, per_y, per_z)
    return k, shrink * a_lo, shrink * a_hi, shrink, (ends, turn, rest)


@njit(forceinline=True)
def facet_reverse(known, mu0, mu, triple, theta, k, shrink, g_k, x_lo, x_hi):
    """Gradients of theta-bar, both cosines, triple product and |sun +- view|^2, from those of `facet`'s first three."""
    ends, turn, rest = known
    a_lo, a_hi, c_lo, c_hi, slo, shi, per_slo, per_shi, ulo, uhi, x1lo, x1hi, e2lo, e2hi = ends
    x, y, gap, per_r, hh, tangent, f = turn
    t, per_t, per_d, q, tilt, n_lo, n_hi, damp_lo, damp_hi, r_lo, r_hi, per_total, per_y, per_z = rest
    # roughness
    g_kk = g_k * k
    g_y, g_z = -g_kk * per_y, -g_kk * per_z
    g_j = g_k * per_y * per_z
    share_lo, share_hi = a_hi * per_total, a_lo * per_total
    g_a_lo = x_lo * shrink + g_j * share_lo * share_lo
    g_a_hi = x_hi * shrink + g_j * share_hi * share_hi
    g_q = g_a_lo * n_lo + g_a_hi * n_hi
    g_d = -g_q * q * per_d
    g_n_lo, g_n_hi = g_a_lo * q, g_a_hi * q
    rate_lo, rate_hi = g_z * (1 - f) * damp_lo, g_y * damp_hi
    e2lo_rate, e2hi_rate = rate_lo * e2lo, rate_hi * e2hi
    g_t = g_q * per_d + e2lo_rate * slo + e2hi_rate * shi
    swing_lo, swing_hi = g_n_lo * slo, g_n_hi * shi
    swing = swing_lo - swing_hi
    g_e2lo = rate_lo * slo * t + swing * hh
    g_e2hi = rate_hi * shi * t + g_n_lo * tilt + swing_hi
    e1lo = 1 - x1lo
    g_x1lo = g_d * (1 - gap) - rate_lo * r_lo
    g_x1hi = g_d - rate_hi * r_hi
    g_ulo = (2 / math.pi) * (g_x1lo * e1lo - ulo * g_e2lo * e2lo)
    g_uhi = (2 / math.pi) * (g_x1hi * (1 - x1hi) - uhi * g_e2hi * e2hi)
    bend_lo, bend_hi = g_ulo * ulo, g_uhi * uhi
    g_t -= (bend_lo + bend_hi) * per_t
    # shrink = (1 + pi t^2)^(-1/2)
    g_t -= math.pi * t * shrink * shrink * shrink * (x_lo * a_lo + x_hi * a_hi)
    g_theta = g_t * (DEGREE + DEGREE * t * t)
    g_theta = 0.0 if theta <= THETA_MIN else g_theta
    g_theta = 0.0 if theta >= THETA_MAX else g_theta

    # angles
    g_tilt = g_n_lo * e2hi
    g_x = g_tilt * per_shi
    g_slo = e2lo_rate * t + g_n_lo * hh * e2lo - bend_lo * per_slo
    g_shi = e2hi_rate * t + g_n_hi * (e2hi - hh * e2lo) - (g_tilt * tilt + bend_hi) * per_shi
    g_psi = swing * e2lo * y * 0.5 * per_r - g_d * e1lo * (1 / math.pi) + g_z * r_lo * f * (1 + tangent * tangent)
    g_psi *= per_r * per_r
    g_x -= g_psi * y
    g_triple = g_psi * x * sign(triple)
    g_clo = g_a_lo + g_z + g_ulo * per_slo * per_t - g_slo * c_lo * per_slo - g_x * c_hi
    g_chi = g_a_hi + g_y + g_uhi * per_shi * per_t - g_shi * c_hi * per_shi - g_x * c_lo
    mean, half = 0.5 * (g_clo + g_chi), 0.5 * sign(mu0 - mu) * (g_clo - g_chi)
    return g_theta, mean + half, mean - half, g_triple, 0.25 * g_x


@njit(forceinline=True)
def lobes(b, c, plus2, minus2):
    """The phase function p(g), and what `lobes_reverse` needs of it."""
    bb = at_most(at_least(b, -B_MAX), B_MAX)
    width = (1 - bb) * (1 + bb)
    gap2 = (1 - bb) * (1 - bb)
    front2, back2 = 1 / (gap2 + bb * plus2), 1 / (gap2 + bb * minus2)
    front3, back3 = front2 * math.sqrt(front2), back2 * math.sqrt(back2)
    return width * (front3 + c * (back3 - front3)), (bb, width, front2, back2, front3, back3)


@njit(forceinline=True)
def lobes_reverse(known, b, c, plus2, minus2, g_p):
    """Gradients of b, c, |sun + view|^2 and |sun - view|^2 from that of p(g)."""
    bb, width, front2, back2, front3, back3 = known
    weighted = g_p * width
    g_c = weighted * (back3 - front3)
    fore, aft = (1 - c) * front3, c * back3
    fall_a, fall_z = -1.5 * weighted * fore * front2, -1.5 * weighted * aft * back2
    bend = 2 * (bb - 1)
    g_b = fall_a * (bend + plus2) + fall_z * (bend + minus2) - 2 * g_p * bb * (fore + aft)
    g_b = 0.0 if b <= -B_MAX else g_b
    g_b = 0.0 if b >= B_MAX else g_b
    return g_b, g_c, fall_a * bb, fall_z * bb


@njit(forceinline=True)
def log_of(x):
    """ln((1 + x) / x) of an effective cosine."""
    return log((1 + x) / x)


@njit(forceinline=True)
def h_functions(w, xlo, xhi, log_lo, log_hi):
    """H of both effective cosines, and the bounded w, r0 and gamma that they share."""
    ww = at_most(w, W_MAX)
    gamma = math.sqrt(1 - ww)
    r0 = (1 - gamma) / (1 + gamma)
    hlo = 1 / (1 - ww * xlo * (r0 + (0.5 - r0 * xlo) * log_lo))
    hhi = 1 / (1 - ww * xhi * (r0 + (0.5 - r0 * xhi) * log_hi))
    return hlo, hhi, ww, r0, gamma


@njit(forceinline=True)
def h_reverse(w, r0, slope, x, log_x, h, g_h):
    """Gradients of x and w through H(x); slope: gamma (1 + gamma)^2."""
    g_f = -g_h * h * h
    r0x = r0 * x
    tail = 0.5 - r0x
    mid = r0 + tail * log_x
    return -g_f * w * (mid - r0x * log_x - tail / (1 + x)), -g_f * x * (mid + w * (1 - x * log_x) / slope)


__all__ = ["TINY", "facet", "facet_reverse", "h_functions", "h_reverse", "lobes", "lobes_reverse", "log_of"]
