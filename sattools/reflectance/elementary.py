"""Elementary functions in double precision without calls or branches, so that loops over them compile to vectors.

To a few units in the last place on the arguments that each one names, by series of Taylor's after a reduction.
"""

from __future__ import annotations

import math

import numpy as np

from sattools.compiled import njit

MAGIC = 6755399441055744.0  # 1.5 * 2^52: adding it rounds to an integer, which the last bits then hold


@njit(forceinline=True)
def at_least(value, bound):
    """Max that keeps NaN."""
    return bound if value < bound else value


@njit(forceinline=True)
def at_most(value, bound):
    """Min that keeps NaN."""
    return bound if value > bound else value


@njit(forceinline=True)
def sign(value):
    """-1, 0 or 1."""
    return 1.0 if value > 0 else (-1.0 if value < 0 else 0.0)


@njit(forceinline=True)
def _exp_parts(x):
    """2^k and expm1(r) with x = k ln 2 + r; for -200 < x <= 0."""
    shifted = x * 1.4426950408889634 + MAGIC
    k = shifted - MAGIC
    r = (x - k * 0.693147180369123816490) - k * 1.90821492927058770002e-10
    # Taylor's series: |r| < 0.35
    p = (
        1 / 1 + r * (1 / 2 + r * (1 / 6 + r * (1 / 24 + r * (1 / 120 + r * (1 / 720 + r * (1 / 5040 + r * (1 / 40320
        + r * (1 / 362880 + r * (1 / 3628800 + r * (1 / 39916800 + r * (1 / 479001600 + r * (1 /
        6227020800))))))))))))
    )  # fmt: skip
    power = np.int64((np.float64(shifted).view(np.int64) + 1023) << 52).view(np.float64)
    return power, p * r


@njit(forceinline=True)
def exp(x):
    """For -200 < x <= 0."""
    power, rest = _exp_parts(x)
    return power + power * rest


@njit(forceinline=True)
def expm1(x):
    """For -200 < x <= 0, with all digits near 0."""
    power, rest = _exp_parts(x)
    return power * rest + (power - 1.0)


@njit(forceinline=True)
def log(x):
    """For normal x > 0."""
    bits = np.float64(x).view(np.int64)
    exponent = (bits - 0x3FE6A09E667F3BCD) >> 52
    m = np.int64(bits - (exponent << 52)).view(np.float64)  # 0.707 ... 1.414
    k = np.int64(exponent + 0x4338000000000000).view(np.float64) - MAGIC
    u = (m - 1.0) / (m + 1.0)
    uu = u * u
    p = (
        1 / 1 + uu * (1 / 3 + uu * (1 / 5 + uu * (1 / 7 + uu * (1 / 9 + uu * (1 / 11 + uu * (1 / 13 + uu * (1 / 15 +
        uu * (1 / 17 + uu * (1 / 19 + uu * (1 / 21 + uu * (1 / 23)))))))))))
    )  # fmt: skip
    return k * 0.6931471805599453 + 2.0 * u * p


@njit(forceinline=True)
def angle(y, x):
    """atan2(y, x) for y >= 0."""
    wide = abs(x)
    small, large = (y, wide) if y < wide else (wide, y)
    ratio = small / at_least(large, 1e-300)
    steep = ratio > 0.4142135623730951
    a = (ratio - 1.0) / (ratio + 1.0) if steep else ratio
    aa = a * a
    p = (
        1 / 1 - (1 / 3 - (1 / 5 - (1 / 7 - (1 / 9 - (1 / 11 - (1 / 13 - (1 / 15 - (1 / 17 - (1 / 19 - (1 / 21 - (1 /
        23 - (1 / 25 - (1 / 27 - (1 / 29 - (1 / 31 - (1 / 33 - (1 / 35 - (1 / 37 - (1 / 39 - (1 / 41) * aa) * aa) *
        aa) * aa) * aa) * aa) * aa) * aa) * aa) * aa) * aa) * aa) * aa) * aa) * aa) * aa) * aa) * aa) * aa) * aa
    )  # fmt: skip
    angle = a * p + (0.25 * math.pi if steep else 0.0)
    angle = 0.5 * math.pi - angle if y > wide else angle
    return math.pi - angle if x < 0 else angle


@njit(forceinline=True)
def tan(x):
    """For 0 <= x < 1.5."""
    a = 0.5 * x
    aa = a * a
    p = (
        1 / 1 - (1 / 6 - (1 / 120 - (1 / 5040 - (1 / 362880 - (1 / 39916800 - (1 / 6227020800 - (1 / 1307674368000 -
        (1 / 355687428096000) * aa) * aa) * aa) * aa) * aa) * aa) * aa) * aa
    )  # fmt: skip
    q = (
        1 / 2 - (1 / 24 - (1 / 720 - (1 / 40320 - (1 / 3628800 - (1 / 479001600 - (1 / 87178291200 - (1 /
        20922789888000 - (1 / 6402373705728000) * aa) * aa) * aa) * aa) * aa) * aa) * aa) * aa
    )  # fmt: skip
    sine, cosine = a * p, 1.0 - aa * q
    return 2.0 * sine * cosine / (1.0 - 2.0 * sine * sine)


__all__ = ["angle", "at_least", "at_most", "exp", "expm1", "log", "sign", "tan"]
