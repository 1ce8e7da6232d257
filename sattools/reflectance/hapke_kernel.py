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
from sattools.reflectance.elementary import at_least
from sattools.reflectance.hapke_facet import (
    TINY,
    facet,
    facet_reverse,
    h_functions,
    h_reverse,
    lobes,
    lobes_reverse,
    log_of,
)
from sattools.reflectance.hapke_limits import W_MAX

LANES = 128  # samples side by side
PART = 8192  # samples of one task of a thread


@njit(forceinline=True)
def _sample(n0, n1, n2, s0, s1, s2, v0, v1, v2, w, b, c, theta, b0, h):
    """BRF of a sample and its 15 derivatives."""
    mu0, mu = n0 * s0 + n1 * s1 + n2 * s2, n0 * v0 + n1 * v1 + n2 * v2
    lit = 0.0 if (mu0 if mu0 < mu else mu) < 0 else 0.25
    x0, x1, x2 = s1 * v2 - s2 * v1, s2 * v0 - s0 * v2, s0 * v1 - s1 * v0
    triple = n0 * x0 + n1 * x1 + n2 * x2
    plus2 = (s0 + v0) ** 2 + (s1 + v1) ** 2 + (s2 + v2) ** 2
    minus2 = (s0 - v0) ** 2 + (s1 - v1) ** 2 + (s2 - v2) ** 2
    k, xlo, xhi, shrink, rough = facet(mu0, mu, triple, plus2, minus2, theta)
    p, phase = lobes(b, c, plus2, minus2)
    minus, plus = math.sqrt(at_least(minus2, TINY)), math.sqrt(at_least(plus2, TINY))
    rate = 1 / (h * plus + minus)
    boost = 1 + b0 * h * plus * rate
    log_lo, log_hi = log_of(xlo), log_of(xhi)
    hlo, hhi, ww, r0, gamma = h_functions(w, xlo, xhi, log_lo, log_hi)
    inner = p * boost + (hlo * hhi - 1)

    g_inner = lit * k * ww
    # phase function
    g_boost = g_inner * p
    g_b0 = g_boost * h * plus * rate
    fall = g_boost * b0 * rate * rate
    g_h = fall * plus * minus
    g_b, g_c, g_plus2, g_minus2 = lobes_reverse(phase, b, c, plus2, minus2, g_inner * boost)
    g_minus2 -= 0.5 * fall * h * plus / minus
    g_plus2 += 0.5 * fall * h * minus / plus

    # H functions
    slope = gamma * (1 + gamma) * (1 + gamma)
    x_lo, w_lo = h_reverse(ww, r0, slope, xlo, log_lo, hlo, g_inner * hhi)
    x_hi, w_hi = h_reverse(ww, r0, slope, xhi, log_hi, hhi, g_inner * hlo)
    g_w = lit * k * inner + w_lo + w_hi
    g_w = 0.0 if w >= W_MAX else g_w

    g_theta, g_mu0, g_mu, g_triple, quarter = facet_reverse(
        rough, mu0, mu, triple, theta, k, shrink, lit * ww * inner, x_lo, x_hi
    )
    apart, along = 2 * (g_minus2 - quarter), 2 * (g_plus2 + quarter)
    return (
        lit * k * ww * inner,
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


@njit
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


@njit
def _load(values, start, size, row):
    """Part of ``[N]`` or ``[1]`` into a row; what is missing from a full row repeats the last."""
    last = len(values) - 1
    for j in range(LANES):
        row[j] = values[min(start + min(j, size - 1), last)]


@njit
def _load3(vectors, start, size, rows):
    last = len(vectors) - 1
    for j in range(LANES):
        i = min(start + min(j, size - 1), last)
        rows[j], rows[LANES + j], rows[2 * LANES + j] = vectors[i, 0], vectors[i, 1], vectors[i, 2]


@njit
def _store(row, start, size, target):
    for j in range(size):
        target[start + j] = row[j]


@njit
def _store3(rows, start, size, target):
    for j in range(size):
        target[start + j, 0], target[start + j, 1] = rows[j], rows[LANES + j]
        target[start + j, 2] = rows[2 * LANES + j]


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
            _load3(n, start, size, known[0 * LANES :])
            _load3(s, start, size, known[3 * LANES :])
            _load3(v, start, size, known[6 * LANES :])
            _load(w, start, size, known[9 * LANES :])
            _load(b, start, size, known[10 * LANES :])
            _load(c, start, size, known[11 * LANES :])
            _load(theta, start, size, known[12 * LANES :])
            _load(b0, start, size, known[13 * LANES :])
            _load(h, start, size, known[14 * LANES :])
            _lanes(known, results)
            _store(results, start, size, out)
            if needed[0]:
                _store3(results[1 * LANES :], start, size, gn)
            if needed[1]:
                _store3(results[4 * LANES :], start, size, gs)
            if needed[2]:
                _store3(results[7 * LANES :], start, size, gv)
            if needed[3]:
                _store(results[10 * LANES :], start, size, gw)
            if needed[4]:
                _store(results[11 * LANES :], start, size, gb)
            if needed[5]:
                _store(results[12 * LANES :], start, size, gc)
            if needed[6]:
                _store(results[13 * LANES :], start, size, gt)
            if needed[7]:
                _store(results[14 * LANES :], start, size, gb0)
            if needed[8]:
                _store(results[15 * LANES :], start, size, gh)


def _flat(operand: Tensor | None, shape: torch.Size, like: Tensor, trailing: tuple[int, ...]) -> np.ndarray:
    """An operand as ``[N, *trailing]``, or ``[1, *trailing]`` if all samples share it; zero for None.

    Side by side in memory: for every other order numba would compile the kernel once more, which takes seconds.
    """
    if operand is None:
        return np.zeros(1, like.detach().numpy().dtype)
    shared = operand.shape[: operand.ndim - len(trailing)].numel() == 1
    whole = operand.detach() if shared else operand.detach().expand(*shape, *trailing)
    return np.ascontiguousarray(whole.reshape(-1, *trailing).numpy())


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
        evaluate(*flat, np.array(needed), out.numpy().reshape(-1), *arrays)
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
