"""Reflectance of single facets for the ray tracer: Lambert, RPV and Hapke as scalar functions of angles.

Written from the papers' own equations (angles by arc cosine, cotangents, one case each for i <= e and e < i), so that
it shares neither code nor algebra with what a fit uses: Hapke (1981, 1984) with the H function of Hapke (2002), Icarus
157, 523-534, and no opposition effect; Rahman, Pinty & Verstraete (1993), J. Geophys. Res. 98(D11), equations 2-5.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from sattools.compiled import njit

LAMBERT, RPV, HAPKE = 0, 1, 2
LEVEL_SUN_DEG = 15.0  # from the vertical, as in the maps of a fit
_TINY = 1e-9

_jit = njit(cache=True, nogil=True, fastmath=False)


@_jit
def hapke(i: float, e: float, psi: float, g: float, w: float, b: float, c: float, theta: float) -> float:
    """BRF; all angles in radians, i and e below 90 degrees, psi in [0, pi], 0 <= w < 1, theta > 0.

    ``c`` is the weight of the back-scattering lobe.
    """
    i, e = max(i, 1e-6), max(e, 1e-6)
    t = math.tan(theta)
    chi = 1.0 / math.sqrt(1.0 + math.pi * t * t)
    cot_t, cot_i, cot_e = 1.0 / t, 1.0 / math.tan(i), 1.0 / math.tan(e)
    e1_i, e1_e = math.exp(-2.0 / math.pi * cot_t * cot_i), math.exp(-2.0 / math.pi * cot_t * cot_e)
    e2_i, e2_e = math.exp(-((cot_t * cot_i) ** 2) / math.pi), math.exp(-((cot_t * cot_e) ** 2) / math.pi)
    eta_i = chi * (math.cos(i) + math.sin(i) * t * e2_i / (2.0 - e1_i))
    eta_e = chi * (math.cos(e) + math.sin(e) * t * e2_e / (2.0 - e1_e))
    f = math.exp(-2.0 * math.tan(psi / 2.0)) if psi < math.pi - 1e-6 else 0.0
    half = math.sin(psi / 2.0) ** 2
    if i <= e:
        d = 2.0 - e1_e - psi / math.pi * e1_i
        mu0e = chi * (math.cos(i) + math.sin(i) * t * (math.cos(psi) * e2_e + half * e2_i) / d)
        mue = chi * (math.cos(e) + math.sin(e) * t * (e2_e - half * e2_i) / d)
        s = mue / eta_e * math.cos(i) / eta_i * chi / (1.0 - f + f * chi * math.cos(i) / eta_i)
    else:
        d = 2.0 - e1_i - psi / math.pi * e1_e
        mu0e = chi * (math.cos(i) + math.sin(i) * t * (e2_i - half * e2_e) / d)
        mue = chi * (math.cos(e) + math.sin(e) * t * (math.cos(psi) * e2_i + half * e2_e) / d)
        s = mue / eta_e * math.cos(i) / eta_i * chi / (1.0 - f + f * chi * math.cos(e) / eta_e)
    p = (1.0 - c) * (1.0 - b * b) / (1.0 + 2.0 * b * math.cos(g) + b * b) ** 1.5
    p += c * (1.0 - b * b) / (1.0 - 2.0 * b * math.cos(g) + b * b) ** 1.5
    bracket = p + chandrasekhar(mu0e, w) * chandrasekhar(mue, w) - 1.0
    return w / 4.0 / math.cos(i) * mu0e / (mu0e + mue) * bracket * s


@_jit
def diffusive(w: float) -> float:
    """Diffusive reflectance r0 of isotropic scatterers, of Hapke (2002), equation 13."""
    gamma = math.sqrt(1.0 - w)
    return (1.0 - gamma) / (1.0 + gamma)


@_jit
def chandrasekhar(x: float, w: float) -> float:
    """H(x), Hapke (2002), equation 13."""
    r0 = diffusive(w)
    return 1.0 / (1.0 - w * x * (r0 + (1.0 - 2.0 * r0 * x) / 2.0 * math.log((1.0 + x) / x)))


@_jit
def rpv(i: float, e: float, psi: float, g: float, rho0: float, k: float, asymmetry: float, rhoc: float) -> float:
    """BRF; angles in radians; ``asymmetry`` < 0 scatters back."""
    cos_i, cos_e = math.cos(i), math.cos(e)
    bowl = (cos_i * cos_e * (cos_i + cos_e)) ** (k - 1.0)
    lobe = (1.0 - asymmetry**2) / (1.0 + 2.0 * asymmetry * math.cos(g) + asymmetry**2) ** 1.5
    square = math.tan(i) ** 2 + math.tan(e) ** 2 - 2.0 * math.tan(i) * math.tan(e) * math.cos(psi)
    return rho0 * bowl * lobe * (1.0 + (1.0 - rhoc) / (1.0 + math.sqrt(max(square, 0.0))))


@_jit
def radiance_factor(
    model: int, nx: float, ny: float, nz: float, sx: float, sy: float, sz: float, vx: float, vy: float, vz: float,
    amplitude: float, p1: float, p2: float, p3: float,
) -> float:  # fmt: skip
    """BRF * cos i = pi L / E of a facet, E the irradiance across the beam; 0 where it faces away from sun or sensor.

    Args:
        model: LAMBERT, RPV or HAPKE.
        nx: unit vectors: normal, to the sun, to the sensor.
        ny: unit vectors: normal, to the sun, to the sensor.
        nz: unit vectors: normal, to the sun, to the sensor.
        sx: unit vectors: normal, to the sun, to the sensor.
        sy: unit vectors: normal, to the sun, to the sensor.
        sz: unit vectors: normal, to the sun, to the sensor.
        vx: unit vectors: normal, to the sun, to the sensor.
        vy: unit vectors: normal, to the sun, to the sensor.
        vz: unit vectors: normal, to the sun, to the sensor.
        amplitude: albedo, rho0 or w.
        p1: b, c, theta-bar [degrees] of Hapke; k, asymmetry, rhoc of RPV; not used by Lambert.
        p2: b, c, theta-bar [degrees] of Hapke; k, asymmetry, rhoc of RPV; not used by Lambert.
        p3: b, c, theta-bar [degrees] of Hapke; k, asymmetry, rhoc of RPV; not used by Lambert.

    Where p1 is not a number the facet reflects as Lambert's law has it, with the model's reflectance for light from all
    sides (w's diffusive reflectance, or rho0).
    """
    cos_i = nx * sx + ny * sy + nz * sz
    cos_e = nx * vx + ny * vy + nz * vz
    if cos_i <= _TINY or cos_e <= _TINY:
        return 0.0
    cos_i, cos_e = min(cos_i, 1.0), min(cos_e, 1.0)
    if model == LAMBERT or math.isnan(p1):
        return (diffusive(amplitude) if model == HAPKE else amplitude) * cos_i
    i, e = math.acos(cos_i), math.acos(cos_e)
    cos_g = min(max(sx * vx + sy * vy + sz * vz, -1.0), 1.0)
    g = math.acos(cos_g)
    sines = math.sin(i) * math.sin(e)
    psi = math.acos(min(max((cos_g - cos_i * cos_e) / sines, -1.0), 1.0)) if sines > _TINY else 0.0
    if model == RPV:
        return rpv(i, e, psi, g, amplitude, p1, p2, p3) * cos_i
    return hapke(i, e, psi, g, amplitude, p1, p2, math.radians(max(p3, 1e-3))) * cos_i


@_jit
def level_brf(model: int, amplitude: Any, parameters: Any) -> Any:
    """BRF ``[H, W, C]`` of level facets seen from above, the sun `LEVEL_SUN_DEG` from the vertical.

    Args:
        model: LAMBERT, RPV or HAPKE.
        amplitude: ``[H, W, C]`` albedo, rho0 or w.
        parameters: ``[H, W, 3]``, see `radiance_factor`.
    """
    tilt = math.radians(LEVEL_SUN_DEG)
    found = np.empty(amplitude.shape)
    for r in range(amplitude.shape[0]):
        for c in range(amplitude.shape[1]):
            p1, p2, p3 = parameters[r, c]
            for k in range(amplitude.shape[2]):
                found[r, c, k] = radiance_factor(
                    model, 0.0, 0.0, 1.0, math.sin(tilt), 0.0, math.cos(tilt), 0.0, 0.0, 1.0,
                    amplitude[r, c, k], p1, p2, p3,
                ) / math.cos(tilt)  # fmt: skip
    return found


__all__ = ["HAPKE", "LAMBERT", "LEVEL_SUN_DEG", "RPV", "chandrasekhar", "hapke", "level_brf", "radiance_factor", "rpv"]
