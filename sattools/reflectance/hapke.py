"""Hapke's bidirectional reflectance of a rough particulate surface.

Hapke (1981, 1984, 1986), with the double Henyey-Greenstein phase function, the H function of Hapke (2002), Icarus 157,
523-534, and macroscopic roughness (`sattools.reflectance.roughness`):

    BRF = pi r / mu0 = (w/4) K {p(g) [1 + B(g)] + H(mu0e) H(mue) - 1}
    p(g) = (1-b^2) [(1-c) / (1 + 2b cos g + b^2)^(3/2) + c / (1 - 2b cos g + b^2)^(3/2)], c = weight of the back lobe
    B(g) = b0 / (1 + tan(g/2) / h)
    H(x) = 1 / {1 - w x [r0 + (1/2 - r0 x) ln((1+x)/x)]},   r0 = (1 - sqrt(1-w)) / (1 + sqrt(1-w))

Values and gradients are finite on the closed domain: both directions anywhere in the upper hemisphere, theta-bar 1e-4
to 60 degrees, w and b 0 to 0.99, c 0 to 1. At the horizon itself the limit is taken, beyond it the BRF is 0 with zero
gradients.

Bounds beyond the valid range: w is held at `W_MAX` (at w = 1 the derivative is infinite), |b| at `B_MAX` (at b = 1
the lobe is a spike), theta-bar between `THETA_MIN` and `THETA_MAX` degrees; at a bound the gradient is 0. b0, c and
h > 0 are taken as they come.

Kinks, where one of the two one-sided derivatives or their mean is returned:
- psi = 0 and psi = 180 degrees (the principal plane): psi is the modulus of an azimuth; the mean is returned;
- i = e: the two cases of the roughness meet with equal values but different slopes; the mean is returned;
- g = 0 with b0 > 0, with respect to sun and view only: B is a cone; 0 is returned for its part;
- i = 90 or e = 90 degrees: the BRF drops to 0; the derivative from above the horizon is returned;
- i = e = 90 degrees: at psi = 180 the BRF tends to 0 at a rate that depends on the direction of approach; at psi = 0
  it is infinite (the radiance is not) and the denominator is held at `sattools.reflectance.hapke_limits.Z_MIN`.

First derivatives only, through `torch.autograd`.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from sattools.reflectance import roughness
from sattools.reflectance.angles import Angles, Pair, as_tensors, measure, pair, pull_back
from sattools.reflectance.blocks import Blocks
from sattools.reflectance.hapke_limits import B_MAX, THETA_MAX, THETA_MIN, W_MAX

_DEGREE = math.pi / 180


class _Lobes(NamedTuple):
    """Phase function and opposition effect, with what their reverse needs."""

    b: Tensor
    front: Tensor
    back: Tensor
    width: Tensor
    p: Tensor
    # of the opposition effect: |sun - view|, |sun + view|, 1 / (h plus + minus), 1 + B
    minus: Tensor | None
    plus: Tensor | None
    rate: Tensor | None
    boost: Tensor | None


class _Multiple(NamedTuple):
    """H functions of the effective cosines, with what their reverse needs."""

    w: Tensor
    r0: Tensor
    gamma: Tensor
    shrink: Tensor
    xlo: Tensor
    xhi: Tensor
    log_lo: Tensor
    log_hi: Tensor
    hlo: Tensor
    hhi: Tensor


def _lobes(angles: Angles, b: Tensor, c: Tensor, b0: Tensor | None, h: Tensor) -> _Lobes:
    b = b.clamp(-B_MAX, B_MAX)
    width = (1 - b) * (1 + b)
    gap2 = (1 - b) ** 2
    # 1 + 2b cos g + b^2 and its sibling as sums of positive terms
    front, back = torch.rsqrt(gap2 + b * angles.plus2), torch.rsqrt(gap2 + b * angles.minus2)
    front3 = front * front * front
    p = width * (front3 + c * (back * back * back - front3))
    if b0 is None:
        return _Lobes(b, front, back, width, p, None, None, None, None)
    # keeps the derivatives of the roots finite at g = 0 and g = 180 degrees
    tiny = torch.finfo(b.dtype).tiny
    minus, plus = angles.minus2.clamp_min(tiny).sqrt(), angles.plus2.clamp_min(tiny).sqrt()
    rate = 1 / (h * plus + minus)
    return _Lobes(b, front, back, width, p, minus, plus, rate, 1 + b0 * h * plus * rate)


def _multiple(facet: roughness.Facet, w: Tensor, t: Tensor) -> _Multiple:
    w = w.clamp_max(W_MAX)
    gamma = torch.sqrt(1 - w)
    r0 = (1 - gamma) / (1 + gamma)
    shrink = torch.rsqrt(1 + math.pi * t * t)
    xlo, xhi = shrink * facet.a_lo, shrink * facet.a_hi
    log_lo, log_hi = torch.log((1 + xlo) / xlo), torch.log((1 + xhi) / xhi)
    hlo = 1 / (1 - w * xlo * (r0 + (0.5 - r0 * xlo) * log_lo))
    hhi = 1 / (1 - w * xhi * (r0 + (0.5 - r0 * xhi) * log_hi))
    return _Multiple(w, r0, gamma, shrink, xlo, xhi, log_lo, log_hi, hlo, hhi)


def _h_rates(m: _Multiple, x: Tensor, log: Tensor, h: Tensor, g_h: Tensor) -> tuple[Tensor, Tensor]:
    """Gradients of x and w through H(x)."""
    g_f = -g_h * h * h
    r0x = m.r0 * x
    tail = 0.5 - r0x
    mid = m.r0 + tail * log
    g_x = -g_f * m.w * (mid - r0x * log - tail / (1 + x))
    slope = m.gamma * (1 + m.gamma) * (1 + m.gamma)
    g_w = -g_f * x * (mid + m.w * (1 - x * log) / slope)
    return g_x, g_w


def _stop(grad: Tensor, value: Tensor, low: float, high: float) -> Tensor:
    """The gradient where the value lies between the bounds, else 0 (the reverse of clamp, in one pass)."""
    return torch.ops.aten.hardtanh_backward(*torch.broadcast_tensors(grad, value), low, high)


class _Hapke(torch.autograd.Function):
    """The model with its reverse written out, block by block.

    Operands are in the order of `hapke`, b0 None for no opposition.

    Without an axis of bands the derivatives are worked out along with the value, while everything is in the cache,
    and eight numbers a sample are kept. With bands the intermediate values are kept instead, so that gradients are
    summed over bands before they go on to the geometry.
    """

    @staticmethod
    def forward(ctx: Any, needed: tuple[bool, ...], *operands: Any) -> Tensor:
        normal = operands[0]
        facets, shape = _shapes(operands)
        blocks = Blocks(tuple(shape), normal.is_cuda)
        known = _known(blocks, operands)
        out = normal.new_empty(shape)
        keep, ctx.direct = any(needed), facets == shape
        kept: list = []
        for block in blocks.ranges:
            parts = _cut(blocks, block, operands)
            n, s, v, w, b, c, theta, b0, h = parts
            angles = measure(n, s, v, known)
            t = roughness.tangent_of(theta)
            facet = roughness.forward(angles, t)
            lobes = _lobes(angles, b, c, b0, h)
            multiple = _multiple(facet, w, t)
            p = lobes.p if lobes.boost is None else lobes.p * lobes.boost
            inner = p + (multiple.hlo * multiple.hhi - 1)
            blocks.cut(out, block).copy_((0.25 * facet.lit) * (multiple.w * facet.k) * inner)
            if keep and ctx.direct:
                kept += _reverse(parts, known, (t, facet, lobes, multiple, inner), None, needed)
            elif keep:
                kept += [t, *facet, *lobes, *multiple, inner]
        if keep:
            ctx.blocks, ctx.needed = blocks, needed
            ctx.save_for_backward(*operands, *kept)
        return out

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *grads: Tensor) -> tuple[Tensor | None, ...]:
        saved, needed, blocks = ctx.saved_tensors, ctx.needed, ctx.blocks
        operands, kept = saved[:9], saved[9:]
        each = len(kept) // len(blocks.ranges)
        known = None if ctx.direct else _known(blocks, operands)
        total: list = [None] * 9
        for number, block in enumerate(blocks.ranges):
            state = kept[number * each : (number + 1) * each]
            grad = blocks.cut(grads[0], block)
            parts = _cut(blocks, block, operands)
            gradients: list[Tensor | None]
            if ctx.direct:
                gradients = [
                    None if rate is None else rate * (grad if index > 2 else grad[..., None])
                    for index, rate in enumerate(state)
                ]
            else:
                gradients = _reverse(parts, known, _unpack(state), grad, needed)
            for index, gradient in enumerate(gradients):
                if gradient is not None and needed[index]:
                    _collect(total, index, gradient.sum_to_size(parts[index].shape), operands[index], blocks, block)
        return (None, *total)


def _unpack(state: tuple) -> tuple:
    values = iter(state)

    def take(kind: Any) -> Any:
        return kind(*[next(values) for _ in kind._fields])

    return next(values), take(roughness.Facet), take(_Lobes), take(_Multiple), next(values)


def _collect(total: list, index: int, part: Tensor, operand: Tensor, blocks: Blocks, block: tuple[int, int]) -> None:
    """Put a block's gradient where it belongs: beside those of other blocks, or onto them if the operand is shared."""
    if not blocks.is_cut(operand, int(index < 3)):
        total[index] = part if total[index] is None else total[index] + part
        return
    if total[index] is None:
        total[index] = torch.empty_like(operand)
    blocks.cut(total[index], block, int(index < 3)).copy_(part)


def _cut(blocks: Blocks, block: tuple[int, int], operands: tuple) -> list:
    return [None if o is None else blocks.cut(o, block, int(index < 3)) for index, o in enumerate(operands)]


def _known(blocks: Blocks, operands: tuple) -> Pair | None:
    """The `Pair` of sun and view if it serves all blocks."""
    sun, view = operands[1:3]
    return None if blocks.is_cut(sun, 1) or blocks.is_cut(view, 1) else pair(sun, view)


def _reverse_phase(
    parts: list, known: Pair, o: _Lobes, g_inner: Tensor, needed: tuple[bool, ...], gradients: list[Tensor | None]
) -> tuple[Tensor | None, Tensor | None]:
    """Gradients of b, c, B0 and h, filled in; those of (1 -+ cos g) / 2 where a direction needs them."""
    _, _, _, _, b, c, _, b0, h = parts
    directions = needed[1] or needed[2]
    # summed over bands first
    g_p = g_inner.sum_to_size(torch.broadcast_shapes(o.p.shape, () if o.boost is None else o.boost.shape))
    g_minus2 = g_plus2 = None
    if o.boost is not None:
        g_boost = g_p * o.p
        g_p = (g_p * o.boost).sum_to_size(o.p.shape)
        damp = h * o.plus * o.rate
        gradients[7] = g_boost * damp if needed[7] else None
        slope = g_boost * b0 * o.rate * o.rate
        gradients[8] = slope * o.plus * o.minus if needed[8] else None
        if directions:
            g_minus2 = -0.5 * slope * h * o.plus / o.minus
            g_plus2 = 0.5 * slope * h * o.minus / o.plus
    if needed[4] or needed[5] or directions:
        front2, back2 = o.front * o.front, o.back * o.back
        front3, back3 = front2 * o.front, back2 * o.back
        weighted = g_p * o.width
        gradients[5] = weighted * (back3 - front3) if needed[5] else None
        if needed[4] or directions:
            a, z = (1 - c) * front3, c * back3
            fall_a, fall_z = -1.5 * weighted * a * front2, -1.5 * weighted * z * back2
            gap = 2 * (o.b - 1)
            g_b = fall_a * (gap + known.plus2) + fall_z * (gap + known.minus2) - 2 * g_p * o.b * (a + z)
            if needed[4]:
                gradients[4] = _stop(g_b, b, -B_MAX, B_MAX)
            if directions:
                g_plus2 = _add(fall_a * o.b, g_plus2)
                g_minus2 = _add(fall_z * o.b, g_minus2)
    return g_minus2, g_plus2


def _reverse(
    parts: list, known: Pair | None, state: tuple, grad: Tensor | None, needed: tuple[bool, ...]
) -> list[Tensor | None]:
    """Gradients of the nine operands of a block, before sums over broadcast axes; ``grad`` None stands for 1."""
    n, s, v, w, _, _, theta, _, _ = parts
    known = known or pair(s, v)
    t, facet, o, m, inner = state
    geometry = any(needed[:3])
    directions = needed[1] or needed[2]
    gradients: list[Tensor | None] = [None] * 9

    base = 0.25 * facet.lit if grad is None else grad * (0.25 * facet.lit)
    scaled = base * facet.k
    g_inner = scaled * m.w
    g_w = scaled * inner
    g_k = (base * m.w * inner).sum_to_size(facet.k.shape)

    g_minus2, g_plus2 = _reverse_phase(parts, known, o, g_inner, needed, gradients)

    # H functions; from here on gradients have the shape of the geometry
    x_lo, w_lo = _h_rates(m, m.xlo, m.log_lo, m.hlo, g_inner * m.hhi)
    x_hi, w_hi = _h_rates(m, m.xhi, m.log_hi, m.hhi, g_inner * m.hlo)
    if needed[3]:
        gradients[3] = _stop(g_w + w_lo + w_hi, w, -math.inf, W_MAX)
    if not geometry and not needed[6]:
        return gradients
    x_lo, x_hi = x_lo.sum_to_size(facet.a_lo.shape), x_hi.sum_to_size(facet.a_hi.shape)
    g_t, g_angles = roughness.reverse(facet, t, x_lo * m.shrink, x_hi * m.shrink, g_k, geometry)
    tt = t * t
    # shrink = (1 + pi t^2)^(-1/2)
    g_t = g_t - math.pi * t * m.shrink * m.shrink * (x_lo * m.xlo + x_hi * m.xhi)
    if needed[6]:
        gradients[6] = _stop(g_t * (_DEGREE + _DEGREE * tt), theta, THETA_MIN, THETA_MAX)
    if g_angles is not None:
        if directions:
            g_angles = g_angles._replace(minus2=_add(g_angles.minus2, g_minus2), plus2=_add(g_angles.plus2, g_plus2))
        gradients[:3] = pull_back(n, s, v, known, g_angles, needed)
    return gradients


def _add(a: Tensor, b: Tensor | None) -> Tensor:
    return a if b is None else a + b


def hapke(
    normal: Tensor,
    sun: Tensor,
    view: Tensor,
    w: Tensor | float,
    b: Tensor | float,
    c: Tensor | float,
    theta_deg: Tensor | float,
    b0: Tensor | float = 0.0,
    h: Tensor | float = 1.0,
) -> Tensor:
    """BRF of Hapke's model.

    Args:
        normal: unit vectors ``[..., 3]`` away from the surface.
        sun: unit vectors ``[..., 3]`` away from the surface.
        view: unit vectors ``[..., 3]`` away from the surface.
        w: single-scattering albedo, 0 to 0.99; this and all that follow broadcastable to ``[...]``.
        b: width of the phase function's lobes, 0 to 0.99.
        c: weight of the back lobe, 0 to 1.
        theta_deg: mean slope angle theta-bar [degrees], 1e-4 to 60.
        b0: amplitude of the opposition effect; 0 leaves it out.
        h: angular width of the opposition effect, above 0.

    With bands, give the directions an axis of 1 (``normal[..., None, :]``): what does not depend on the band is then
    computed once.

    Returns:
        Bidirectional reflectance factor pi L / E, E the irradiance of the facet (beam irradiance times cos i); 0
        where it faces away from sun or sensor. Type of the inputs; differentiable once with respect to all of them.

    Raises:
        TypeError, ValueError: see `sattools.reflectance.angles.as_tensors`.
    """
    operands, needed = _operands(normal, sun, view, w, b, c, theta_deg, b0, h)
    facets, shape = _shapes(operands)
    if facets == shape and all(o is None or o.device.type == "cpu" for o in operands):
        from sattools.reflectance.hapke_kernel import CompiledHapke

        return CompiledHapke.apply(needed, shape, *operands)
    return _Hapke.apply(needed, *operands)


def plain_hapke(normal: Tensor, sun: Tensor, view: Tensor, *parameters: Tensor | float) -> Tensor:
    """`hapke` by the formulas of this module on any device: what is compiled for processors, in torch.

    Args:
        normal: ``[..., 3]`` unit vectors.
        sun: unit vector (east, north, up) to the sun.
        view: unit vector(s) to the sensor.
        *parameters: as of `hapke`, from w on.
    """
    opposition = (0.0, 1.0)[len(parameters) - 4 :]  # b0 and h, where they are not given
    operands, needed = _operands(normal, sun, view, *parameters, *opposition)
    return _Hapke.apply(needed, *operands)


def _operands(
    normal: Tensor, sun: Tensor, view: Tensor, *parameters: Tensor | float
) -> tuple[list[Tensor | None], tuple[bool, ...]]:
    """All nine arguments of `hapke` as tensors, b0 None for no opposition effect, and which need gradients."""
    operands: list[Tensor | None] = [*as_tensors(normal, sun, view, *parameters)]
    b0 = parameters[4]
    if not isinstance(b0, Tensor) and b0 == 0:
        operands[7] = None
    return operands, tuple(torch.is_grad_enabled() and o is not None and o.requires_grad for o in operands)


def _shapes(operands: Sequence[Any]) -> tuple[torch.Size, torch.Size]:
    """Broadcast shapes of the geometry (directions and theta-bar) and of the result."""
    facets = torch.broadcast_shapes(*[o.shape[:-1] for o in operands[:3]], operands[6].shape)
    return facets, torch.broadcast_shapes(facets, *[p.shape for p in operands[3:] if p is not None])
