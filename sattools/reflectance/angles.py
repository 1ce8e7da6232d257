"""Directions at a facet: cosines, relative azimuth and phase, measured from vectors and never from arc cosines.

``normal``, ``sun`` and ``view`` are unit vectors ``[..., 3]`` that point away from the surface. A model is evaluated
where both cosines are at least 0; exactly at the horizon (0) it takes its limit, beyond it (the facet faces away from
sun or sensor) every model of this package returns 0 with zero gradients.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor


class Angles(NamedTuple):
    """Scalars ``[...]`` that describe three unit vectors.

    Attributes:
        mu0: cos i, normal . sun.
        mu: cos e, normal . view.
        triple: normal . (sun x view) = sin i sin e sin(azimuth of view - azimuth of sun), signed.
        minus2: |sun - view|^2 = 4 sin^2(g/2). Precise near the hot spot, where 1 - cos g is rounding noise.
        plus2: |sun + view|^2 = 4 cos^2(g/2).
    """

    mu0: Tensor
    mu: Tensor
    triple: Tensor
    minus2: Tensor
    plus2: Tensor


def dot(a: Tensor, b: Tensor) -> Tensor:
    """Scalar product ``[...]`` of unit vectors ``[..., 3]``; not by matmul, which may run in TF32."""
    return _sum3(a.unbind(-1), b.unbind(-1))


def _sum3(a: Sequence[Tensor], b: Sequence[Tensor]) -> Tensor:
    return torch.addcmul(torch.addcmul(a[0] * b[0], a[1], b[1]), a[2], b[2])


def _cross(a: Tensor, b: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    a0, a1, a2 = a.unbind(-1)
    b0, b1, b2 = b.unbind(-1)
    return a1 * b2 - a2 * b1, a2 * b0 - a0 * b2, a0 * b1 - a1 * b0


class Pair(NamedTuple):
    """What depends on sun and view alone: their vector product (components), |sun + view|^2 and |sun - view|^2."""

    cross: tuple[Tensor, Tensor, Tensor]
    plus2: Tensor
    minus2: Tensor


def pair(sun: Tensor, view: Tensor) -> Pair:
    """`Pair` of unit vectors ``[..., 3]``."""
    s, v = sun.unbind(-1), view.unbind(-1)
    along, apart = [p + q for p, q in zip(s, v)], [p - q for p, q in zip(s, v)]
    plus2 = along[0] * along[0] + along[1] * along[1] + along[2] * along[2]
    minus2 = apart[0] * apart[0] + apart[1] * apart[1] + apart[2] * apart[2]
    return Pair(_cross(sun, view), plus2, minus2)


def measure(normal: Tensor, sun: Tensor, view: Tensor, known: Pair | None = None) -> Angles:
    """`Angles` of unit vectors ``[..., 3]`` (broadcast against each other); ``known``: their `pair`.

    Args:
        normal: ``[..., 3]`` unit vectors.
        sun: unit vector (east, north, up) to the sun.
        view: unit vector(s) to the sensor.
        known: see above.
    """
    n = [part.contiguous() for part in normal.unbind(-1)]
    s, v = sun.unbind(-1), view.unbind(-1)
    x, plus2, minus2 = known or pair(sun, view)
    return Angles(
        mu0=_sum3(n, s),
        mu=_sum3(n, v),
        triple=_sum3(n, x),
        minus2=minus2,
        plus2=plus2,
    )


def pull_back(
    normal: Tensor, sun: Tensor, view: Tensor, known: Pair, grad: Angles, needed: tuple[bool, ...]
) -> tuple[Tensor | None, Tensor | None, Tensor | None]:
    """Gradients of normal, sun and view ``[..., 3]`` from gradients of their `Angles` (reverse of `measure`).

    The results have the broadcast shape; ``needed`` says which of the three to compute, the others are None.

    Args:
        normal: ``[..., 3]`` unit vectors.
        sun: unit vector (east, north, up) to the sun.
        view: unit vector(s) to the sensor.
        known: `pair` of sun and view.
        grad: of the `Angles`.
        needed: whether each operand needs its gradient.
    """
    shape = torch.broadcast_shapes(*[v.shape[:-1] for v in (normal, sun, view)], *[g.shape for g in grad])
    n, s, v = normal.unbind(-1), sun.unbind(-1), view.unbind(-1)
    grads = [normal.new_empty((*shape, 3)) if need else None for need in needed[:3]]
    by_normal, by_sun, by_view = grads
    if by_normal is not None:
        for k in range(3):
            by_normal[..., k] = _sum3((grad.mu0, grad.mu, grad.triple), (s[k], v[k], known.cross[k]))
    if by_sun is not None or by_view is not None:
        apart = [2 * grad.minus2 * (p - q) for p, q in zip(s, v)]
        along = [2 * grad.plus2 * (p + q) for p, q in zip(s, v)]
        if by_sun is not None:
            x = _cross(view, normal)
            for k in range(3):
                by_sun[..., k] = grad.mu0 * n[k] + grad.triple * x[k] + along[k] + apart[k]
        if by_view is not None:
            x = _cross(normal, sun)
            for k in range(3):
                by_view[..., k] = grad.mu * n[k] + grad.triple * x[k] + along[k] - apart[k]
    return by_normal, by_sun, by_view


def as_tensors(normal: Tensor, sun: Tensor, view: Tensor, *parameters: Tensor | float) -> list[Tensor]:
    """All arguments as tensors of one floating type on the normal's device; plain numbers do not widen the type.

    Args:
        normal: ``[..., 3]`` unit vectors.
        sun: unit vector (east, north, up) to the sun.
        view: unit vector(s) to the sensor.
        *parameters: of a model.

    Raises:
        TypeError: a direction is no tensor, or the type is neither float32 nor float64.
        ValueError: a direction does not end in an axis of 3.
    """
    for name, vector in (("normal", normal), ("sun", sun), ("view", view)):
        if not isinstance(vector, Tensor):
            raise TypeError(f"{name}: found {type(vector).__name__}, expected a tensor or an array")
        if vector.ndim == 0 or vector.shape[-1] != 3:
            raise ValueError(f"{name}: found shape {tuple(vector.shape)}, expected [..., 3]")
    values = (normal, sun, view, *parameters)
    dtype = normal.dtype
    for value in values:
        if isinstance(value, Tensor):
            dtype = torch.promote_types(dtype, value.dtype)
    if dtype not in (torch.float32, torch.float64):
        raise TypeError(f"reflectance: found {dtype}, expected float32 or float64")
    return [
        value.to(dtype) if isinstance(value, Tensor) else torch.full((), value, dtype=dtype, device=normal.device)
        for value in values
    ]
