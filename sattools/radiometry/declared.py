"""Images that are reflectance already: quantity = gain * DN + offset, from the command line or from metadata."""

from __future__ import annotations

import math
import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from urllib.parse import unquote, urlsplit

import numpy as np

from sattools.errors import InputError, SceneError, counted
from sattools.radiometry.calibration import in_order, number_of
from sattools.scene.jsonio import read_json
from sattools.scene.opening import opened
from sattools.scene.schema import Anything, Items, Maybe, Number, Table, Text
from sattools.scene.xmlio import find_all, local_name, parse_xml

_LEAST_SCALE = 1e-12  # and its inverse the largest: what is beyond turns numbers into zeros or overflows
_OF_ALL = {"raster:scale": Number(), "raster:offset": Number()}  # of an asset, for the bands that have none
_SCALED = Table({"scale": Number(), "offset": Number(), **_OF_ALL})
_STAC = Table(
    {
        "assets": Maybe(
            Table(
                other=Table(
                    {"href": Text(empty=True), "raster:bands": Items(_SCALED), "bands": Items(_SCALED), **_OF_ALL},
                )
            )
        ),
        "features": Anything(),
    }
)
# order of the bands of PlanetScope (4, 8) and RapidEye (5), whose metadata do not name them
_PLANET = {
    4: ("blue", "green", "red", "nir"),
    5: ("blue", "green", "red", "rededge", "nir"),
    8: ("coastal", "blue", "green_i", "green", "yellow", "red", "rededge", "nir"),
}


@dataclass(frozen=True)
class Declared:
    """How an image's numbers are a quantity already.

    Attributes:
        quantity: ``toa_reflectance``, ``reflectance_factor``, ``radiance`` [W / m^2 / sr / um], or None where the
            metadata give a scale without saying of what.
        gain: per band, or one for all [quantity per DN].
        offset: per band, or one for all [quantity].
        source: what says so.
        names: the vendor's names of the bands, or empty.
        full: number from which a pixel is saturated; None = the largest that the file can hold.
    """

    quantity: str | None
    gain: tuple[float, ...]
    offset: tuple[float, ...]
    source: str
    names: tuple[str, ...] = ()
    full: float | None = None

    def of_band(self, number: int) -> tuple[float, float]:
        """Gain and offset of a band, counted from 1.

        Raises:
            SceneError: the metadata do not state it.
        """
        if len(self.gain) == 1:
            return self.gain[0], self.offset[0]
        if number > len(self.gain):
            raise SceneError(
                f"{self.source}: found scales of {counted(len(self.gain), 'bands')}, expected one of band {number}"
            )
        return self.gain[number - 1], self.offset[number - 1]

    def apply(self, numbers: np.ndarray, bands: list[int]) -> np.ndarray:
        """The quantity, float32, nothing clipped.

        Args:
            numbers: ``[C, H, W]`` digital numbers.
            bands: which they are, counted from 1.

        Raises:
            SceneError: a band without a scale.
        """
        gain, offset = np.array([self.of_band(b) for b in bands]).T[:, :, None, None]
        return np.asarray((gain * numbers + offset).astype(np.float32))


def parse_scale(text: str) -> float:
    """A number, or a fraction such as ``1/10000``.

    Raises:
        SceneError: anything else, or a scale that is not positive or beyond all reason.
    """
    match = re.fullmatch(r"\s*([^/]+?)\s*(?:/\s*([^/]+?)\s*)?", text)
    try:
        value = float(match[1]) / float(match[2] or 1) if match else math.nan
    except (ValueError, ZeroDivisionError):
        value = math.nan
    if not _LEAST_SCALE <= value <= 1 / _LEAST_SCALE:
        raise SceneError(f"--scale: found {text!r}, expected a positive number or a fraction such as 1/10000")
    return value


def read_declared(path: Path, image: Path) -> Declared | None:
    """What a metadata file says of numbers that are reflectance already; None where it says nothing of that.

    DIMAP products of the radiometric processing REFLECTANCE (DN / GAIN + BIAS), Planet's ``reflectanceCoefficient``,
    and STAC items (``raster:bands``, ``bands`` or the asset with scale and offset, whose quantity they do not tell).

    Args:
        path: the metadata file.
        image: the image, whose name finds the asset of a STAC item.

    Raises:
        InputError: unreadable, or numbers that cannot be a scale.
    """
    suffix = path.suffix.lower()
    if suffix == ".json":
        return _stac(path, image)
    if suffix != ".xml":
        return None
    root = parse_xml(path)
    if local_name(root) == "Dimap_Document":
        return _dimap(path, root)
    return _planet(path, root)


def scale_of_image(path: Path) -> Declared | None:
    """Scale and offset of a raster's bands as GDAL stores them, of a quantity that it does not tell."""
    with opened(path) as data:
        gain, offset = tuple(float(g) for g in data.scales), tuple(float(o) for o in data.offsets)
    if set(gain) == {1.0} and set(offset) == {0.0}:
        return None
    return Declared(None, _checked(path, gain), offset, str(path))


def _members(block: Any) -> dict[str, str]:
    return {local_name(e): (e.text or "").strip() for e in block.iter()}


def _dimap(path: Path, root: Any) -> Declared | None:
    processing = [(e.text or "").strip().upper() for e in find_all(root, "RADIOMETRIC_PROCESSING")]
    if processing[:1] != ["REFLECTANCE"]:
        return None
    bands = {row.get("BAND_ID", ""): row for row in map(_members, find_all(root, "Band_Reflectance"))}
    if not bands:
        return None
    places = {
        row.get("BAND_ID", ""): row.get("BAND_INDEX", "") for row in map(_members, find_all(root, "Raster_Index"))
    }
    names = in_order(bands, places)
    gain = _checked(path, [1 / number_of(path, f"GAIN of band {n}", bands[n].get("GAIN", "")) for n in names])
    offset = tuple(number_of(path, f"BIAS of band {n}", bands[n].get("BIAS") or "0", False) for n in names)
    return Declared("toa_reflectance", gain, offset, str(path), tuple(names))


def _planet(path: Path, root: Any) -> Declared | None:
    rows = [_members(block) for block in find_all(root, "bandSpecificMetadata")]
    rows = [row for row in rows if "reflectanceCoefficient" in row]
    if not rows:
        return None
    if all(row.get("bandNumber", "").isdigit() for row in rows):
        rows.sort(key=lambda row: int(row["bandNumber"]))
    gain = [
        number_of(path, f"reflectanceCoefficient of band {k + 1}", row["reflectanceCoefficient"])
        for k, row in enumerate(rows)
    ]
    return Declared("toa_reflectance", _checked(path, gain), (0.0,) * len(gain), str(path), _PLANET.get(len(gain), ()))


def _stac(path: Path, image: Path) -> Declared | None:
    document = read_json(path)
    if document.get("type") != "Feature":
        return None
    _STAC.check(document, str(path))
    assets = document.get("assets") or {}
    named = [a for a in assets.values() if image.name in _names(a.get("href", ""))]
    for asset in named or (list(assets.values()) if len(assets) == 1 else []):
        # what is the same in all bands may stand beside them (STAC 1.1)
        scale, zero = asset.get("raster:scale", 1.0), asset.get("raster:offset", 0.0)
        bands = asset.get("raster:bands") or asset.get("bands") or [{}]
        gain = [float(b.get("scale", b.get("raster:scale", scale))) for b in bands]
        offset = tuple(float(b.get("offset", b.get("raster:offset", zero))) for b in bands)
        if set(gain) != {1.0} or set(offset) != {0.0}:
            return Declared(None, _checked(path, gain), offset, str(path))
    return None


def _names(href: str) -> tuple[str, str]:
    """What the file of an asset may be called: addresses may have a signature behind the name, and blanks as %20."""
    return Path(href).name, Path(unquote(urlsplit(href).path)).name


def _checked(path: Path, gain: list[float] | tuple[float, ...]) -> tuple[float, ...]:
    wrong = [g for g in gain if not (math.isfinite(g) and g > 0)]
    if wrong:
        raise InputError(f"{path}: found a scale of {wrong[0]:g}, expected a positive one")
    return tuple(gain)


__all__ = ["Declared", "parse_scale", "read_declared", "scale_of_image"]
