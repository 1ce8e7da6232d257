"""BRF times cos i of Hapke's model, compiled for processors, for cells of many bands under one sun and one view.

What does not depend on the band is worked out once per cell, in double precision and without arrays of the size of a
map in between. `sattools.reflectance.hapke` times the cosine is the readable twin that this is tested against. The
opposition effect is left out (B0 = 0).
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
from sattools.reflectance.hapke_facet import facet, facet_reverse, h_functions, h_reverse, lobes, lobes_reverse, log_of
from sattools.reflectance.hapke_limits import W_MAX

LANES = 128  # cells side by side
PART = 4096  # cells of one task of a thread
# rows of a block's state
N0, N1, N2, B, C, THETA, K, XLO, XHI, LOG_LO, LOG_HI, P, COS, ROWS = range(14)
# rows of a block's gradients, of: K, both effective cosines, p(g), cos i; then of normal, b, c, theta-bar
G_K, G_LO, G_HI, G_P, G_COS, G_N0, G_N1, G_N2, G_B, G_C, G_THETA, G_ROWS = range(12)
SLOPES = 4  # derivatives of a cell and band: by w, b, c, theta-bar


@njit(forceinline=True)
def _angles(n0, n1, n2, pair):
    """Both cosines and the triple product of a facet; pair: sun, view, their cross product."""
    mu0 = n0 * pair[0] + n1 * pair[1] + n2 * pair[2]
    mu = n0 * pair[3] + n1 * pair[4] + n2 * pair[5]
    return mu0, mu, n0 * pair[6] + n1 * pair[7] + n2 * pair[8]


@njit
def _open(pair, state):
    """What all bands of a block of cells share, into its state; K with the cosine of incidence, 0 where unlit."""
    plus2, minus2 = pair[9], pair[10]
    for j in range(LANES):
        mu0, mu, triple = _angles(state[N0 * LANES + j], state[N1 * LANES + j], state[N2 * LANES + j], pair)
        k, xlo, xhi, _, _ = facet(mu0, mu, triple, plus2, minus2, state[THETA * LANES + j])
        p, _ = lobes(state[B * LANES + j], state[C * LANES + j], plus2, minus2)
        lit = 0.0 if (mu0 if mu0 < mu else mu) < 0 else 0.25
        state[K * LANES + j], state[XLO * LANES + j], state[XHI * LANES + j] = lit * k, xlo, xhi
        state[LOG_LO * LANES + j], state[LOG_HI * LANES + j] = log_of(xlo), log_of(xhi)
        state[P * LANES + j], state[COS * LANES + j] = p, at_least(mu0, 0.0)


@njit
def _band(state, w, value):
    """BRF cos i of one band of a block."""
    for j in range(LANES):
        xlo, xhi = state[XLO * LANES + j], state[XHI * LANES + j]
        hlo, hhi, ww, _, _ = h_functions(w[j], xlo, xhi, state[LOG_LO * LANES + j], state[LOG_HI * LANES + j])
        value[j] = state[COS * LANES + j] * state[K * LANES + j] * ww * (state[P * LANES + j] + (hlo * hhi - 1))


@njit
def _band_back(state, w, grad, g_w, rates):
    """Gradient of w of one band of a block, from that of the value; those of what bands share are added to `rates`."""
    for j in range(LANES):
        xlo, xhi = state[XLO * LANES + j], state[XHI * LANES + j]
        log_lo, log_hi = state[LOG_LO * LANES + j], state[LOG_HI * LANES + j]
        hlo, hhi, ww, r0, gamma = h_functions(w[j], xlo, xhi, log_lo, log_hi)
        inner = state[P * LANES + j] + (hlo * hhi - 1)
        k, cosine = state[K * LANES + j], state[COS * LANES + j]
        base = grad[j] * cosine
        g_inner = base * k * ww
        slope = gamma * (1 + gamma) * (1 + gamma)
        x_lo, w_lo = h_reverse(ww, r0, slope, xlo, log_lo, hlo, g_inner * hhi)
        x_hi, w_hi = h_reverse(ww, r0, slope, xhi, log_hi, hhi, g_inner * hlo)
        g_w[j] = 0.0 if w[j] >= W_MAX else base * k * inner + w_lo + w_hi
        rates[G_K * LANES + j] += base * ww * inner
        rates[G_LO * LANES + j] += x_lo
        rates[G_HI * LANES + j] += x_hi
        rates[G_P * LANES + j] += g_inner
        rates[G_COS * LANES + j] += grad[j] * k * ww * inner


@njit
def _close(pair, state, rates):
    """From the gradients of what bands share to those of normal and shape, in `rates`."""
    plus2, minus2 = pair[9], pair[10]
    for j in range(LANES):
        b, c, theta = state[B * LANES + j], state[C * LANES + j], state[THETA * LANES + j]
        mu0, mu, triple = _angles(state[N0 * LANES + j], state[N1 * LANES + j], state[N2 * LANES + j], pair)
        k, _, _, shrink, rough = facet(mu0, mu, triple, plus2, minus2, theta)
        _, phase = lobes(b, c, plus2, minus2)
        lit = 0.0 if (mu0 if mu0 < mu else mu) < 0 else 0.25
        g_b, g_c, _, _ = lobes_reverse(phase, b, c, plus2, minus2, rates[G_P * LANES + j])
        g_theta, g_mu0, g_mu, g_triple, _ = facet_reverse(
            rough, mu0, mu, triple, theta, k, shrink, lit * rates[G_K * LANES + j], rates[G_LO * LANES + j],
            rates[G_HI * LANES + j],
        )  # fmt: skip
        g_mu0 += rates[G_COS * LANES + j] if mu0 >= 0 else 0.0
        rates[G_N0 * LANES + j] = g_mu0 * pair[0] + g_mu * pair[3] + g_triple * pair[6]
        rates[G_N1 * LANES + j] = g_mu0 * pair[1] + g_mu * pair[4] + g_triple * pair[7]
        rates[G_N2 * LANES + j] = g_mu0 * pair[2] + g_mu * pair[5] + g_triple * pair[8]
        rates[G_B * LANES + j], rates[G_C * LANES + j], rates[G_THETA * LANES + j] = g_b, g_c, g_theta


@njit
def _load(n, b, c, theta, start, size, state):
    """Facets of a block; what is missing from a full block repeats the last one."""
    for j in range(LANES):
        i = start + min(j, size - 1)
        state[N0 * LANES + j], state[N1 * LANES + j], state[N2 * LANES + j] = n[i, 0], n[i, 1], n[i, 2]
        state[B * LANES + j], state[C * LANES + j], state[THETA * LANES + j] = b[i], c[i], theta[i]


@njit
def _column(values, band, start, size, target):
    """One band of a block of ``[N, C]``."""
    for j in range(LANES):
        target[j] = values[start + min(j, size - 1), band]


@spread(lambda *arguments: math.ceil(len(arguments[0]) / PART))
@njit(cache=True, nogil=True)
def evaluate(n, b, c, theta, w, pair, out, first_part, end_part):
    """BRF cos i of N cells into ``out`` ``[N, C]``; pair: see `_pair`."""
    state, column, value = np.empty(ROWS * LANES), np.empty(LANES), np.empty(LANES)
    for start in range(first_part * PART, min(len(n), end_part * PART), LANES):
        size = min(LANES, len(n) - start)
        _load(n, b, c, theta, start, size, state)
        _open(pair, state)
        for band in range(w.shape[1]):
            _column(w, band, start, size, column)
            _band(state, column, value)
            for j in range(size):
                out[start + j, band] = value[j]


@spread(lambda *arguments: math.ceil(len(arguments[0]) / PART))
@njit(cache=True, nogil=True)
def pull_back(n, b, c, theta, w, pair, grad, gn, gb, gc, gt, gw, first_part, end_part):
    """Gradients ``[N, 3]``, ``[N]`` and ``[N, C]`` of all operands from that of the value ``[N, C]``."""
    state, rates = np.empty(ROWS * LANES), np.empty(G_ROWS * LANES)
    column, above, below = np.empty(LANES), np.empty(LANES), np.empty(LANES)
    for start in range(first_part * PART, min(len(n), end_part * PART), LANES):
        size = min(LANES, len(n) - start)
        _load(n, b, c, theta, start, size, state)
        _open(pair, state)
        rates[:] = 0.0
        for band in range(w.shape[1]):
            _column(w, band, start, size, column)
            _column(grad, band, start, size, above)
            _band_back(state, column, above, below, rates)
            for j in range(size):
                gw[start + j, band] = below[j]
        _close(pair, state, rates)
        for j in range(size):
            gn[start + j, 0], gn[start + j, 1] = rates[G_N0 * LANES + j], rates[G_N1 * LANES + j]
            gn[start + j, 2], gb[start + j] = rates[G_N2 * LANES + j], rates[G_B * LANES + j]
            gc[start + j], gt[start + j] = rates[G_C * LANES + j], rates[G_THETA * LANES + j]


@spread(lambda *arguments: math.ceil(len(arguments[0]) / PART))
@njit(cache=True, nogil=True)
def _differentiate(n, b, c, theta, w, pair, out, slopes, first_part, end_part):
    """As `evaluate`; and derivatives ``[N, C, SLOPES]``, or ``[N, C, 1]``: by w alone."""
    state, rates = np.empty(ROWS * LANES), np.empty(G_ROWS * LANES)
    column, value, below = np.empty(LANES), np.empty(LANES), np.empty(LANES)
    one = np.ones(LANES)
    for start in range(first_part * PART, min(len(n), end_part * PART), LANES):
        size = min(LANES, len(n) - start)
        _load(n, b, c, theta, start, size, state)
        _open(pair, state)
        for band in range(w.shape[1]):
            _column(w, band, start, size, column)
            _band(state, column, value)
            rates[:] = 0.0
            _band_back(state, column, one, below, rates)
            for j in range(size):
                out[start + j, band], slopes[start + j, band, 0] = value[j], below[j]
            if slopes.shape[2] == 1:
                continue
            _close(pair, state, rates)
            for j in range(size):
                slopes[start + j, band, 1] = rates[G_B * LANES + j]
                slopes[start + j, band, 2] = rates[G_C * LANES + j]
                slopes[start + j, band, 3] = rates[G_THETA * LANES + j]


def _pair(sun: Tensor, view: Tensor) -> np.ndarray:
    """Sun, view, their cross product, and the squares of |sun + view| and |sun - view|: ``[11]``."""
    s, v = (np.asarray(x.detach().numpy(), np.float64) for x in (sun, view))
    return np.concatenate([s, v, np.cross(s, v), [np.sum((s + v) ** 2), np.sum((s - v) ** 2)]])


class _Light(torch.autograd.Function):
    """BRF cos i on tensors of a processor, flat; the way back works all out again, which is cheaper than memory."""

    @staticmethod
    def forward(ctx: Any, pair: np.ndarray, *operands: Tensor) -> Tensor:
        """Operands: normal ``[N, 3]``, b, c, theta ``[N]``, w ``[N, C]``."""
        out = torch.empty_like(operands[-1])
        evaluate(*(o.detach().numpy() for o in operands), pair, out.numpy())
        ctx.pair = pair
        ctx.save_for_backward(*operands)
        return out

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *grads: Tensor) -> tuple[Tensor | None, ...]:
        """Of the operands, from the gradient ``[N, C]``."""
        operands = ctx.saved_tensors
        found = [torch.empty_like(o) for o in operands]
        arrays = [o.detach().numpy() for o in operands]
        grad = grads[0].contiguous().numpy()
        pull_back(*arrays, ctx.pair, grad, *(g.numpy() for g in found))
        return (None, *found)


def _flat(normal: Tensor, w: Tensor, shape: tuple[Tensor, Tensor, Tensor]) -> list[Tensor]:
    """Operands as the kernels take them: normal ``[N, 3]``, b, c, theta ``[N]``, w ``[N, C]``, in memory's order."""
    cells = w.shape[:-1]
    flat = [normal.expand(*cells, 3).reshape(-1, 3), *(p.expand(cells).reshape(-1) for p in shape)]
    return [o.contiguous() for o in (*flat, w.reshape(-1, w.shape[-1]))]


def hapke_light(normal: Tensor, sun: Tensor, view: Tensor, w: Tensor, shape: tuple[Tensor, Tensor, Tensor]) -> Tensor:
    """BRF cos i ``[..., C]`` of Hapke's model, on processors; differentiable once in all but the directions.

    Args:
        normal: ``[..., 3]`` unit vectors.
        sun: ``[3]`` unit vector to the sun.
        view: ``[3]`` unit vector to the sensor.
        w: ``[..., C]`` single-scattering albedo.
        shape: b, c, theta-bar [degrees], each ``[...]``.
    """
    value: Tensor = _Light.apply(_pair(sun, view), *_flat(normal, w, shape))
    return value.reshape(w.shape)


@torch.no_grad()
def hapke_slopes(
    normal: Tensor, sun: Tensor, view: Tensor, w: Tensor, shape: tuple[Tensor, Tensor, Tensor], *, shapes: bool = True
) -> tuple[Tensor, Tensor]:
    """`hapke_light` and its derivatives ``[..., C, 4]`` by w, b, c and theta-bar (per degree).

    Args:
        normal: ``[..., 3]`` unit vectors.
        sun: ``[3]`` unit vector to the sun.
        view: ``[3]`` unit vector to the sensor.
        w: ``[..., C]`` single-scattering albedo.
        shape: b, c, theta-bar [degrees], each ``[...]``.
        shapes: also by the shapes; else ``[..., C, 1]``.
    """
    operands = _flat(normal, w, shape)
    out = torch.empty_like(operands[-1])
    slopes = out.new_empty(*out.shape, SLOPES if shapes else 1)
    arrays = [o.detach().numpy() for o in operands]
    _differentiate(*arrays, _pair(sun, view), out.numpy(), slopes.numpy())
    return out.reshape(w.shape), slopes.reshape(*w.shape, -1)


__all__ = ["hapke_light", "hapke_slopes"]
