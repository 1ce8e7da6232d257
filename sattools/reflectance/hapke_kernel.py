"""The model of `sattools.reflectance.hapke` compiled for processors: value and derivatives, sample after sample.

The same formulas as in `hapke` and `roughness`, whose plain form is what this one is tested against, but in double
precision throughout, without arrays in between, and free of branches, so that samples are worked out side by side.
Derivatives are worked out along with the value.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from sattools.compiled import njit, spread
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
LANES = 128  # samples side by side
PART = 8192  # samples of one task of a thread


@njit(cache=True, inline="always")
def _h_rates(w, r0, slope, x, log, h, g_h):
    """Gradients of x and w through H(x)."""
    g_f = -g_h * h * h
    r0x = r0 * x
    tail = 0.5 - r0x
    mid = r0 + tail * log
    return -g_f * w * (mid - r0x * log - tail / (1 + x)), -g_f * x * (mid + w * (1 - x * log) / slope)


@njit(cache=True, inline="always")
def _sample(n0, n1, n2, s0, s1, s2, v0, v1, v2, w, b, c, theta, b0, h):
    """BRF of a sample and its 15 derivatives."""
    # angles
    mu0, mu = n0 * s0 + n1 * s1 + n2 * s2, n0 * v0 + n1 * v1 + n2 * v2
    low, wide = (mu0, mu) if mu0 < mu else (mu, mu0)
    lit = 0.0 if low < 0 else 0.25
    x0, x1, x2 = s1 * v2 - s2 * v1, s2 * v0 - s0 * v2, s0 * v1 - s1 * v0
    triple = n0 * x0 + n1 * x1 + n2 * x2
    plus2 = (s0 + v0) ** 2 + (s1 + v1) ** 2 + (s2 + v2) ** 2
    minus2 = (s0 - v0) ** 2 + (s1 - v1) ** 2 + (s2 - v2) ** 2

    # roughness
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

    # phase function
    bb = at_most(at_least(b, -B_MAX), B_MAX)
    width = (1 - bb) * (1 + bb)
    gap2 = (1 - bb) * (1 - bb)
    front2, back2 = 1 / (gap2 + bb * plus2), 1 / (gap2 + bb * minus2)
    front3, back3 = front2 * math.sqrt(front2), back2 * math.sqrt(back2)
    p = width * (front3 + c * (back3 - front3))
    minus, plus = math.sqrt(at_least(minus2, TINY)), math.sqrt(at_least(plus2, TINY))
    rate = 1 / (h * plus + minus)
    boost = 1 + b0 * h * plus * rate

    # multiple scattering
    ww = at_most(w, W_MAX)
    gamma = math.sqrt(1 - ww)
    r0 = (1 - gamma) / (1 + gamma)
    shrink = 1 / math.sqrt(1 + math.pi * t * t)
    xlo, xhi = shrink * a_lo, shrink * a_hi
    log_lo, log_hi = log((1 + xlo) / xlo), log((1 + xhi) / xhi)
    hlo = 1 / (1 - ww * xlo * (r0 + (0.5 - r0 * xlo) * log_lo))
    hhi = 1 / (1 - ww * xhi * (r0 + (0.5 - r0 * xhi) * log_hi))
    inner = p * boost + (hlo * hhi - 1)
    value = lit * k * ww * inner

    g_inner = lit * k * ww
    g_k = lit * ww * inner
    # phase function
    g_boost = g_inner * p
    g_p = g_inner * boost
    g_b0 = g_boost * h * plus * rate
    fall = g_boost * b0 * rate * rate
    g_h = fall * plus * minus
    g_minus2 = -0.5 * fall * h * plus / minus
    g_plus2 = 0.5 * fall * h * minus / plus
    weighted = g_p * width
    g_c = weighted * (back3 - front3)
    fore, aft = (1 - c) * front3, c * back3
    fall_a, fall_z = -1.5 * weighted * fore * front2, -1.5 * weighted * aft * back2
    bend = 2 * (bb - 1)
    g_b = fall_a * (bend + plus2) + fall_z * (bend + minus2) - 2 * g_p * bb * (fore + aft)
    g_b = 0.0 if b <= -B_MAX else g_b
    g_b = 0.0 if b >= B_MAX else g_b
    g_plus2 += fall_a * bb
    g_minus2 += fall_z * bb

    # H functions
    slope = gamma * (1 + gamma) * (1 + gamma)
    x_lo, w_lo = _h_rates(ww, r0, slope, xlo, log_lo, hlo, g_inner * hhi)
    x_hi, w_hi = _h_rates(ww, r0, slope, xhi, log_hi, hhi, g_inner * hlo)
    g_w = lit * k * inner + w_lo + w_hi
    g_w = 0.0 if w >= W_MAX else g_w

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
    g_t -= math.pi * t * shrink * shrink * (x_lo * xlo + x_hi * xhi)
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
    g_mu0, g_mu = mean + half, mean - half
    apart, along = 2 * (g_minus2 - 0.25 * g_x), 2 * (g_plus2 + 0.25 * g_x)
    return (
        value,
        g_mu0 * s0 + g_mu * v0 + g_triple * x0,
        g_mu0 * s1 + g_mu * v1 + g_triple * x1,
        g_mu0 * s2 + g_mu * v2 + g_triple * x2,
        g_mu0 * n0 + g_triple * (v1 * n2 - v2 * n1) + along * (s0 + v0) + apart * (s0 - v0),
        g_mu0 * n1 + g_triple * (v2 * n0 - v0 * n2) + along * (s1 + v1) + apart * (s1 - v1),
        g_mu0 * n2 + g_triple * (v0 * n1 - v1 * n0) + along * (s2 + v2) + apart * (s2 - v2),
        g_mu * n0 + g_triple * (n1 * s2 - n2 * s1) + along * (s0 + v0) - apart * (s0 - v0),
        g_mu * n1 + g_triple * (n2 * s0 - n0 * s2) + along * (s1 + v1) - apart * (s1 - v1),
        g_mu * n2 + g_triple * (n0 * s1 - n1 * s0) + along * (s2 + v2) - apart * (s2 - v2),
        g_w,
        g_b,
        g_c,
        g_theta,
        g_b0,
        g_h,
    )  # fmt: skip


@njit(cache=True)
def _lanes(known, results):
    """`_sample` of `LANES` samples, operands and results side by side; free of branches, so that it becomes vectors."""
    for j in range(LANES):
        (
            results[0 * LANES + j], results[1 * LANES + j], results[2 * LANES + j], results[3 * LANES + j],
            results[4 * LANES + j], results[5 * LANES + j], results[6 * LANES + j], results[7 * LANES + j],
            results[8 * LANES + j], results[9 * LANES + j], results[10 * LANES + j], results[11 * LANES + j],
            results[12 * LANES + j], results[13 * LANES + j], results[14 * LANES + j], results[15 * LANES + j],
        ) = _sample(
            known[0 * LANES + j], known[1 * LANES + j], known[2 * LANES + j], known[3 * LANES + j],
            known[4 * LANES + j], known[5 * LANES + j], known[6 * LANES + j], known[7 * LANES + j],
            known[8 * LANES + j], known[9 * LANES + j], known[10 * LANES + j], known[11 * LANES + j],
            known[12 * LANES + j], known[13 * LANES + j], known[14 * LANES + j],
        )  # fmt: skip


@njit(cache=True)
def _load(values, start, size, known, row):
    """Part of ``[N]`` or ``[1]`` into a row; what is missing from a full row repeats the last."""
    last = len(values) - 1
    for j in range(LANES):
        known[row * LANES + j] = values[min(start + min(j, size - 1), last)]


@njit(cache=True)
def _load3(vectors, start, size, known, row):
    last = len(vectors) - 1
    for j in range(LANES):
        i = min(start + min(j, size - 1), last)
        known[row * LANES + j], known[(row + 1) * LANES + j], known[(row + 2) * LANES + j] = (
            vectors[i, 0],
            vectors[i, 1],
            vectors[i, 2],
        )


@njit(cache=True)
def _store(results, row, start, size, target):
    for j in range(size):
        target[start + j] = results[row * LANES + j]


@njit(cache=True)
def _store3(results, row, start, size, target):
    for j in range(size):
        target[start + j, 0], target[start + j, 1] = results[row * LANES + j], results[(row + 1) * LANES + j]
        target[start + j, 2] = results[(row + 2) * LANES + j]


@spread(lambda *arguments: math.ceil(len(arguments[10]) / PART))
@njit(cache=True, nogil=True)
def evaluate(n, s, v, w, b, c, theta, b0, h, needed, out, gn, gs, gv, gw, gb, gc, gt, gb0, gh, first_part, end_part):
    """BRF of N samples into ``out`` ``[N]`` and derivatives, where ``needed`` ``[9]``, into the other arrays.

    Directions are ``[N, 3]`` or ``[1, 3]``, parameters ``[N]`` or ``[1]`` (shared by all); derivatives ``[N, 3]`` and
    ``[N]``, of any length where not needed.
    """
    count = len(out)
    for part in range(first_part, end_part):
        known = np.empty(15 * LANES)
        results = np.empty(16 * LANES)
        for start in range(part * PART, min(count, (part + 1) * PART), LANES):
            size = min(LANES, count - start)
            _load3(n, start, size, known, 0)
            _load3(s, start, size, known, 3)
            _load3(v, start, size, known, 6)
            _load(w, start, size, known, 9)
            _load(b, start, size, known, 10)
            _load(c, start, size, known, 11)
            _load(theta, start, size, known, 12)
            _load(b0, start, size, known, 13)
            _load(h, start, size, known, 14)
            _lanes(known, results)
            for j in range(size):
                out[start + j] = results[0 * LANES + j]
            if needed[0]:
                _store3(results, 1, start, size, gn)
            if needed[1]:
                _store3(results, 4, start, size, gs)
            if needed[2]:
                _store3(results, 7, start, size, gv)
            if needed[3]:
                _store(results, 10, start, size, gw)
            if needed[4]:
                _store(results, 11, start, size, gb)
            if needed[5]:
                _store(results, 12, start, size, gc)
            if needed[6]:
                _store(results, 13, start, size, gt)
            if needed[7]:
                _store(results, 14, start, size, gb0)
            if needed[8]:
                _store(results, 15, start, size, gh)


def _flat(operand: Tensor | None, shape: torch.Size, like: Tensor, trailing: tuple[int, ...]) -> np.ndarray:
    """An operand as ``[N, *trailing]``, or ``[1, *trailing]`` if all samples share it; zero for None."""
    if operand is None:
        return np.zeros(1, like.detach().numpy().dtype)
    shared = operand.shape[: operand.ndim - len(trailing)].numel() == 1
    whole = operand.detach() if shared else operand.detach().expand(*shape, *trailing)
    flat: np.ndarray = whole.reshape(-1, *trailing).numpy()
    return flat


class CompiledHapke(torch.autograd.Function):
    """The model on tensors of a processor whose directions have the shape of the result; operands as for its twin."""

    @staticmethod
    def forward(ctx: Any, needed: tuple[bool, ...], shape: torch.Size, *operands: Any) -> Tensor:
        normal = operands[0]
        out = normal.new_empty(shape)
        flat = [_flat(o, shape, normal, (3,) if k < 3 else ()) for k, o in enumerate(operands)]
        rates = [
            normal.new_empty((*(shape if need else (1,)), *((3,) if k < 3 else ()))) for k, need in enumerate(needed)
        ]
        arrays = [rate.numpy().reshape(-1, 3) if k < 3 else rate.numpy().reshape(-1) for k, rate in enumerate(rates)]
        evaluate(*flat, np.array(needed), out.numpy().reshape(-1), *arrays, threads=torch.get_num_threads())
        ctx.needed, ctx.shapes = needed, [None if o is None else o.shape for o in operands]
        ctx.save_for_backward(*[rate for rate, need in zip(rates, needed, strict=True) if need])
        return out

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *grads: Tensor) -> tuple[Tensor | None, ...]:
        gradients: list[Tensor | None] = [None, None]
        rates = iter(ctx.saved_tensors)
        for k, (need, shape) in enumerate(zip(ctx.needed, ctx.shapes, strict=True)):
            if not need:
                gradients.append(None)
                continue
            gradients.append((next(rates) * (grads[0] if k > 2 else grads[0][..., None])).sum_to_size(shape))
        return tuple(gradients)


__all__ = ["CompiledHapke"]
