"""The cubic polynomials of a rational polynomial camera, and their derivatives."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


def monomials(lon: Array, lat: Array, alt: Array) -> Array:
    """The 20 cubic monomials of normalised coordinates in RPC00B order (STDI-0002, app. E), `[20, n]`, unitless.

    Args:
        lon: ``[n]`` normalised longitude.
        lat: ``[n]`` normalised latitude.
        alt: ``[n]`` normalised height.
    """
    m = np.empty((20, lon.size))
    lon2, lat2, alt2 = lon * lon, lat * lat, alt * alt
    m[0] = 1.0
    m[1], m[2], m[3] = lon, lat, alt
    m[4], m[5], m[6] = lon * lat, lon * alt, lat * alt
    m[7], m[8], m[9] = lon2, lat2, alt2
    m[10] = m[4] * alt
    m[11], m[12], m[13] = lon2 * lon, lon * lat2, lon * alt2
    m[14], m[15], m[16] = lon2 * lat, lat2 * lat, lat * alt2
    m[17], m[18], m[19] = lon2 * alt, lat2 * alt, alt2 * alt
    return m


def with_sloped_height(coefficients: Array, slope: tuple[float, float], at_origin: float) -> Array:
    """The polynomials of (x, y, z + slope · (x, y) + at_origin) as polynomials of (x, y, z), which they are exactly.

    Args:
        coefficients: ``[..., 20]`` of `monomials`.
        slope: of the height along normalised longitude and latitude, unitless.
        at_origin: normalised height that is added where both are 0.

    Returns:
        ``[..., 20]``.
    """
    x, y, z = (axis.ravel() for axis in np.meshgrid(*[np.linspace(-1, 1, 5)] * 3))  # any points that tell all 20 apart
    before = monomials(x, y, z + slope[0] * x + slope[1] * y + at_origin)
    change = np.linalg.lstsq(monomials(x, y, z).T, before.T, rcond=None)[0]
    return np.asarray(coefficients @ change.T, np.float64)


def derivative_coefficients(coefficients: Array) -> Array:
    """Derivatives of cubic polynomials, as coefficients ``[3, ..., 10]`` of the first ten monomials.

    Args:
        coefficients: ``[..., 20]`` of `monomials`.

    Returns:
        Those of the derivatives by normalised longitude, latitude and height.
    """
    return np.moveaxis(coefficients[..., _BECOMES] * _POWER, -2, 0)


# which of the twenty becomes 1, x, y, z, xy, xz, yz, x2, y2, z2 in the derivative by x, by y and by z, and its power
_BECOMES = np.array(
    [[1, 7, 4, 5, 14, 17, 10, 11, 12, 13], [2, 4, 8, 6, 12, 10, 18, 14, 15, 16], [3, 5, 6, 9, 10, 13, 16, 17, 18, 19]]
)
_POWER = np.array([[1, 2, 1, 1, 2, 2, 1, 3, 1, 1], [1, 1, 2, 1, 2, 1, 2, 1, 3, 1], [1, 1, 1, 2, 1, 2, 2, 1, 1, 3]])


__all__ = ["derivative_coefficients", "monomials", "with_sloped_height"]
