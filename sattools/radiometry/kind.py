"""What an image's numbers are and become: declared by the user, by metadata, or calibrated by a vendor's factors."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from sattools.errors import InputError, SceneError, counted
from sattools.radiometry.bands import names_of
from sattools.radiometry.calibration import (
    BandCalibration,
    earth_sun_distance,
    processing_of,
    read_calibration,
    reflectance,
    with_irradiance,
)
from sattools.radiometry.declared import Declared, parse_scale, read_declared, scale_of_image
from sattools.radiometry.linear import eight_bits, full_scale, item_bits
from sattools.radiometry.options import NormaliseOptions
from sattools.scene import Item, Scene
from sattools.scene.members import instant
from sattools.scene.sidecars import sidecars

REFLECTANCES = ("toa_reflectance", "reflectance_factor")
_ALREADY = " (numbers that are it already need --scale, 1 or 1/10000, say)"


@dataclass(frozen=True)
class ImageScale:
    """What is known of an image's numbers.

    Attributes:
        item: the image.
        declared: its numbers are a quantity already; or None.
        calibration: radiance per number, band by band; or empty.
        foreign: why the calibration is not of the image's numbers; None where it is.
    """

    item: Item
    declared: Declared | None
    calibration: tuple[BandCalibration, ...]
    foreign: str | None = None

    @property
    def names(self) -> tuple[str, ...]:
        """The vendor's names of all bands of the image, else its file's own; empty if unknown."""
        count = int(self.item.properties.get("sattools:bands") or 0)
        stated = self.declared.names if self.declared else ()
        written = tuple(str(band["name"]) for band in self.item.assets["image"].extra.get("eo:bands") or [])
        ordered = names_of(self.item.properties.get("platform"), count)
        found = (stated, tuple(b.name for b in self.calibration), written, ordered)
        return next((names for names in found if names and count in (0, len(names))), ())

    @property
    def misfit(self) -> str | None:
        """Why the declared scales cannot be those of the image's bands; None where they can, as one for all can."""
        count, stated = self.item.properties.get("sattools:bands"), len(self.declared.gain) if self.declared else 1
        if count is None or self.declared is None or stated in (1, count):
            return None
        return f"{Path(self.declared.source).name} states the scales of {stated} bands, the image has {count}"

    @property
    def reflectance(self) -> str | None:
        """Which reflectance the numbers are already, but for a scale; None where they are none."""
        stated = self.declared.quantity if self.declared and not self.misfit else None
        return stated if stated in REFLECTANCES else None

    def saturation(self, bits: int) -> float:
        """Digital number from which a pixel is saturated: full scale, or the largest of the file for reflectance."""
        if self.reflectance is None:
            return full_scale(bits)
        if self.declared is not None and self.declared.full is not None:
            return self.declared.full
        kind = str(self.item.properties.get("sattools:dtype") or "uint16")
        return float(np.iinfo(kind).max) if np.dtype(kind).kind in "iu" else np.inf

    def apply(self, numbers: np.ndarray, bands: Sequence[int], quantity: str) -> np.ndarray:
        """The quantity ``[C, H, W]``, float32, nothing clipped.

        Args:
            numbers: ``[C, H, W]`` digital numbers less the black level.
            bands: which they are, counted from 1.
            quantity: ``toa_reflectance`` or ``reflectance_factor``.
        """
        if self.declared is not None and self.reflectance is not None:
            return self.declared.apply(numbers, list(bands))
        distance = earth_sun_distance(instant(self.item.properties["datetime"]))
        elevation = self.item.sun[1] if quantity == "toa_reflectance" and self.item.sun else None
        return reflectance(numbers, [self.calibration[b - 1] for b in bands], distance, elevation)

    def lacks(self, sun: bool) -> str | None:
        """Why the vendor's factors do not give a reflectance; None where they do.

        Args:
            sun: the sun's elevation is needed.
        """
        properties, bands = self.item.properties, self.calibration
        count = properties.get("sattools:bands")
        if self.misfit:
            return self.misfit
        if self.declared is not None and self.declared.quantity is None:
            return f"{self.declared.source} states a scale but not of what (expected --quantity)"
        if self.foreign is not None:
            return self.foreign
        if eight_bits(properties) and self.declared is None:
            return "it has 8-bit, tone-mapped numbers"
        if bands and self.declared is not None and any(b.irradiance is None for b in bands):
            platform = properties.get("platform") or "unknown"
            return f"neither metadata nor the platform ({platform}) tell the sun's irradiance in its bands"
        if not bands or any(b.irradiance is None for b in bands):
            return "no metadata with a calibration and a solar irradiance were found"
        if count is not None and len(bands) != count:
            return f"the calibration has {counted(len(bands), 'bands')}, the image {count}"
        if not properties.get("datetime"):
            return "its time is unknown"
        if sun and (self.item.sun is None or self.item.sun[1] <= 0):
            return "its sun is unknown or below the horizon"
        return None


def image_scales(scene: Scene, items: Sequence[Item], options: NormaliseOptions) -> dict[str, ImageScale]:
    """What is known of every image's numbers, by id.

    Raises:
        SceneError: no such folder of metadata, or a scale without its quantity.
        InputError: an image or metadata file that cannot be read.
    """
    declared = declared_by_user(options)
    return {item.id: _of_image(scene, item, options, declared) for item in items}


def contradictions(scene: Scene, items: Sequence[Item], options: NormaliseOptions) -> list[str]:
    """Notes where the user's scale and offset are not those that the images' own files state: theirs are not applied.

    Args:
        scene: of the items.
        items: the images.
        options: of the stage.

    Raises:
        SceneError: as `image_scales`.
    """
    declared = declared_by_user(options)
    if declared is None:
        return []
    found: dict[str, str] = {}
    for item in items:
        stated = None
        with suppress(InputError):  # a broken one may be why the user gives another
            stated = _stated(*_files(scene, item, options))
        if stated is not None and not _same(stated, declared):
            gain, offset = stated.of_band(1)
            found[item.id] = f"{Path(stated.source).name} states scale {gain:g} and offset {offset:g}"
    if not found:
        return []
    name, text = next(iter(found.items()))
    more = f" (and {len(found) - 1} more)" if len(found) > 1 else ""
    scale, offset = declared.of_band(1)
    return [f"{name}{more}: {text}, which --scale {scale:g} and --offset {offset:g} replace"]


def _same(stated: Declared, by_user: Declared) -> bool:
    """Whether all bands have the user's scale and offset, of which there is one."""
    (scale,), (offset,) = by_user.gain, by_user.offset
    pairs = [(gain, scale) for gain in stated.gain] + [(own, offset) for own in stated.offset]
    return all(math.isclose(a, b, rel_tol=1e-6, abs_tol=1e-12) for a, b in pairs)


def _stated(copy: Path, original: Path, files: Sequence[Path]) -> Declared | None:
    """What metadata or the image itself say of the numbers."""
    return next(filter(None, (read_declared(path, original) for path in files)), None) or scale_of_image(copy)


def _files(scene: Scene, item: Item, options: NormaliseOptions) -> tuple[Path, Path, list[Path]]:
    """The image, the original that it was made of, and the metadata files that may speak of it."""
    copy = scene.path(item.assets["image"].href)
    original = Path(item.properties.get("sattools:source") or copy)
    folders = [Path(options.metadata)] if options.metadata else []
    if options.metadata and not folders[0].is_dir():
        raise SceneError(f"{options.metadata}: found no folder, expected one with vendor metadata")
    if original.parent.is_dir():
        folders.append(original.parent)
    return copy, original, sidecars(original, folders)


def choose_quantity(scene: Scene, scales: dict[str, ImageScale], options: NormaliseOptions, notes: list[str]) -> str:
    """The quantity asked for, or the best that all images allow.

    Args:
        scene: for its name in messages.
        scales: of all images.
        options: of the stage.
        notes: told why it is not a reflectance.

    Raises:
        SceneError: a quantity that an image does not allow.
    """
    wanted = options.quantity
    if wanted == "relative":
        return wanted
    stated = {scale.reflectance for scale in scales.values()}
    if len(stated) == 1 and (only := stated.pop()) is not None:
        if wanted not in ("auto", only):
            raise SceneError(f"scene {scene.id}: {wanted} was asked for, but the images are {only}")
        return only
    for quantity in REFLECTANCES:
        if wanted not in ("auto", "radiance", quantity):
            continue
        reasons = {name: _reason(scale, quantity) for name, scale in scales.items()}
        missing = {name: reason for name, reason in reasons.items() if reason}
        if not missing:
            return quantity
        if wanted == quantity or (wanted == "radiance" and quantity == REFLECTANCES[-1]):
            name, reason = next(iter(missing.items()))
            hint = "" if scales[name].calibration or scales[name].declared else _ALREADY
            raise SceneError(f"scene {scene.id}: {wanted} was asked for, but of {name} {reason}{hint}")
    commonest = Counter(r for r in reasons.values() if r).most_common(1)[0][0]
    notes.append(f"linear up to an unknown factor: {commonest}")
    return "relative"


def _reason(scale: ImageScale, quantity: str) -> str | None:
    """Why an image cannot become that quantity."""
    if scale.reflectance is not None:
        return None if scale.reflectance == quantity else f"the numbers are {scale.reflectance}"
    return scale.lacks(quantity == "toa_reflectance")


def declared_by_user(options: NormaliseOptions) -> Declared | None:
    """What the options say of the numbers, None where nothing; SceneError where they make no sense together."""
    if options.scale is None:
        if options.offset:
            raise SceneError("--offset: found it without --scale, expected both")
        return None
    scale = parse_scale(options.scale)
    if options.quantity in ("auto", "relative"):
        raise SceneError(
            f"--scale: found --quantity {options.quantity}, expected toa_reflectance, reflectance_factor or radiance"
        )
    return Declared(options.quantity, (scale,), (options.offset,), "--scale")


def _of_image(scene: Scene, item: Item, options: NormaliseOptions, declared: Declared | None) -> ImageScale:
    copy, original, files = _files(scene, item, options)
    bands, foreign = _calibration(files, item)
    if declared is None:
        declared = _stated(copy, original, files) or _simulated(item)
        if declared is not None and declared.quantity is None:
            asked = options.quantity if options.quantity in (*REFLECTANCES, "radiance") else None
            declared = None if bands and not foreign else replace(declared, quantity=asked)
    scale = ImageScale(item, declared, tuple(bands), foreign)
    if declared is not None and declared.quantity == "radiance" and not scale.misfit:
        return ImageScale(item, declared, tuple(_radiance_bands(declared, item, bands)))
    return scale


def _simulated(item: Item) -> Declared | None:
    """A simulated image of natural ground: its numbers are a reflectance, which is 1 at their full scale."""
    about = item.properties.get("sattools:simulated")
    quantity = about.get("quantity") if isinstance(about, dict) else None
    if quantity not in REFLECTANCES:
        return None
    full = full_scale(item_bits(item.properties))
    return Declared(quantity, (1 / full,), (0.0,), "simulate", full=full)


def _radiance_bands(declared: Declared, item: Item, bands: list[BandCalibration]) -> list[BandCalibration]:
    """Declared radiance as a calibration: irradiance from the metadata, or from the platform's table."""
    count = int(item.properties.get("sattools:bands") or 1)
    names = [b.name for b in bands] or list(names_of(item.properties.get("platform"), count))
    rows = [
        BandCalibration(names[k] if k < len(names) else f"band {k + 1}", *declared.of_band(k + 1)) for k in range(count)
    ]
    stated = {b.name: b.irradiance for b in bands}
    rows = [replace(row, irradiance=stated.get(row.name)) for row in rows]
    return with_irradiance(rows, item.properties.get("platform"))


def _calibration(files: Sequence[Path], item: Item) -> tuple[list[BandCalibration], str | None]:
    """Calibration per band of the image by the first metadata file that has one, and why it is not of its numbers."""
    for path in files:
        bands = with_irradiance(read_calibration(path), item.properties.get("platform"))
        if bands:
            processing = processing_of(path)
            foreign = f"{path.name} says that its numbers are {processing}, which are not those of its calibration"
            return bands, foreign if processing else None
    return [], None


__all__ = ["REFLECTANCES", "ImageScale", "choose_quantity", "contradictions", "declared_by_user", "image_scales"]
