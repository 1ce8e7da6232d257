"""Are the cameras and suns those of their images? What is surely wrong stops; what may be meant is a warning."""

from __future__ import annotations

import contextlib
import math
from collections.abc import Sequence

import numpy as np

from sattools.camera import RPC
from sattools.camera.adjust import Adjustment
from sattools.camera.ground import foreshortening, ground_sample_distance, view_direction
from sattools.camera.sun import sun_position
from sattools.errors import InputError
from sattools.prep.cameras import SAME_PX, made_for_other_pixels
from sattools.prep.images import SourceImage
from sattools.prep.times import date_alone
from sattools.scene.sidecars import tile_of

_SUN_TOLERANCE_DEG = 5.0  # between metadata and time with place: more than refraction, rounding and a minute's drift
_SUN_FAR_DEG = 12.0  # an hour of local instead of universal time
_CAMERA_TOLERANCE_PX = 40.0  # vendors' cameras are good to some metres; the worst of the contest is off by 36 px
_CAMERA_SHARE = 0.2  # of an image's shorter side
_VIEW_TOLERANCE_DEG = 2.0
_PIXEL_M = (0.005, 2000.0)
_FOOT_M = 0.3048
_LEAST_STRETCH = 0.02  # of pixels on the ground beyond what heights in metres explain: line rates make up to 0.01
_LEAST_UP = 0.17  # sine of ten degrees: no satellite looks flatter


def check_camera(source: SourceImage) -> None:
    """The camera against those of satellites (InputError) and another one that the image brings along (warnings)."""
    rpc, (height, width) = source.rpc, source.size
    lon, lat = rpc.localization((width - 1) / 2, (height - 1) / 2, rpc.alt_offset)
    if not (math.isfinite(lon) and math.isfinite(lat)):
        return  # told where footprints are compared
    with np.errstate(all="ignore"):
        size = ground_sample_distance(rpc, lon, lat, rpc.alt_offset)
        up = float(view_direction(rpc, lon, lat, rpc.alt_offset)[2])
    if not (_PIXEL_M[0] <= size <= _PIXEL_M[1] and up >= _LEAST_UP):
        seen = f"pixels of {size:.3g} m seen {math.degrees(math.asin(min(1.0, up))):.0f} degrees above the horizon"
        raise InputError(
            f"{source.path}: found a camera with {seen if math.isfinite(size + up) else 'no image of the ground'}, "
            f"expected the RPC of a satellite image (from {source.metadata.rpc_source})"
        )
    _check_size(source)
    other = source.tags_rpc
    if other is None or other is rpc:
        return
    col, row = other.projection(lon, lat, rpc.alt_offset)
    away = math.hypot(col - (width - 1) / 2, row - (height - 1) / 2)
    with np.errstate(all="ignore"):
        a, b = view_direction(rpc, lon, lat, rpc.alt_offset), view_direction(other, lon, lat, rpc.alt_offset)
    turned = math.degrees(math.acos(max(-1.0, min(1.0, float(a @ b)))))
    if not away <= _limit_px(source.size) or turned > _VIEW_TOLERANCE_DEG:
        what = f"{away:.0f} px and {turned:.1f} degrees" if math.isfinite(away) else "altogether"
        source.warn(f"its own RPC tags differ from {source.metadata.rpc_source} by {what}: metadata of another image?")
    elif away > SAME_PX:
        whose = source.metadata.rpc_source
        beside = "in a file beside it" if whose == str(source.path) else f"of {whose}"
        source.warn(f"its own RPC tags differ by {away:.1f} px from the camera {beside}, which is taken")


def _check_size(source: SourceImage) -> None:
    """Warn of a camera that is not of this image by its size: programs that write pixels often leave the RPC behind."""
    whole, (height, width) = source.metadata.whole, source.size
    if tile_of(source.path.stem) is not None:
        return
    factor = made_for_other_pixels(source.rpc, source.size)
    if factor is not None:
        source.warn(
            f"its camera, of {source.metadata.rpc_source}, is made for {factor:.3g} times as many pixels along both "
            f"sides as the image has: was it {'reduced' if factor > 1 else 'enlarged'} without its RPC?"
        )
    elif (
        whole not in (None, source.size) and source.tags_rpc is None and source.metadata.rpc_source != str(source.path)
    ):
        source.warn(
            f"its camera, of {source.metadata.rpc_source}, is of an image of {whole[1]} x {whole[0]} pixels by the "
            f"vendor's metadata, this one has {width} x {height}: was it cut or reduced without its RPC?"
        )


def _limit_px(size: tuple[int, int]) -> float:
    return min(_CAMERA_TOLERANCE_PX, max(10.0, _CAMERA_SHARE * min(size)))


def mirrored(rpc: RPC, lon: float, lat: float) -> bool:
    """The camera sees the ground from below, or its longitude and latitude are exchanged.

    Args:
        rpc: the camera.
        lon: longitude [degrees].
        lat: latitude [degrees].
    """
    jac = rpc.jacobian(lon, lat, rpc.alt_offset)[:, :2]
    return bool(np.linalg.det(jac) > 0)


def check_places_and_suns(sources: Sequence[SourceImage]) -> list[str]:
    """Suns of the metadata against those of time and place; notes on all images together.

    Raises: InputError where the sun is below the horizon, or cameras and suns both say that the place is wrong.
    """
    off: list[tuple[SourceImage, float]] = []
    compared, flipped = 0, 0
    for source in sources:
        height, width = source.size
        lon, lat = source.rpc.localization((width - 1) / 2, (height - 1) / 2, source.rpc.alt_offset)
        if not (math.isfinite(lon) and -90 <= lat <= 90):
            continue
        flipped += mirrored(source.rpc, lon, lat)
        sun, time = source.metadata.sun, source.metadata.time
        if sun is not None and sun[1] <= 0:
            raise InputError(
                f"{source.path}: found a sun {sun[1]:g} degrees above the horizon in its metadata, expected an image "
                "taken by day"
            )
        if sun is None or time is None or date_alone(time):
            continue
        compared += 1
        apart = _apart(sun, sun_position(time, lon, lat, source.rpc.alt_offset))
        if apart > _SUN_TOLERANCE_DEG:
            off.append((source, apart))
    notes = []
    mirror = 2 * flipped > len(sources)
    if off and mirror and 2 * len(off) > compared:
        raise InputError(
            f"{off[0][0].path}: found mirrored cameras and suns {off[0][1]:.0f} degrees from where time and place put "
            "them, expected longitudes and latitudes that are not exchanged"
        )
    if mirror:
        notes.append("the cameras see the ground mirrored: are longitude and latitude exchanged?")
    if compared > 1 and len(off) == compared and min(apart for _, apart in off) > _SUN_FAR_DEG:
        least = min(apart for _, apart in off)
        notes.append(
            f"the suns of all images stand {least:.0f} degrees or more from where time and place put them: is the "
            "place right (sign of the latitude), and are the times UTC?"
        )
        return notes
    for source, apart in off:
        source.warn(f"its sun stands {apart:.0f} degrees from where time and place put it: is the metadata its own?")
    return notes


def check_height_unit(sources: Sequence[SourceImage]) -> list[str]:
    """A note where all cameras count heights in feet: their lines of sight look steeper than their pixels do."""
    found = []
    for source in sources:
        height, width = source.size
        lon, lat = source.rpc.localization((width - 1) / 2, (height - 1) / 2, source.rpc.alt_offset)
        if math.isfinite(lon) and math.isfinite(lat):
            with np.errstate(all="ignore"), contextlib.suppress(np.linalg.LinAlgError):
                found.append(foreshortening(source.rpc, lon, lat, source.rpc.alt_offset))
    tangents, stretches = np.array(found or [(0.0, 1.0)]).T

    def off(unit: float) -> float:
        return float(np.sqrt(np.mean((stretches - np.hypot(1.0, tangents / unit)) ** 2)))

    if off(1.0) > _LEAST_STRETCH and off(_FOOT_M) < 0.25 * off(1.0):
        by_heights, by_pixels = (np.degrees(np.arctan(tangents.max() / unit)) for unit in (1.0, _FOOT_M))
        return [
            f"the cameras look down {by_heights:.0f} degrees off the vertical by their heights, {by_pixels:.0f} by "
            "their pixels' shapes: are the heights of the RPCs feet?"
        ]
    return []


def _apart(a: tuple[float, float], b: tuple[float, float]) -> float:
    """Angle in degrees between two directions (azimuth, elevation)."""
    (az_a, el_a), (az_b, el_b) = (tuple(map(math.radians, angles)) for angles in (a, b))
    cosine = math.sin(el_a) * math.sin(el_b) + math.cos(el_a) * math.cos(el_b) * math.cos(az_a - az_b)
    return math.degrees(math.acos(max(-1.0, min(1.0, cosine))))


def check_corrections(result: Adjustment, sources: Sequence[SourceImage]) -> list[str]:
    """Warn of cameras that were off by more than vendors' are; notes on all of them."""
    notes = []
    lengths = [math.hypot(*view.asked_px) for view in result.views]
    if len(lengths) == 2:  # each of them has got half of what they are apart
        lengths = [sum(lengths), 0.0]
    for view, source, length in zip(result.views, sources, lengths, strict=True):
        if not view.weak and length > _limit_px((source.window[3], source.window[2])):
            whose = "; whose camera it is cannot be told from so few" if len(sources) < 4 else ""
            notes.append(
                f"{source.id}: its camera and those of the others are {length:.0f} px apart{whose}: the RPC of this "
                "image and of this part of it?"
            )
    return notes


__all__ = ["check_camera", "check_corrections", "check_height_unit", "check_places_and_suns", "mirrored"]
