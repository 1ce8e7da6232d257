"""Where the sun stood: position from time and place by the NREL solar position algorithm."""

from __future__ import annotations

from datetime import UTC, datetime

from sattools.errors import InputError


def sun_position(time: datetime, lon: float, lat: float, height: float = 0.0) -> tuple[float, float]:
    """Azimuth (degrees clockwise from true north) and elevation (degrees, with refraction) of the sun.

    Args:
        time: UTC; a time without zone is taken as UTC.
        lon: degrees. height: metres above the ellipsoid.
        lat: degrees. height: metres above the ellipsoid.
        height: ``[H, W]`` [m].

    Raises:
        InputError: a place that is not on Earth.

    Source: Reda and Andreas 2004 (NREL/TP-560-34302) as kept by pvlib; good to 0.0003 degrees from -2000 to 6000.
    """
    if not (-360.0 <= lon <= 360.0 and -90.0 <= lat <= 90.0):
        raise InputError(f"sun position: found longitude {lon} and latitude {lat}, expected degrees on Earth")
    import pandas
    from pvlib.solarposition import get_solarposition

    utc = time.replace(tzinfo=UTC) if time.tzinfo is None else time.astimezone(UTC)
    table = get_solarposition(pandas.DatetimeIndex([utc]), lat, lon, altitude=height, method="nrel_numpy")
    return float(table["azimuth"].iloc[0]), float(table["apparent_elevation"].iloc[0])


__all__ = ["sun_position"]
