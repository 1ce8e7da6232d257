"""STAC items and vector features of what prep found."""

from __future__ import annotations

import json
import math
from typing import Any

import numpy as np

from sattools.camera import RPC
from sattools.camera.adjust import Adjustment, ViewAdjustment
from sattools.camera.ground import (
    azimuth_elevation,
    convergence_deg,
    grid_direction,
    ground_sample_distance,
    to_grid_north,
    view_direction,
)
from sattools.camera.sun import sun_position
from sattools.prep.images import SourceImage
from sattools.prep.layout import footprint
from sattools.prep.metadata import DEFAULT_ORBIT_KM, EARTH_KM, ORBIT_KM
from sattools.prep.pixels import significant_bits, value_range
from sattools.prep.times import date_alone
from sattools.radiometry.bands import named_bands
from sattools.scene import GEOTIFF_TYPE, Asset, Grid, Item
from sattools.scene.globe import outline_on_globe
from sattools.scene.location import RemotePath


def off_nadir_deg(incidence_deg: float, platform: str | None) -> float:
    """Angle at the satellite between the ground point and the nadir, from the angle at the ground.

    sin(off nadir) = R / (R + H) sin(incidence) on a sphere; H is the platform's orbit.
    """
    height = ORBIT_KM.get(platform or "", DEFAULT_ORBIT_KM)
    return math.degrees(math.asin(EARTH_KM / (EARTH_KM + height) * math.sin(math.radians(incidence_deg))))


def sun_angles(source: SourceImage, lon: float, lat: float, height: float) -> tuple[float, float, str] | None:
    """(azimuth, elevation, where from) of the sun: metadata, else time and place; None when neither is known.

    A date alone tells no sun.

    Args:
        source: the image.
        lon: longitude [degrees].
        lat: latitude [degrees].
        height: of the ground [m].
    """
    meta = source.metadata
    if meta.sun is not None:
        return *meta.sun, "metadata"
    if meta.time is not None and not date_alone(meta.time):
        azimuth, elevation = sun_position(meta.time, lon, lat, height)
        return round(azimuth, 4), round(elevation, 4), "time and place"
    return None


def describe(source: SourceImage, rpc: RPC, view: ViewAdjustment, grid: Grid, heights: tuple[float, float]) -> Item:
    """The STAC item of an image; `rpc` is the corrected camera of its window. Adds notes to the source.

    `view:azimuth` is the direction from the ground to the sensor, clockwise from true north, as vendors give it.

    Args:
        source: the image.
        rpc: the camera.
        view: its adjustment.
        grid: ground grid.
        heights: lowest and highest height [m].
    """
    width, height = source.window[2], source.window[3]
    middle = 0.5 * (heights[0] + heights[1])
    lon, lat = rpc.localization((width - 1) / 2, (height - 1) / 2, middle)
    polygon = footprint(rpc, (0, 0, width, height), middle)
    direction = view_direction(rpc, lon, lat, middle)
    azimuth, elevation = azimuth_elevation(direction)
    incidence = 90.0 - float(elevation)
    meta = source.metadata
    low, high = value_range(source)
    properties: dict[str, Any] = {
        "datetime": meta.time.isoformat().replace("+00:00", "Z") if meta.time else None,
        "proj:code": None,  # an image in sensor geometry lies in no CRS
        "proj:shape": [height, width],
        "gsd": round(ground_sample_distance(rpc, lon, lat, middle), 4),
        "view:off_nadir": round(off_nadir_deg(incidence, meta.platform), 3),
        "view:incidence_angle": round(incidence, 3),
        "view:azimuth": round(float(azimuth), 3),
        "sattools:view_direction": _rounded(to_grid_north(direction, convergence_deg(grid.crs, lon, lat))),
        "sattools:bits": significant_bits(source, high),
        "sattools:dtype": source.dtype,
        "sattools:bands": source.bands,
        "sattools:value_range": [low, high],
        "sattools:source": str(source.path if isinstance(source.path, RemotePath) else source.path.absolute()),
        "sattools:source_window": list(source.window),
        "sattools:rpc_source": meta.rpc_source,
        "sattools:rpc_shift_px": [round(v, 4) for v in view.shift_px],
        "sattools:tie_points": view.tie_points,
        "sattools:residual_px": round(view.median_after_px, 4),
        "sattools:outlier_view": view.outlier,
    }
    if meta.platform:
        properties["platform"] = meta.platform
    if meta.time is None:
        source.notes.append("time unknown: no metadata and no name says when it was taken")
    sun = sun_angles(source, lon, lat, middle)
    if sun is not None and sun[1] <= 0:  # by time and place: `camera_gate` has refused such metadata
        below = f"time and place put the sun {sun[1]:.1f} degrees above the horizon"
        source.warn(f"{below}: taken as unknown; is the time right?")
        sun = None
    if sun is None:
        properties["sattools:sun"] = "unknown"
        if meta.time is not None and date_alone(meta.time):
            source.warn(f"sun unknown: {meta.time:%Y-%m-%d} 00:00:00 is taken for a date without a time of day")
        if meta.time is None:
            source.notes.append("sun unknown: neither sun angles nor a time were found")
    else:
        properties["view:sun_azimuth"], properties["view:sun_elevation"] = sun[0], sun[1]
        properties["sattools:sun"] = sun[2]
        properties["sattools:sun_direction"] = _rounded(grid_direction(sun[0], sun[1], grid.crs, lon, lat))
    assets = {
        "image": Asset(
            f"images/{source.id}.tif", GEOTIFF_TYPE, ["data"], named_bands(meta.platform, source.descriptions)
        ),
        "rpc": Asset(f"rpc/{source.id}_RPC.TXT", "text/plain", ["metadata"]),
    }
    return Item(source.id, *outline_on_globe(list(polygon.exterior.coords)), properties, assets)


def tie_point_features(result: Adjustment) -> str:
    """Accepted ground points as GeoJSON (longitude, latitude, ellipsoidal height) with views and mean residual."""
    sizes = result.tracks.sizes()
    length = np.hypot(result.residuals[:, 0], result.residuals[:, 1])
    mean = np.bincount(result.tracks.point, length, result.tracks.n_points) / np.maximum(sizes, 1)
    features = [
        {
            "type": "Feature",
            "geometry": {"type": "Point", "coordinates": [round(lon, 8), round(lat, 8), round(h, 3)]},
            "properties": {"height_m": round(h, 3), "views": int(n), "residual_px": round(r, 3)},
        }
        for (lon, lat, h), n, r in zip(result.points.tolist(), sizes.tolist(), mean.tolist(), strict=True)
    ]
    return json.dumps({"type": "FeatureCollection", "features": features}, separators=(",", ":")) + "\n"


def _rounded(vector: Any) -> list[float]:
    return [round(float(v), 8) for v in vector]


__all__ = ["describe", "off_nadir_deg", "sun_angles", "tie_point_features"]
