"""Spectral bands by platform: names, STAC common names, wavelengths."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from sattools.errors import SceneError
from sattools.scene.document import Item
from sattools.scene.jsonio import JsonObject

BANDS_MEMBER = "sattools:fitted_bands"  # of an asset that shows some bands of its item only: as the user named them


@dataclass(frozen=True)
class Band:
    """A spectral band: the vendor's name, STAC's common name, limits of the passband [um]."""

    name: str
    common_name: str
    low_um: float
    high_um: float

    @property
    def centre_um(self) -> float:
        """Middle of the passband [um]."""
        return round((self.low_um + self.high_um) / 2, 4)

    def to_dict(self) -> JsonObject:
        """Entry of STAC `eo:bands` (EO extension 1.1); the width is that of the passband."""
        width = round(self.high_um - self.low_um, 4)
        return {
            "name": self.name,
            "common_name": self.common_name,
            "center_wavelength": self.centre_um,
            "full_width_half_max": width,
        }


_WORLDVIEW = (
    Band("P", "pan", 0.45, 0.80),
    Band("C", "coastal", 0.40, 0.45),
    Band("B", "blue", 0.45, 0.51),
    Band("G", "green", 0.51, 0.58),
    Band("Y", "yellow", 0.585, 0.625),
    Band("R", "red", 0.63, 0.69),
    Band("RE", "rededge", 0.705, 0.745),
    Band("N", "nir08", 0.77, 0.895),
    Band("N2", "nir09", 0.86, 1.04),
)
_PLEIADES = (
    Band("P", "pan", 0.47, 0.83),
    Band("B0", "blue", 0.43, 0.55),
    Band("B1", "green", 0.50, 0.62),
    Band("B2", "red", 0.59, 0.71),
    Band("B3", "nir", 0.74, 0.94),
)
_SPOT = (
    Band("P", "pan", 0.45, 0.745),
    Band("B0", "blue", 0.455, 0.525),
    Band("B1", "green", 0.53, 0.59),
    Band("B2", "red", 0.625, 0.695),
    Band("B3", "nir", 0.76, 0.89),
)
# nominal passbands of the vendors' data sheets
PLATFORM_BANDS: Mapping[str, Sequence[Band]] = {
    "WorldView-2": _WORLDVIEW,
    "WorldView-3": _WORLDVIEW,
    "Pleiades-1A": _PLEIADES,
    "Pleiades-1B": _PLEIADES,
    "SPOT-6": _SPOT,
    "SPOT-7": _SPOT,
}
# of STAC, as far as sensors of optical satellites have them
COMMON_NAMES = ("pan", "coastal", "blue", "green", "yellow", "red", "rededge", "nir", "nir08", "nir09", "cirrus")
WORLDVIEW_BANDS = ("C", "B", "G", "Y", "R", "RE", "N", "N2")  # order of an eight-band product
RGB_OF_EIGHT = [5, 3, 2]  # numbers of the bands among them
WORLDVIEW_FOUR = ("B", "G", "R", "N")  # order of a four-band product


def names_of(platform: str | None, count: int) -> tuple[str, ...]:
    """The vendor's names of an image's bands by their number, where the platform's products have one order only.

    Args:
        platform: as in STAC, or None.
        count: bands of the image.

    Returns:
        ``count`` names, or none.
    """
    if (platform or "").startswith("WorldView"):
        return {1: ("P",), 4: WORLDVIEW_FOUR, 8: WORLDVIEW_BANDS}.get(count, ())
    return ("P",) if platform in PLATFORM_BANDS and count == 1 else ()


def eo_bands(platform: str | None, names: Sequence[str], chosen: Sequence[int]) -> list[JsonObject]:
    """STAC `eo:bands` of the bands taken from an image.

    Args:
        platform: as in STAC, or None.
        names: the vendor's names of all bands of the image; empty if unknown.
        chosen: numbers of the bands taken, from 1.

    Returns:
        One entry a band, with wavelengths where the platform's are known.
    """
    own = PLATFORM_BANDS.get(platform or "", ())
    known = {band.common_name: band for band in own} | {band.name: band for band in own}
    entries: list[JsonObject] = []
    for number in chosen:
        name = names[number - 1] if number <= len(names) else _unnamed(number)
        if (band := known.get(name) or known.get(name.casefold())) is not None:
            entries.append(band.to_dict())
        else:
            common = {"common_name": name.casefold()} if name.casefold() in COMMON_NAMES else {}
            entries.append({"name": name, **common})
    return entries


def named_bands(platform: str | None, descriptions: Sequence[str | None]) -> JsonObject:
    """``{"eo:bands": [...]}`` for the asset of an image whose file names its bands; ``{}`` where it does not.

    Names are STAC's common ones or the vendor's; others (``Band 1``) tell nothing.

    Args:
        platform: as in STAC, or None.
        descriptions: of all bands of the file.
    """
    entries = eo_bands(platform, [str(text or "").strip() for text in descriptions], range(1, len(descriptions) + 1))
    said = {entry.get("common_name") for entry in entries} - {None}
    return {"eo:bands": entries} if entries and len(said) == len(entries) else {}


def red_green_blue(bands: Sequence[JsonObject]) -> list[int] | None:
    """Numbers from 1 of the bands with these common names among `eo:bands`; None where one is missing."""
    words = [band.get("common_name") for band in bands]
    wanted = ("red", "green", "blue")
    return [words.index(word) + 1 for word in wanted] if set(wanted) <= set(words) else None


def chosen_bands(item: Item, wanted: Sequence[str], count: int) -> list[int]:
    """Numbers from 1 of the bands of an item's radiance that are wanted, in that order; all where none is named.

    Args:
        item: its `eo:bands` tell the names, else the order of its platform's products.
        wanted: numbers from 1, names of the vendor (``N``) or common ones of STAC (``nir08``), whatever their case.
        count: bands of the radiance.

    Raises:
        SceneError: a band that the item does not have, or one named twice.
    """
    if not wanted:
        return list(range(1, count + 1))
    asset = item.assets.get("radiance") or item.assets.get("image")
    said = (asset.extra.get("eo:bands") if asset else None) or []
    if len(said) != count:
        platform = item.properties.get("platform")
        said = eo_bands(platform, names_of(platform, count), range(1, count + 1))
    own = item.properties.get("sattools:bands")
    fewer = isinstance(own, int) and own > count and "radiance" in item.assets
    more = f"; `sattools normalise --bands` has taken {count} of its {own}" if fewer else ""
    return numbers_of(wanted, said, item.id, more)


def numbers_of(wanted: Sequence[str], said: Sequence[JsonObject], image: str, more: str = "") -> list[int]:
    """Numbers from 1 of the bands that are wanted, in that order.

    Args:
        wanted: as of `chosen_bands`.
        said: `eo:bands` of all bands of the image, see `eo_bands`.
        image: its id, for messages.
        more: what else to say of a band that is not there.

    Raises:
        SceneError: a band that the image does not have, or one named twice.
    """
    count = len(said)
    numbers = {str(k + 1): k + 1 for k in range(count)}
    for kind in ("common_name", "name"):
        numbers |= {str(band[kind]).casefold(): k + 1 for k, band in enumerate(said) if band.get(kind)}
    known = ", ".join(str(band["name"]) for k, band in enumerate(said) if band["name"] != _unnamed(k + 1))
    names = f" or a name that {image} has ({known})" if known else f": {image} does not name its bands"
    chosen = []
    for word in wanted:
        number = numbers.get(str(word).strip().casefold())
        if number is None:
            several = " (each in a --bands of its own)" if "," in str(word) else ""
            raise SceneError(f"--bands: found {word!r}, expected a number up to {count}{names}{several}{more}")
        chosen.append(number)
    if len(set(chosen)) < len(chosen):
        raise SceneError(f"--bands: found bands {chosen} of {image}, expected each of them once")
    return chosen


def _unnamed(number: int) -> str:
    """The name of a band that has none."""
    return f"band {number}"


__all__ = [
    "BANDS_MEMBER",
    "COMMON_NAMES",
    "PLATFORM_BANDS",
    "RGB_OF_EIGHT",
    "WORLDVIEW_BANDS",
    "WORLDVIEW_FOUR",
    "Band",
    "chosen_bands",
    "eo_bands",
    "named_bands",
    "names_of",
    "numbers_of",
    "red_green_blue",
]
