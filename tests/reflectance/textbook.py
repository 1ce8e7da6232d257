"""Hapke's and Rahman's equations as printed, for plain numbers: slow, readable, independent of the package."""

import math


def effective(i: float, e: float, psi: float, theta: float) -> tuple[float, float, float]:
    """mu0e, mue and S; angles in radians, 0 < i, e < pi/2."""
    t = math.tan(theta)
    chi = 1 / math.sqrt(1 + math.pi * t**2)

    def e1(x: float) -> float:
        return math.exp(-2 / math.pi / t / math.tan(x))

    def e2(x: float) -> float:
        return math.exp(-1 / math.pi / t**2 / math.tan(x) ** 2)

    def eta(x: float) -> float:
        return chi * (math.cos(x) + math.sin(x) * t * e2(x) / (2 - e1(x)))

    f = math.exp(-2 * math.tan(psi / 2))
    half = math.sin(psi / 2) ** 2
    if i <= e:
        d = 2 - e1(e) - psi / math.pi * e1(i)
        mu0e = chi * (math.cos(i) + math.sin(i) * t * (math.cos(psi) * e2(e) + half * e2(i)) / d)
        mue = chi * (math.cos(e) + math.sin(e) * t * (e2(e) - half * e2(i)) / d)
        bracket = 1 - f + f * chi * math.cos(i) / eta(i)
    else:
        d = 2 - e1(i) - psi / math.pi * e1(e)
        mu0e = chi * (math.cos(i) + math.sin(i) * t * (e2(i) - half * e2(e)) / d)
        mue = chi * (math.cos(e) + math.sin(e) * t * (math.cos(psi) * e2(i) + half * e2(e)) / d)
        bracket = 1 - f + f * chi * math.cos(e) / eta(e)
    return mu0e, mue, mue / eta(e) * math.cos(i) / eta(i) * chi / bracket


def phase(i: float, e: float, psi: float) -> float:
    return math.acos(min(1.0, math.cos(i) * math.cos(e) + math.sin(i) * math.sin(e) * math.cos(psi)))


def hapke(
    i: float, e: float, psi: float, w: float, b: float, c: float, theta: float, b0: float = 0, h: float = 1
) -> float:
    """BRF; angles in radians."""
    mu0e, mue, s = effective(i, e, psi, theta)
    g = phase(i, e, psi)
    p = (1 - c) * (1 - b**2) / (1 + 2 * b * math.cos(g) + b**2) ** 1.5
    p += c * (1 - b**2) / (1 - 2 * b * math.cos(g) + b**2) ** 1.5
    opposition = b0 / (1 + math.tan(g / 2) / h)
    r0 = (1 - math.sqrt(1 - w)) / (1 + math.sqrt(1 - w))

    def many(x: float) -> float:
        return 1 / (1 - w * x * (r0 + (1 - 2 * r0 * x) / 2 * math.log((1 + x) / x)))

    inner = p * (1 + opposition) + many(mu0e) * many(mue) - 1
    return w / 4 / math.cos(i) * mu0e / (mu0e + mue) * inner * s


def rpv(i: float, e: float, psi: float, rho0: float, k: float, theta: float, rhoc: float) -> float:
    """BRF; angles in radians."""
    mu0, mu, g = math.cos(i), math.cos(e), phase(i, e, psi)
    lobe = (1 - theta**2) / (1 + 2 * theta * math.cos(g) + theta**2) ** 1.5
    x, y = math.tan(i), math.tan(e)
    distance = math.sqrt(x**2 + y**2 - 2 * x * y * math.cos(psi))
    return rho0 * (mu0 * mu * (mu0 + mu)) ** (k - 1) * lobe * (1 + (1 - rhoc) / (1 + distance))
