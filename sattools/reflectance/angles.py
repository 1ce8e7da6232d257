"""Directions at a facet: cosines, relative azimuth and phase, measured from vectors and never from arc cosines.

``normal``, ``sun`` and ``view`` are unit vectors ``[..., 3]`` that point away from the surface. A model is evaluated where both
cosines are at least 0; exactly at the horizon (0) it takes its limit, beyond it (the facet faces away from sun or sensor) every model of
this package returns 0 with zero gradients.
"""

from __future__ import annotations

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
    """Scalar product over the last axis, ``[..., 3]`` and ``[..., 3]`` to ``[...]``; not a matmul, which may run in TF32."""
    a0, a1, a2 = a.unbind(-1)
    b0, b1, b2 = b.unbind(-1)
    return a0 * b0 + a1 * b1 + a2 * b2


def _cross(a: Tensor, b: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    a0, a1, a2 = a.unbind(-1)
    b0, b1, b2 = b.unbind(-1)
    return a1 * b2 - a2 * b1, a2 * b0 - a0 * b2, a0 * b1 - a1 * b0


def squares(sun: Tensor, view: Tensor) -> tuple[Tensor, Tensor]:
    """``(|sun + view|^2, |sun - view|^2)`` of vectors ``[..., 3]``."""
    s, v = sun.unbind(-1), view.unbind(-1)
    along, apart = [p + q for p, q in zip(s, v)], [p - q for p, q in zip(s, v)]
    plus2 = along[0] * along[0] + along[1] * along[1] + along[2] * along[2]
    return plus2, apart[0] * apart[0] + apart[1] * apart[1] + apart[2] * apart[2]


def measure(normal: Tensor, sun: Tensor, view: Tensor) -> Angles:
    """`Angles` of unit vectors ``[..., 3]`` (broadcast against each other)."""
    n, s, v = normal.unbind(-1), sun.unbind(-1), view.unbind(-1)
    x = _cross(sun, view)
    plus2, minus2 = squares(sun, view)
    return Angles(
        mu0=n[0] * s[0] + n[1] * s[1] + n[2] * s[2],
        mu=n[0] * v[0] + n[1] * v[1] + n[2] * v[2],
        triple=n[0] * x[0] + n[1] * x[1] + n[2] * x[2],
        minus2=minus2,
        plus2=plus2,
    )


def pull_back(
    normal: Tensor, sun: Tensor, view: Tensor, grad: Angles, needed: tuple[bool, bool, bool]
) -> tuple[Tensor | None, Tensor | None, Tensor | None]:
    """Gradients of normal, sun and view ``[..., 3]`` from gradients of their `Angles` (reverse of `measure`).

    The results have the broadcast shape; ``needed`` says which of the three to compute, the others are None.
    """

    def stack(parts: list[Tensor]) -> Tensor:
        return torch.stack(torch.broadcast_tensors(*parts), -1)

    n, s, v = normal.unbind(-1), sun.unbind(-1), view.unbind(-1)
    grads: list[Tensor | None] = [None, None, None]
    if needed[0]:
        x = _cross(sun, view)
        grads[0] = stack([grad.mu0 * s[k] + grad.mu * v[k] + grad.triple * x[k] for k in range(3)])
    if needed[1] or needed[2]:
        apart = [2 * grad.minus2 * (p - q) for p, q in zip(s, v)]
        along = [2 * grad.plus2 * (p + q) for p, q in zip(s, v)]
        if needed[1]:
            x = _cross(view, normal)
            grads[1] = stack([grad.mu0 * n[k] + grad.triple * x[k] + along[k] + apart[k] for k in range(3)])
        if needed[2]:
            x = _cross(normal, sun)
            grads[2] = stack([grad.mu * n[k] + grad.triple * x[k] + along[k] - apart[k] for k in range(3)])
    return grads[0], grads[1], grads[2]


def as_tensors(normal: Tensor, sun: Tensor, view: Tensor, *parameters: Tensor | float) -> list[Tensor]:
    """All arguments as tensors of one floating type on the normal's device; plain numbers do not widen the type.

    Raises:
        TypeError: the type is neither float32 nor float64.
        ValueError: a direction does not end in an axis of 3.
    """
    for name, vector in (("normal", normal), ("sun", sun), ("view", view)):
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
        value.to(dtype) if isinstance(value, Tensor) else torch.as_tensor(value, dtype=dtype, device=normal.device)
        for value in values
    ]
