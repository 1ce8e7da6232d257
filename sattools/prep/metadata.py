"""What vendors say about an image: camera, time, sun, platform, bits; from sidecar files and from image tags."""

from __future__ import annotations

import math
import re
import unicodedata
from collections.abc import Mapping
from dataclasses import dataclass, fields
from datetime import datetime
from pathlib import Path
from typing import Any

from sattools.camera import RPC
from sattools.camera.rpc_formats import read_text
from sattools.errors import InputError
from sattools.prep.tiles import Tiles, tiles_of_dimap, tiles_of_isd, tiles_of_til
from sattools.prep.times import middle_time, parse_time, time_in_file
from sattools.scene.jsonio import read_json
from sattools.scene.schema import Maybe, Number, NumberText, Table, Text, meant
from sattools.scene.xmlio import find_all, local_name, parse_xml

PLATFORMS = {
    "WV01": "WorldView-1",
    "WV02": "WorldView-2",
    "WV03": "WorldView-3",
    "WV04": "WorldView-4",
    "GE01": "GeoEye-1",
    "QB02": "QuickBird-2",
    "IK01": "IKONOS",
    "PHR1A": "Pleiades-1A",
    "PHR1B": "Pleiades-1B",
    "SPOT6": "SPOT-6",
    "SPOT7": "SPOT-7",
    "PNEO3": "Pleiades-Neo-3",
    "PNEO4": "Pleiades-Neo-4",
}
# Height of the orbit [km]: only the small difference between incidence and off-nadir angle depends on it.
ORBIT_KM = {
    "WorldView-1": 496,
    "WorldView-2": 770,
    "WorldView-3": 617,
    "WorldView-4": 617,
    "GeoEye-1": 681,
    "QuickBird-2": 450,
    "IKONOS": 681,
    "Pleiades-1A": 694,
    "Pleiades-1B": 694,
    "SPOT-6": 694,
    "SPOT-7": 694,
    "Pleiades-Neo-3": 620,
    "Pleiades-Neo-4": 620,
}
DEFAULT_ORBIT_KM = 650
EARTH_KM = 6371.0

_UNKNOWN_ANGLE = 900.0  # -999, 9999 and the like
_NUMBER = NumberText()
# Sat-NeRF's: numbers may be text; what else is there is nobody's business
_SATNERF_JSON = Table(
    {
        "height": Number(1, 10**7, whole=True),
        "width": Number(1, 10**7, whole=True),
        "sun_elevation": Maybe(_NUMBER),
        "sun_azimuth": Maybe(_NUMBER),
        "acquisition_date": Maybe(Text(empty=True)),
        "acquired": Maybe(Text(empty=True)),
        "rpc": Table(),
    }
)
_MAYBE_TEXT = Maybe(Text(empty=True))
_STAC_TEXTS = ("datetime", "start_datetime", "end_datetime", "acquired", "platform")
_STAC_JSON = Table({"properties": Maybe(Table(dict.fromkeys(_STAC_TEXTS, _MAYBE_TEXT)))})


@dataclass
class Metadata:
    """What is known about an image; None = unknown."""

    rpc: RPC | None = None
    rpc_source: str | None = None
    size: tuple[int, int] | None = None  # (height, width) the metadata were made for
    whole: tuple[int, int] | None = None  # (height, width) of the vendor's product, which files may be tiles of
    time: datetime | None = None
    sun: tuple[float, float] | None = None  # azimuth from true north, elevation [degrees]
    platform: str | None = None
    bits: int | None = None
    tiles: Tiles | None = None  # of the product that the image is a part of

    def filled(self, other: Metadata) -> Metadata:
        """This, completed by another source where it is silent."""
        ours = {f.name: getattr(self, f.name) for f in fields(self)}
        return Metadata(**{k: getattr(other, k) if v is None else v for k, v in ours.items()})


def _parse_angle(value: Any, low: float, high: float, source: str = "angle") -> float | None:
    """An angle from a number or text such as "+33.5"; None when missing, or a vendor's word for that such as -999.

    Args:
        value: number or text.
        low: smallest angle allowed [degrees].
        high: largest angle allowed [degrees].
        source: name for error messages.

    Raises: InputError, naming `source`, for a number that is neither that nor within the limits.
    """
    try:
        angle = float(str(value).strip())
    except ValueError:
        return None
    if not math.isfinite(angle) or abs(angle) >= _UNKNOWN_ANGLE:
        return None
    if not low <= angle <= high:
        raise InputError(f"{source}: found {angle:g} degrees, expected {low:g} to {high:g}")
    return angle


def parse_sun(azimuth: Any, elevation: Any, source: str = "sun") -> tuple[float, float] | None:
    """(azimuth in [0, 360), elevation) in degrees, or None unless both are there; raises as `_parse_angle` does.

    Args:
        azimuth: number or text [degrees].
        elevation: number or text [degrees].
        source: name for error messages.
    """
    a = _parse_angle(azimuth, -360.0, 360.0, f"{source}: azimuth of the sun")
    e = _parse_angle(elevation, -90.0, 90.0, f"{source}: elevation of the sun")
    return None if a is None or e is None else (a % 360.0, e)


def _size(rows: str | None, columns: str | None) -> tuple[int, int] | None:
    """(height, width) from texts, None unless both are numbers."""
    texts = [(text or "").strip() for text in (rows, columns)]
    return (int(texts[0]), int(texts[1])) if all(text.isdecimal() and text.isascii() for text in texts) else None


def find_platform(text: str) -> str | None:
    """The platform whose code occurs in a file name, title or satellite identifier."""
    for code, name in PLATFORMS.items():
        if re.search(rf"(?<![A-Z]{{2}}){code}", text.upper()):
            return name
    if re.search(r"_ssc?\d+d?\d*_", text.lower()):
        return "SkySat"
    return None


def _platform_called(text: str) -> str:
    """The platform that somebody spells in a way of their own (``worldview-3``, ``WV03``); others stay as they are."""
    return _SPELLED.get(_spelling(text), text)


def _spelling(text: str) -> str:
    """Letters and digits of a name, small, without accents and zeros before a number."""
    plain = unicodedata.normalize("NFKD", text).casefold()
    return re.sub(r"(?<!\d)0+(?=\d)", "", re.sub(r"[^a-z0-9]", "", plain))


_SPELLED = {_spelling(spelled): name for code, name in PLATFORMS.items() for spelled in (code, name)}


def read_sidecar(path: Path) -> Metadata:
    """All that one metadata file says. Raises InputError when it cannot be read."""
    suffix = path.suffix.lower()
    if suffix == ".json":
        return _from_json(path)
    if suffix == ".xml":
        return _from_xml(path)
    if suffix == ".imd":
        return _from_imd(path)
    if suffix == ".til":
        return Metadata(tiles=tiles_of_til(read_text(path)))
    return Metadata(rpc=RPC.from_file(path), rpc_source=str(path))


def from_tags(tags: Mapping[str, str], name: str) -> Metadata:
    """What image tags (NITF header fields, GML of JPEG 2000) and the file name say, where the sidecars are silent."""
    everything = " ".join(tags.values())
    title = tags.get("NITF_FTITLE", "") + " " + tags.get("NITF_IID2", "")
    # The header's date may be that of a program which cut or converted the image.
    time = parse_time(tags.get("NITF_STDIDC_ACQUISITION_DATE", "")) or parse_time(title, of_file=True)
    # GDAL fills the NITF date with a constant of its own; only an image with a vendor's title says when it was taken.
    if time is None and title.strip() and tags.get("NITF_OSTAID", "").strip() != "GDAL":
        time = parse_time(tags.get("NITF_IDATIM", ""))
    airbus = re.search(r"DS_(PHR1[AB]|SPOT[67]|PNEO[34])_(\d{14})\d?", everything + " " + name)
    if time is None and airbus:
        time = parse_time(airbus[2])
    if time is None:
        time = parse_time(tags.get("ACQUISITIONDATETIME", "")) or parse_time(name, of_file=True)
    platform = find_platform(airbus[1] if airbus else f"{title} {name}")
    bits = tags.get("NITF_ABPP", "").strip()
    sun = parse_sun(tags.get("NITF_USE00A_SUN_AZ"), tags.get("NITF_USE00A_SUN_EL"))
    return Metadata(time=time, platform=platform, bits=int(bits) if bits.isdigit() else None, sun=sun)


def _from_json(path: Path) -> Metadata:
    document = read_json(path)
    if document.get("type") in ("Feature", "FeatureCollection"):
        _STAC_JSON.check(document, str(path))
        properties = document.get("properties") or {}
        # Planet's members are named without STAC's prefix
        azimuth, elevation = (
            properties.get(f"view:{name}", properties.get(name)) for name in ("sun_azimuth", "sun_elevation")
        )
        time = time_in_file(properties.get("datetime") or properties.get("acquired"), path)
        if time is None:
            ends = [time_in_file(properties.get(f"{end}_datetime"), path) for end in ("start", "end")]
            time = middle_time(*ends)
        sun = parse_sun(azimuth, elevation, str(path))
        return Metadata(time=time, platform=_platform_called(properties.get("platform") or "") or None, sun=sun)
    _SATNERF_JSON.check(document, str(path))
    known = _SATNERF_JSON.members.keys()
    for name in document.keys() - known:
        hint = meant(name, known - document.keys(), 0.85)
        if hint:
            raise InputError(f"{path}: found an unknown member {name[:40]!r}, expected a known one{hint}")
    size = None
    if "height" in document and "width" in document:
        size = (int(document["height"]), int(document["width"]))
    has_rpc = "rpc" in document or "row_offset" in document
    return Metadata(
        rpc=RPC.from_file(path) if has_rpc else None,
        rpc_source=str(path) if has_rpc else None,
        size=size,
        time=time_in_file(
            document.get("acquisition_date") or document.get("datetime") or document.get("acquired"), path
        ),
        sun=parse_sun(document.get("sun_azimuth"), document.get("sun_elevation"), str(path)),
    )


def _from_xml(path: Path) -> Metadata:
    root = parse_xml(path)

    def first(*names: str) -> str | None:
        for name in names:
            for element in find_all(root, name):
                if element.text and element.text.strip():
                    return str(element.text).strip()
        return None

    if local_name(root) == "Dimap_Document":
        date, clock = first("IMAGING_DATE"), first("IMAGING_TIME")
        located = find_all(root, "Located_Geometric_Values")
        centre = [e for e in located if any((k.text or "").strip() == "Center" for k in find_all(e, "LOCATION_TYPE"))]
        block = (centre or located or [root])[0]
        angles = {local_name(e): e.text for e in block.iter()}
        mission, index = first("MISSION"), first("MISSION_INDEX")
        names = {"PHLEIADES": "PHR", "PLEIADES": "PHR"}
        code = names.get((mission or "").upper(), (mission or "").upper().replace("-", "")) + (index or "")
        model = bool(find_all(root, "Inverse_Model") or find_all(root, "GroundtoImage_Values"))
        bits = first("NBITS_VALID", "BIT_DEPTH") if not model else None
        raster = {local_name(e): e.text for block in find_all(root, "Raster_Dimensions")[:1] for e in block}
        return Metadata(
            rpc=RPC.from_file(path) if model else None,
            rpc_source=str(path) if model else None,
            time=time_in_file(f"{date}T{clock}", path) if date and clock else None,
            platform=find_platform(code),
            bits=int(bits) if bits and bits.isdigit() and 0 < int(bits) <= 32 else None,
            sun=parse_sun(angles.get("SUN_AZIMUTH"), angles.get("SUN_ELEVATION"), str(path)),
            tiles=tiles_of_dimap(root),
            whole=_size(raster.get("NROWS"), raster.get("NCOLS")),
        )
    model = bool(find_all(root, "RPB"))
    return Metadata(
        rpc=RPC.from_file(path) if model else None,
        rpc_source=str(path) if model else None,
        time=time_in_file(first("FIRSTLINETIME", "EARLIESTACQTIME", "acquisitionDateTime") or "", path),
        platform=find_platform(first("SATID") or ""),
        sun=parse_sun(
            first("MEANSUNAZ", "SUNAZ", "illuminationAzimuthAngle"),
            first("MEANSUNEL", "SUNEL", "illuminationElevationAngle"),
            str(path),
        ),
        tiles=tiles_of_isd(root),
        whole=_size(first("NUMROWS"), first("NUMCOLUMNS")),
    )


def _from_imd(path: Path) -> Metadata:
    """Of a product of several images (``IMAGE_1``, ``IMAGE_2`` ...) the first one's time, sun and satellite, as of XML.

    A mean of suns would be that of none of them, and go with no time.
    """
    found = list(re.finditer(r"(\w+)\s*=\s*([^;\n]+)", read_text(path)))
    values = {match[1].upper(): match[2].strip().strip('"') for match in reversed(found)}
    if not values:
        raise InputError(f"{path}: found no `name = value;` lines, expected DigitalGlobe image metadata (.IMD)")

    def first(*names: str) -> str | None:
        return next((values[n] for n in names if n in values), None)

    return Metadata(
        time=time_in_file(first("FIRSTLINETIME", "EARLIESTACQTIME") or "", path),
        platform=find_platform(first("SATID") or ""),
        sun=parse_sun(first("MEANSUNAZ", "SUNAZ"), first("MEANSUNEL", "SUNEL"), str(path)),
        whole=_size(first("NUMROWS"), first("NUMCOLUMNS")),
    )


__all__ = ["DEFAULT_ORBIT_KM", "EARTH_KM", "ORBIT_KM", "Metadata", "find_platform", "from_tags", "read_sidecar"]
