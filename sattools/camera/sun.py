"""Where the sun stood: position from time and place, by the standard models of the International Astronomical Union."""

from __future__ import annotations

import math
import warnings
from datetime import UTC, datetime

import numpy as np

from sattools.errors import InputError

_DYNAMICAL_S = 69.0  # seconds by which terrestrial time is ahead: 42 in 1970, 69 in 2020; the sun moves 1e-5 deg in one
_SUN_RADIUS_DEG = 0.26667
_HORIZON_DEG = 0.5667  # refraction at the horizon; a sun wholly below it is given without any
_LIGHT_M_S = 299792458.0
_ASTRONOMICAL_UNIT_M = 149597870700.0
_DAY_S = 86400.0


def sun_position(time: datetime, lon: float, lat: float, height: float = 0.0) -> tuple[float, float]:
    """Azimuth (degrees clockwise from true north) and elevation (degrees, with refraction) of the sun.

    Args:
        time: UTC; a time without zone is taken as UTC.
        lon: longitude [degrees].
        lat: latitude [degrees].
        height: above the ellipsoid [m].

    Raises:
        InputError: a place that is not on Earth.

    Source: the Earth's orbit, precession, nutation and rotation of the IAU's SOFA library (ERFA), good to a thousandth
    of a degree from 1900 to 2100 but for the difference between UTC and the Earth's rotation (up to 0.004 degrees);
    refraction as in Reda and Andreas 2004 (NREL/TP-560-34302), eq. 42, at 12 degrees Celsius.
    """
    if not (-360.0 <= lon <= 360.0 and -90.0 <= lat <= 90.0):
        raise InputError(f"sun position: found longitude {lon} and latitude {lat}, expected degrees on Earth")
    east, north, up = _to_sun(
        time.replace(tzinfo=UTC) if time.tzinfo is None else time.astimezone(UTC), lon, lat, height
    )
    elevation = math.degrees(math.atan2(up, math.hypot(east, north)))
    return math.degrees(math.atan2(east, north)) % 360.0, elevation + _refraction(elevation, height)


def _to_sun(utc: datetime, lon: float, lat: float, height: float) -> tuple[float, float, float]:
    """Direction (east, north, up) to the sun, without the air."""
    import erfa

    day = utc.toordinal() + 1721424.5  # Julian date of midnight
    part = (utc.hour * 3600 + utc.minute * 60 + utc.second + utc.microsecond * 1e-6) / _DAY_S
    dynamical = part + _DYNAMICAL_S / _DAY_S
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", erfa.ErfaWarning)  # of years before 1900 and after 2100
        around_sun, around_all = erfa.epv00(day, dynamical)  # of the Earth [au], [au/day]
    distance = float(np.linalg.norm(around_sun["p"]))
    speed = around_all["v"] * (_ASTRONOMICAL_UNIT_M / _DAY_S / _LIGHT_M_S)
    seen = erfa.ab(-around_sun["p"] / distance, speed, distance, math.sqrt(1.0 - float(speed @ speed)))
    turned = erfa.rz(erfa.gst06a(day, part, day, dynamical), erfa.pnm06a(day, dynamical))
    # from the Earth's middle to the place: 0.0024 degrees
    sun = turned @ seen * (distance * _ASTRONOMICAL_UNIT_M) - erfa.gd2gc(
        1, math.radians(lon), math.radians(lat), height
    )
    sin_lon, cos_lon = math.sin(math.radians(lon)), math.cos(math.radians(lon))
    sin_lat, cos_lat = math.sin(math.radians(lat)), math.cos(math.radians(lat))
    outwards = cos_lon * sun[0] + sin_lon * sun[1]
    return (
        float(cos_lon * sun[1] - sin_lon * sun[0]),
        float(cos_lat * sun[2] - sin_lat * outwards),
        float(cos_lat * outwards + sin_lat * sun[2]),
    )


def _refraction(elevation: float, height: float) -> float:
    """Degrees by which the air of a standard atmosphere lifts the sun."""
    if elevation < -(_SUN_RADIUS_DEG + _HORIZON_DEG):
        return 0.0
    pressure_hpa = max(0.0, (44331.514 - height) / 11880.516) ** (1 / 0.1902632)
    degrees = math.radians(elevation + 10.3 / (elevation + 5.11))
    return pressure_hpa / 1010.0 * 283.0 / (273.0 + 12.0) * 1.02 / (60.0 * math.tan(degrees))


__all__ = ["sun_position"]
