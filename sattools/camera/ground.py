"""Cameras over a projected ground grid: rays in its coordinates, directions of view, and the angle of its north.

Directions are unit vectors (east, north, up) from the ground to the sensor or to the sun; azimuths count clockwise from
north, in degrees. "True" north is the meridian's; grid north differs from it by the meridian convergence.
"""

from __future__ import annotations

import math
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from pyproj import CRS, Transformer
from pyproj.exceptions import CRSError

from sattools.camera.rpc import RPC
from sattools.errors import InputError
from sattools.scene.grid import Grid

Array = NDArray[np.float64]

_A = 6378137.0  # WGS84 semi-major axis [m]
_SCALE_TOLERANCE = 0.02  # of a projection: UTM two zones away is off by 1.5 %
_E2 = 6.69437999014e-3  # WGS84 first eccentricity squared


def utm_crs(lon: float, lat: float) -> str:
    """`EPSG:326zz` or `EPSG:327zz`, the UTM zone of a place (without the exceptions around Norway)."""
    zone = math.floor((lon + 180.0) / 6.0) % 60 + 1
    return f"EPSG:{(32600 if lat >= 0 else 32700) + zone}"


@lru_cache(maxsize=32)
def _transformer(source: str, target: str) -> Transformer:
    try:
        return Transformer.from_crs(source, target, always_xy=True)
    except CRSError:
        unknown = source if target == "EPSG:4326" else target
        raise InputError(f"CRS {unknown[:200]!r}: found none that is known, expected e.g. EPSG:32617") from None


def check_projected(crs: str) -> str:
    """The CRS as given, or InputError if it is unknown or not projected in metres."""
    try:
        parsed = CRS.from_user_input(crs)
    except CRSError:
        raise InputError(f"CRS {crs[:200]!r}: found none that is known, expected e.g. EPSG:32617") from None
    if not parsed.is_projected or any(abs(a.unit_conversion_factor - 1.0) > 1e-9 for a in parsed.axis_info[:2]):
        raise InputError(f"CRS {crs!r}: found one that is not projected in metres, expected e.g. EPSG:32617")
    return crs


def check_ground_crs(crs: str) -> str:
    """The CRS as given, or InputError if it is not projected in metres or says what heights are above.

    A scene's heights are above the ellipsoid; a map of them in a CRS of other heights would say that they are those.

    Args:
        crs: of a scene that is being made.
    """
    parsed = CRS.from_user_input(check_projected(crs))
    if parsed.is_compound or len(parsed.axis_info) > 2:
        level = parsed.to_2d().to_authority() or ("EPSG", "32617")
        raise InputError(
            f"CRS {crs[:200]!r}: found one with heights of its own, expected that of a map such as {':'.join(level)}: "
            "heights are above the ellipsoid, `export --vertical` writes others"
        )
    return crs


def to_geographic(crs: str, x: ArrayLike, y: ArrayLike) -> tuple[Any, Any]:
    """(lon, lat) in degrees of grid coordinates in metres.

    Args:
        crs: projected ground CRS [m].
        x: easting [m].
        y: northing [m].
    """
    return _transformer(crs, "EPSG:4326").transform(x, y)


def middle_lon_lat(grid: Grid) -> tuple[float, float]:
    """(lon, lat) in degrees of the middle of a grid.

    Args:
        grid: ground grid.
    """
    lon, lat = to_geographic(grid.crs, *grid.middle)
    return float(lon), float(lat)


def from_geographic(crs: str, lon: ArrayLike, lat: ArrayLike) -> tuple[Any, Any]:
    """Grid coordinates in metres of (lon, lat) in degrees.

    Args:
        crs: projected ground CRS [m].
        lon: longitude [degrees].
        lat: latitude [degrees].
    """
    return _transformer("EPSG:4326", crs).transform(lon, lat)


def project(rpc: RPC, crs: str, x: ArrayLike, y: ArrayLike, z: ArrayLike) -> tuple[Any, Any]:
    """Pixel (col, row) of points given in the ground CRS [m]; x, y, z broadcast.

    Args:
        rpc: the camera.
        crs: projected ground CRS [m].
        x: eastings [m].
        y: northings [m].
        z: heights [m].
    """
    xs, ys = np.broadcast_arrays(np.asarray(x, np.float64), np.asarray(y, np.float64))
    lon, lat = to_geographic(crs, xs, ys)
    return rpc.projection(lon, lat, z)


def localize(rpc: RPC, crs: str, col: ArrayLike, row: ArrayLike, z: ArrayLike) -> tuple[Any, Any]:
    """Grid coordinates (x, y) [m] where the pixel's line of sight meets height z [m]; the arguments broadcast.

    Args:
        rpc: the camera.
        crs: projected ground CRS [m].
        col: columns [px].
        row: rows [px].
        z: height above the ellipsoid [m].
    """
    return from_geographic(crs, *rpc.localization(col, row, z))


def ground_rays(rpc: RPC, crs: str, cols: ArrayLike, rows: ArrayLike, z0: float, z1: float) -> tuple[Array, Array]:
    """Lines of sight: grid coordinates `[..., 2]` of each pixel at heights z0 and z1 [m].

    Between the two a satellite's ray is straight in a projected CRS to far below a millimetre over some hundred metres.

    Args:
        rpc: the camera.
        crs: projected ground CRS [m].
        cols: columns [px].
        rows: rows [px].
        z0: first height [m].
        z1: second height [m].
    """
    low = np.stack(localize(rpc, crs, cols, rows, z0), axis=-1)
    high = np.stack(localize(rpc, crs, cols, rows, z1), axis=-1)
    return low, high


def metres_per_degree(lat: float, h: float = 0.0) -> tuple[float, float]:
    """Metres of one degree of longitude and of latitude at a place on the WGS84 ellipsoid."""
    phi = math.radians(lat)
    w2 = 1.0 - _E2 * math.sin(phi) ** 2
    east = (_A / math.sqrt(w2) + h) * math.cos(phi)
    north = _A * (1.0 - _E2) / w2**1.5 + h
    return math.radians(east), math.radians(north)


def check_scale(crs: str, lon: float, lat: float) -> None:
    """Raise InputError where a metre of the CRS is none on the ground, as far from its own region or in web maps.

    Args:
        crs: projected ground CRS [m].
        lon: longitude [degrees].
        lat: latitude [degrees].
    """
    scale = [math.hypot(*step) for step in _steps(crs, lon, lat)]
    worst = max(scale, key=lambda s: abs(s - 1) if math.isfinite(s) else math.inf)
    if not abs(worst - 1) <= _SCALE_TOLERANCE:
        symptom = f"{worst:.3g} m in it are 1 m on the ground" if math.isfinite(worst) else "it does not reach there"
        raise InputError(
            f"CRS {crs}: found that at {lat:.3f} N {lon:.3f} E {symptom}, expected a CRS of this region such as "
            f"{utm_crs(lon, lat)}"
        )


def _steps(crs: str, lon: float, lat: float) -> Array:
    """Where one metre on the ground eastwards and one northwards lead on the map: rows ``[2, 2]`` of (x, y) [m].

    Measured on the ellipsoid; the factors that PROJ gives for web maps are those of their sphere. Numbers that are not
    finite where the map does not reach.
    """
    if not (math.isfinite(lon) and math.isfinite(lat)):  # of coordinates that are none of the map's
        raise InputError(f"CRS {crs}: found coordinates where it does not reach, expected some of its region")
    east, north = metres_per_degree(lat)
    step = 10.0
    x, y = from_geographic(crs, [lon, lon + step / east, lon], [lat, lat, lat + step / north])
    with np.errstate(invalid="ignore"):
        return np.array([[x[1] - x[0], y[1] - y[0]], [x[2] - x[0], y[2] - y[0]]]) / step


def ground_area(crs: str, bounds: tuple[float, float, float, float]) -> float:
    """Square metres on the ellipsoid of one square metre of a map, in the middle of a part of it.

    In the middle of a UTM zone they are 1.0008, at its edge 0.9980 near the equator; over 50 km they change by less
    than 0.001.

    Args:
        crs: projected ground CRS [m].
        bounds: west, south, east, north of the part, in that CRS [m].

    Raises:
        InputError: the map does not reach there.
    """
    west, south, east, north = bounds
    lon, lat = (float(v) for v in to_geographic(crs, (west + east) / 2, (south + north) / 2))
    (a, b), (c, d) = _steps(crs, lon, lat).tolist()
    area = abs(a * d - b * c)
    if not (math.isfinite(area) and area > 0):
        raise InputError(f"CRS {crs}: found coordinates where it does not reach, expected some of its region")
    return float(1.0 / area)


def check_metres(name: str, crs: str, bounds: tuple[float, float, float, float]) -> None:
    """Raise InputError, naming a file, where its CRS does not count metres on the ground.

    Args:
        name: of the file.
        crs: of it.
        bounds: west, south, east, north in that CRS.
    """
    west, south, east, north = bounds
    try:
        check_projected(crs)
        check_scale(crs, *(float(v) for v in to_geographic(crs, (west + east) / 2, (south + north) / 2)))
    except InputError as error:
        raise InputError(f"{name}: {error}") from None


def view_direction(rpc: RPC, lon: float, lat: float, h: float) -> Array:
    """Unit vector (east, north, up), true north, from a ground point to the sensor.

    It is the direction that does not move the pixel: the cross product of the two rows of the projection's Jacobian.

    Args:
        rpc: the camera.
        lon: longitude [degrees].
        lat: latitude [degrees].
        h: height above the ellipsoid [m].
    """
    east, north = metres_per_degree(lat, h)
    jac = rpc.jacobian(lon, lat, h) / np.array([east, north, 1.0])
    d = np.cross(jac[0], jac[1])
    d = d / np.linalg.norm(d)
    return d if d[2] >= 0 else -d


def direction(azimuth_deg: ArrayLike, elevation_deg: ArrayLike) -> Array:
    """Unit vectors `[..., 3]` (east, north, up) of azimuth (from north) and elevation [degrees]."""
    azimuth, elevation = np.radians(azimuth_deg), np.radians(elevation_deg)
    flat = np.cos(elevation)
    return np.stack([flat * np.sin(azimuth), flat * np.cos(azimuth), np.sin(elevation)], axis=-1)


def azimuth_elevation(vector: ArrayLike) -> tuple[Any, Any]:
    """Azimuth in [0, 360) and elevation in degrees of vectors `[..., 3]`; inverse of `direction`."""
    v = np.asarray(vector, np.float64)
    azimuth = np.degrees(np.arctan2(v[..., 0], v[..., 1])) % 360.0
    elevation = np.degrees(np.arctan2(v[..., 2], np.hypot(v[..., 0], v[..., 1])))
    return azimuth[()], elevation[()]


def convergence_deg(crs: str, lon: float, lat: float) -> float:
    """True azimuth of grid north in degrees: grid azimuth = true azimuth - convergence.

    Args:
        crs: projected ground CRS [m].
        lon: longitude [degrees].
        lat: latitude [degrees].
    """
    step = 1e-4
    x, y = from_geographic(crs, [lon, lon], [lat - step, lat + step])
    return -math.degrees(math.atan2(x[1] - x[0], y[1] - y[0]))


def to_grid_north(vector: ArrayLike, convergence: float) -> Array:
    """Directions `[..., 3]` relative to true north, expressed relative to grid north (convergence in degrees)."""
    v = np.asarray(vector, np.float64)
    c, s = math.cos(math.radians(convergence)), math.sin(math.radians(convergence))
    return np.stack([c * v[..., 0] - s * v[..., 1], s * v[..., 0] + c * v[..., 1], v[..., 2]], axis=-1)


def grid_direction(azimuth_deg: float, elevation_deg: float, crs: str, lon: float, lat: float) -> Array:
    """Unit vector (east, north, up) in the grid's axes of an azimuth from true north, as metadata give it.

    Args:
        azimuth_deg: from north, clockwise [degrees].
        elevation_deg: above the horizon [degrees].
        crs: projected ground CRS [m].
        lon: longitude [degrees].
        lat: latitude [degrees].
    """
    return to_grid_north(direction(azimuth_deg, elevation_deg), convergence_deg(crs, lon, lat))


def ground_sample_distance(rpc: RPC, lon: float, lat: float, h: float) -> float:
    """Geometric mean of the edges of a pixel on level ground [m].

    Args:
        rpc: the camera.
        lon: longitude [degrees].
        lat: latitude [degrees].
        h: height above the ellipsoid [m].
    """
    east, north = metres_per_degree(lat, h)
    jac = rpc.jacobian(lon, lat, h)[:, :2] / np.array([east, north])
    return float(abs(np.linalg.det(jac)) ** -0.5)


def foreshortening(rpc: RPC, lon: float, lat: float, h: float) -> tuple[float, float]:
    """Tangent of the incidence angle by the camera's heights, and length over width of its pixels on the ground.

    The length is along the line of sight on level ground, the width across. Square pixels of a camera that looks
    down at incidence i are 1 / cos i times as long as wide, whatever its heights are counted in.

    Args:
        rpc: the camera.
        lon: longitude [degrees].
        lat: latitude [degrees].
        h: height above the ellipsoid, in the camera's unit.
    """
    east, north = metres_per_degree(lat, h)
    jac = rpc.jacobian(lon, lat, h)
    plane = jac[:, :2] / np.array([east, north])
    shift = np.linalg.solve(plane, -jac[:, 2])  # ground metres per unit of height
    tangent = float(np.hypot(*shift))
    along = shift / tangent if tangent > 0 else np.array([0.0, 1.0])
    across = np.array([-along[1], along[0]])
    return tangent, float(np.hypot(*(plane @ across)) / np.hypot(*(plane @ along)))


def crop_window(
    rpc: RPC,
    crs: str,
    bounds: tuple[float, float, float, float],
    heights: tuple[float, float],
    size: tuple[int, int],
    margin: int,
) -> tuple[int, int, int, int]:
    """Part of an image (height, width) that may show the area at any of the heights, with a margin in pixels.

    Width or height is 0 where the image does not see the area, or its camera knows no pixel of a part of it.

    Args:
        rpc: the camera.
        crs: projected ground CRS [m].
        bounds: (west, south, east, north) [m].
        heights: lowest and highest height [m].
        size: (height, width) of the image [px].
        margin: around it [px].

    Returns: (first column, first row, width, height).
    """
    west, south, east, north = bounds
    t = np.linspace(0.0, 1.0, 5)
    x, y, z = np.meshgrid(west + t * (east - west), south + t * (north - south), np.array(heights))
    col, row = project(rpc, crs, x.ravel(), y.ravel(), z.ravel())
    if not (np.isfinite(col).all() and np.isfinite(row).all()):
        return (0, 0, 0, 0)
    col0, col1 = max(0, math.floor(col.min()) - margin), min(size[1], math.ceil(col.max()) + margin + 1)
    row0, row1 = max(0, math.floor(row.min()) - margin), min(size[0], math.ceil(row.max()) + margin + 1)
    return (col0, row0, max(0, col1 - col0), max(0, row1 - row0))


def grid_sun(grid: Grid, azimuth_deg: float, elevation_deg: float) -> tuple[float, float, float]:
    """Unit vector (east, north, up) on the grid to a sun given from true north and the horizon.

    Args:
        grid: ground grid.
        azimuth_deg: from north, clockwise [degrees].
        elevation_deg: above the horizon [degrees].
    """
    vector = grid_direction(azimuth_deg, elevation_deg, grid.crs, *middle_lon_lat(grid))
    return float(vector[0]), float(vector[1]), float(vector[2])


__all__ = [
    "azimuth_elevation", "check_ground_crs", "check_metres", "check_projected", "check_scale",
    "convergence_deg", "crop_window", "direction", "foreshortening", "from_geographic", "grid_direction",
    "grid_sun", "ground_area", "ground_rays", "ground_sample_distance", "localize", "metres_per_degree",
    "middle_lon_lat", "project", "to_geographic", "to_grid_north", "utm_crs", "view_direction",
]  # fmt: skip
