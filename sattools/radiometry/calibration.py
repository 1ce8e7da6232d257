"""Absolute calibration from vendors' metadata: digital numbers -> radiance -> top-of-atmosphere reflectance."""

from __future__ import annotations

import math
import re
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np

from sattools.camera.rpc_formats import read_text
from sattools.errors import InputError
from sattools.radiometry.bands import WORLDVIEW_BANDS, WORLDVIEW_FOUR
from sattools.scene.xmlio import find_all, local_name, parse_xml

# Mean solar irradiance outside the atmosphere [W / m^2 / um] at 1 astronomical unit (Thuillier et al. 2003), from
# "Radiometric Use of WorldView-3 Imagery" (Kuester 2016) and its counterpart for WorldView-2
SOLAR_IRRADIANCE = {
    "WorldView-3": {
        "P": 1574.41, "C": 1757.89, "B": 2004.61, "G": 1830.18, "Y": 1712.07, "R": 1535.33, "RE": 1348.08,
        "N": 1055.94, "N2": 858.77,
    },
    "WorldView-2": {
        "P": 1571.36, "C": 1773.81, "B": 2007.27, "G": 1829.62, "Y": 1701.85, "R": 1538.85, "RE": 1346.09,
        "N": 1053.21, "N2": 856.599,
    },
}  # fmt: skip
# radiometric enhancements (DigitalGlobe) and processings (DIMAP) that leave the numbers proportional to radiance; the
# gains of DIMAP's linear stretch are of what it has stretched
_UNCHANGED = ("", "OFF", "NONE", "BASIC", "LINEAR_STRETCH")


@dataclass(frozen=True)
class BandCalibration:
    """Radiance = gain * DN + offset [W / m^2 / sr / um]; solar irradiance [W / m^2 / um], None if not stated."""

    name: str
    gain: float
    offset: float = 0.0
    irradiance: float | None = None


def read_calibration(path: Path) -> list[BandCalibration]:
    """Calibration of every band in a metadata file, in the image's order; empty where the file states none.

    DigitalGlobe (.IMD, .XML): gain = absCalFactor / effectiveBandwidth (Kuester 2016, eq. 1, with gain 1 and offset 0).
    DIMAP: radiance = DN / GAIN + BIAS, with the solar irradiance beside it. It is of the numbers that the sensor has
    delivered, see `processing_of`.

    Raises:
        InputError: unreadable, or numbers that cannot be a calibration.
    """
    if path.suffix.lower() not in (".imd", ".xml"):
        return []
    root, groups, said = _parsed(path)
    return _dimap(path, root) if _is_dimap(root) else _digitalglobe(path, groups, said.get("BANDID", ""))


def processing_of(path: Path) -> str | None:
    """What a vendor has made of the numbers that its calibration is of (``ACOMP``, ``DISPLAY``); None = nothing.

    Args:
        path: the metadata file.

    Raises:
        InputError: unreadable.
    """
    if path.suffix.lower() not in (".imd", ".xml"):
        return None
    root, _, said = _parsed(path)
    found = said.get("RADIOMETRIC_PROCESSING" if _is_dimap(root) else "RADIOMETRICENHANCEMENT", "").upper()
    return None if found in _UNCHANGED else found


def _is_dimap(root: Any) -> bool:
    return root is not None and local_name(root) == "Dimap_Document"


def _parsed(path: Path) -> tuple[Any, dict[str, dict[str, str]], dict[str, str]]:
    """Root of XML, DigitalGlobe's groups of bands, and the first of all values by their names in capitals."""
    if path.suffix.lower() == ".imd":
        text = read_text(path)
        found = re.finditer(r"BEGIN_GROUP\s*=\s*BAND_(\w+)(.*?)END_GROUP", text, re.DOTALL)
        return None, {group[1]: _values(group[2]) for group in found}, _values(text)
    root = parse_xml(path)
    blocks = [e for e in root.iter() if local_name(e).startswith("BAND_")]
    return root, {local_name(block)[5:]: _texts(block) for block in blocks}, _texts(root)


def _values(text: str) -> dict[str, str]:
    found = list(re.finditer(r"(\w+)\s*=\s*([^;\n]+)", text))
    return {match[1].upper(): match[2].strip().strip('"') for match in reversed(found)}


def _texts(element: Any) -> dict[str, str]:
    return {local_name(e).upper(): (e.text or "").strip() for e in reversed(list(element.iter()))}


def _digitalglobe(path: Path, groups: dict[str, dict[str, str]], product: str) -> list[BandCalibration]:
    rows = {}
    for name, values in groups.items():
        factor = values.get("ABSCALFACTOR", "-")
        if factor.startswith("-") or "EFFECTIVEBANDWIDTH" not in values:  # -1, -999: not stated
            continue
        width = number_of(path, f"effectiveBandwidth of band {name}", values["EFFECTIVEBANDWIDTH"])
        gain = number_of(path, f"absCalFactor of band {name}", factor) / width
        rows[name] = BandCalibration(name, gain)
    # RGB and NRG are products of three bands
    orders = (tuple(product.upper()), WORLDVIEW_BANDS, WORLDVIEW_FOUR)
    return [rows[name] for name in next((order for order in orders if set(order) == set(rows)), rows)]


def _dimap(path: Path, root: Any) -> list[BandCalibration]:
    def table(tag: str, key: str) -> dict[str, dict[str, str]]:
        rows = [{local_name(e): (e.text or "").strip() for e in block.iter()} for block in find_all(root, tag)]
        return {row["BAND_ID"]: row for row in rows if "BAND_ID" in row and key in row}

    radiance, sun = table("Band_Radiance", "GAIN"), table("Band_Solar_Irradiance", "VALUE")
    places = {name: row["BAND_INDEX"] for name, row in table("Raster_Index", "BAND_INDEX").items()}
    entries = []
    for name in in_order(radiance, places):
        gain = number_of(path, f"GAIN of band {name}", radiance[name]["GAIN"])
        bias = number_of(path, f"BIAS of band {name}", radiance[name].get("BIAS") or "0", False)
        irradiance = number_of(path, f"solar irradiance of band {name}", sun[name]["VALUE"]) if name in sun else None
        entries.append(BandCalibration(name, 1 / gain, bias, irradiance))
    return entries


def in_order(names: Collection[str], places: Mapping[str, str]) -> list[str]:
    """Bands of a DIMAP document by their numbers in the image; as they are listed where one of the image has none.

    Bands that the sensor has and the image has not are left out.

    Args:
        names: of the bands, as listed.
        places: name -> ``BAND_INDEX``, of those of the image.
    """
    numbered = bool(places) and set(places) <= set(names) and all(place.isdecimal() for place in places.values())
    return sorted(places, key=lambda name: int(places[name])) if numbered else list(names)


def number_of(path: Path, what: str, text: str, positive: bool = True) -> float:
    """A number of a metadata file.

    Args:
        path: the file, for messages.
        what: the number is, likewise.
        text: of the file.
        positive: it has to be.

    Raises:
        InputError: it is none, not finite, or not positive.
    """
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not math.isfinite(value) or (positive and value <= 0):
        raise InputError(f"{path}: found {text[:40]!r} as {what}, expected a {'positive ' if positive else ''}number")
    return value


def with_irradiance(bands: Sequence[BandCalibration], platform: str | None) -> list[BandCalibration]:
    """The bands with the platform's solar irradiance where the metadata do not state one."""
    known = SOLAR_IRRADIANCE.get(platform or "", {})
    return [BandCalibration(b.name, b.gain, b.offset, b.irradiance or known.get(b.name)) for b in bands]


def earth_sun_distance(time: datetime) -> float:
    """Distance in astronomical units, to 1e-4 (US Naval Observatory, "Approximate Solar Coordinates")."""
    days = (time - datetime(2000, 1, 1, 12, tzinfo=UTC)).total_seconds() / 86400
    g = math.radians(357.529 + 0.98560028 * days)
    return 1.00014 - 0.01671 * math.cos(g) - 0.00014 * math.cos(2 * g)


def reflectance(
    numbers: np.ndarray, bands: Sequence[BandCalibration], distance: float, sun_elevation_deg: float | None
) -> np.ndarray:
    """Reflectance pi L d^2 / (E cos theta_sun), or pi L d^2 / E without a sun elevation; float32, nothing clipped.

    Args:
        numbers: ``[C, H, W]`` digital numbers less the black level.
        bands: one calibration per band, with irradiance.
        distance: Earth to sun [astronomical units].
        sun_elevation_deg: above the horizon, or None.
    """
    cosine = 1.0 if sun_elevation_deg is None else math.sin(math.radians(sun_elevation_deg))
    gain = np.array([b.gain for b in bands])[:, None, None]
    offset = np.array([b.offset for b in bands])[:, None, None]
    irradiance = np.array([b.irradiance for b in bands], np.float64)[:, None, None]
    return (math.pi * distance**2 / (irradiance * cosine) * (gain * numbers + offset)).astype(np.float32)


__all__ = [
    "SOLAR_IRRADIANCE",
    "BandCalibration",
    "earth_sun_distance",
    "in_order",
    "number_of",
    "processing_of",
    "read_calibration",
    "reflectance",
    "with_irradiance",
]
