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


def monomial_derivatives(lon: Array, lat: Array, alt: Array) -> tuple[Array, Array, Array]:
    """Derivatives of `monomials` by normalised longitude, latitude and height, three arrays `[20, n]`, unitless.

    Args:
        lon: ``[n]`` normalised longitude.
        lat: ``[n]`` normalised latitude.
        alt: ``[n]`` normalised height.
    """
    dlon, dlat, dalt = np.zeros((3, 20, lon.size))
    lon2, lat2, alt2 = lon * lon, lat * lat, alt * alt
    dlon[1] = dlat[2] = dalt[3] = 1.0
    dlon[4], dlon[5], dlon[7], dlon[10] = lat, alt, 2 * lon, lat * alt
    dlon[11], dlon[12], dlon[13], dlon[14], dlon[17] = 3 * lon2, lat2, alt2, 2 * lon * lat, 2 * lon * alt
    dlat[4], dlat[6], dlat[8], dlat[10] = lon, alt, 2 * lat, lon * alt
    dlat[12], dlat[14], dlat[15], dlat[16], dlat[18] = 2 * lon * lat, lon2, 3 * lat2, alt2, 2 * lat * alt
    dalt[5], dalt[6], dalt[9], dalt[10] = lon, lat, 2 * alt, lon * lat
    dalt[13], dalt[16], dalt[17], dalt[18], dalt[19] = 2 * lon * alt, 2 * lat * alt, lon2, lat2, 3 * alt2
    return dlon, dlat, dalt


__all__ = ["monomial_derivatives", "monomials"]
