"""The stage `normalise`: digital numbers become linear radiance, and the scene says of what kind."""

from __future__ import annotations

import logging
import math
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from sattools.camera.rpc import RPC
from sattools.errors import SceneError, counted, some_of
from sattools.progress import Progress, silent
from sattools.radiometry.atmosphere import HAZY, Air, air_of, check_air, hazy
from sattools.radiometry.bands import eo_bands, numbers_of, red_green_blue
from sattools.radiometry.histogram import histogram_figure
from sattools.radiometry.kind import ImageScale, choose_quantity, contradictions, image_scales
from sattools.radiometry.linear import (
    full_scale,
    gain_and_offset,
    invalid_numbers,
    linear_radiance,
    shared_bits,
    undo_gamma,
    without_bits,
)
from sattools.radiometry.options import NormaliseOptions
from sattools.radiometry.saturated import NOTED, Conversion
from sattools.scene import GEOTIFF_TYPE, Asset, Item, Scene
from sattools.scene.dependencies import MADE, begin, may_begin, record, seen
from sattools.scene.gdal import rpc_tags
from sattools.scene.jsonio import JsonObject
from sattools.scene.opening import opened
from sattools.scene.pixels import ImagePart, image_part
from sattools.scene.sensor_files import write_sensor_blocks
from sattools.scene.stored import pieces

log = logging.getLogger(__name__)
FIGURE = "normalise/histogram.png"
RGB_OF_EIGHT = [5, 3, 2]
EIGHT_BAND_PLATFORMS = ("WorldView-2", "WorldView-3", None)  # None: eight bands are WorldView's unless somebody says so
SAMPLE = 20000  # pixels per image and band in the histogram
TOLD = 4_000_000  # pixels that tell an image's middle and spread for --match, and its darkest
MOST_BRIGHT = 1.0  # percent of reflectances above 1 that nothing is said of: glints, walls that face a low sun
NO_AIR = "--atmosphere takes nothing off: found no value in pixels at even distances, expected some that tell the air"
BLANK = "without data? (--bands takes others; --atmosphere has nothing to go by there)"
LABELS = {
    "toa_reflectance": "reflectance at the top of the atmosphere, pi L / (E cos sun zenith)",
    "reflectance_factor": "reflectance factor, pi L / E",
    "relative": "radiance / full scale",
}


@dataclass
class _Job:
    """What is known of the images before the first is written."""

    scene: Scene
    options: NormaliseOptions
    quantity: str
    scales: dict[str, ImageScale]
    bits: dict[str, int]
    reference: np.ndarray | None = None  # [2, C] middle and spread of the first image, for --match
    air: JsonObject = field(default_factory=dict)  # per image, for the history
    flat: dict[str, list[str]] = field(default_factory=dict)  # bands without a gain for --match -> images
    bright: dict[str, dict[str, float]] = field(default_factory=dict)  # what to ask -> images, percent above 1
    alike: dict[str, list[str]] = field(default_factory=dict)  # notes that images may share -> images
    numbers: list[list[np.ndarray]] = field(default_factory=list)
    radiance: list[list[np.ndarray]] = field(default_factory=list)
    rng: np.random.Generator = field(default_factory=lambda: np.random.default_rng(0))


def normalise(
    scene: Scene, options: NormaliseOptions, progress: Progress = silent, overwrite: bool = True
) -> JsonObject:
    """Write a linear float32 `radiance` asset for every image; NaN where it has no data or saturated pixels are masked.

    Sets per item `sattools:radiance` (``toa_reflectance``, ``reflectance_factor`` or ``relative``) and
    `sattools:tone` (``linear``, or ``tone-mapped`` for 8-bit images left as they are). Nothing is clipped.

    Args:
        scene: the scene.
        options: of the stage.
        progress: told the share done and what is being done.
        overwrite: replace outputs that are there.

    Returns:
        Shares of masked pixels per image, and notes, for the history.

    Raises:
        SceneError: no images, bands that are not there, or a calibration asked for that the metadata do not allow.
        InputError: an image or metadata file that cannot be read.
    """
    job, hrefs, notes = _started(scene, options)
    items = _images(scene)
    paths = begin(scene, "normalise", hrefs, overwrite)
    read = seen(scene, "normalise", items)
    shares = {}
    for k, item in enumerate(items):
        progress(k / len(items), item.id)
        shares[item.id] = _one(job, item, paths[f"radiance/{item.id}.tif"], notes)
    pooled = [[np.concatenate(band) for band in zip(*part, strict=True)] for part in (job.numbers, job.radiance)]
    label = LABELS[job.quantity] + (", without the air" if job.air else "")
    label += ", brought to the first image" if options.match else ""
    histogram_figure(
        pooled[0], pooled[1], ("digital number", label), f"{scene.id}: {counted(len(items), 'images')}", paths[FIGURE]
    )
    scene.products["radiance_histogram"] = FIGURE
    notes += _shared(job)
    for text in notes:
        log.warning("%s", text)
    progress(1.0, "normalised")
    made = record(scene, "normalise", items, read)
    quantity = "relative" if options.match else job.quantity
    found: JsonObject = {"notes": notes, "quantity": quantity, "images": shares, MADE: made}
    return found | ({"atmosphere": job.air} if job.air else {})


def check_start(scene: Scene, options: NormaliseOptions, overwrite: bool = True) -> None:
    """What `normalise` looks at before its work, for a dry run; arguments and errors as of it, `scene` is changed."""
    _, hrefs, _ = _started(scene, options)
    may_begin(scene, "normalise", hrefs, overwrite)


def _images(scene: Scene) -> list[Item]:
    return [item for item in scene.items if "image" in item.assets]


def _started(scene: Scene, options: NormaliseOptions) -> tuple[_Job, list[str], list[str]]:
    """What is known before pixels are read: the job, hrefs of what will be written, and notes."""
    items = _images(scene)
    if not items:
        raise SceneError(f"scene {scene.id}: found no item with an asset 'image', expected images to normalise")
    notes = contradictions(scene, items, options)
    scales = image_scales(scene, items, options)
    quantity = choose_quantity(scene, scales, options, notes)
    if options.atmosphere != "none":
        check_air(scene, items, quantity, options)
    if options.match and quantity != "relative":
        notes.append(f"--match: found {quantity}, which the other images are no longer: all are taken as relative")
    bits, darker = _bits(items, options)
    job = _Job(scene, options, quantity, scales, bits, alike=darker)
    for item in items:
        _check_black(job, item)
        _bands(item, image_part(scene, item).bands, options, scales[item.id])
    return job, [FIGURE, *(f"radiance/{item.id}.tif" for item in items)], notes


class _Blocks:
    """An image's pixels as they come out, and what is counted of them on the way."""

    def __init__(self, job: _Job, item: Item, part: ImagePart) -> None:
        self.job, self.item, self.part = job, item, part
        self.chosen = _bands(item, part.bands, job.options, job.scales[item.id])
        self.saturation = _saturation(job, item)
        picture = bool(job.options.bits) or not without_bits(item.properties)
        self.tone_mapped = picture and job.bits[item.id] <= 8 and job.scales[item.id].reflectance is None
        wanted = job.options.saturated
        self.masks = wanted == "mask" or (wanted == "auto" and not self.tone_mapped)
        self._air: Air | None = None
        self._matched: tuple[np.ndarray, np.ndarray] | None = None
        height, width = part.shape
        self._places = np.divmod(job.rng.integers(height * width, size=min(SAMPLE, height * width)), width)
        self.numbers, self.radiance = (np.full((len(self.chosen), len(self._places[0])), np.nan) for _ in range(2))
        self.counts = dict.fromkeys(("pixels", "no_data", "saturated", "known", "below_0", "above_1", "bright"), 0)

    def _values(self, rows: slice, cols: slice) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Digital numbers and radiance ``[C, h, w]``, and where there are no data or too much light ``[h, w]``."""
        bands = self.part.read((rows, cols))[[b - 1 for b in self.chosen]]
        empty, full = invalid_numbers(bands, self.saturation)
        return bands, self._radiance(np.where(empty | full if self.masks else empty, np.nan, bands)), empty, full

    def _radiance(self, values: np.ndarray) -> np.ndarray:
        """Radiance of digital numbers ``[C, h, w]``, but for --match."""
        options, scale = self.job.options, self.job.scales[self.item.id]
        if self.job.quantity != "relative":
            above = scale.apply(values - options.black, self.chosen, self.job.quantity)
            return above if self._air is None else self._air.through(above)
        radiance = linear_radiance(values, self.job.bits[self.item.id], options.black)
        return undo_gamma(radiance, options.gamma) if self.tone_mapped and options.gamma is not None else radiance

    def conversion(self) -> Conversion | None:
        """How saturated pixels would have become radiance, if they are masked and it is linear in their numbers."""
        if not self.masks or not self.counts["saturated"] or (self.tone_mapped and self.job.options.gamma is not None):
            return None
        most = float(self.saturation)
        ends = self._radiance(np.tile([0.0, most], (len(self.chosen), 1, 1))).astype(np.float64)[:, 0]
        gain, offset = (ends[:, 1] - ends[:, 0]) / most, ends[:, 0]
        if self._matched is not None:
            gain, offset = gain * self._matched[0], offset * self._matched[0] + self._matched[1]
        return Conversion(self.chosen, gain.tolist(), offset.tolist())

    def _told(self) -> np.ndarray:
        """Radiance ``[C, N]`` of pixels at even distances, but for --match."""
        height, width = self.part.shape
        step = math.ceil(math.sqrt(height * width / TOLD))
        some = [
            self._values(rows, slice(0, width))[1][:, -rows.start % step :: step, ::step].reshape(len(self.chosen), -1)
            for rows in pieces((height, width * len(self.chosen)))
        ]
        return np.concatenate(some, axis=1)

    def look_through_air(self) -> Air | None:
        """Take the air off from now on, as pixels at even distances tell it; None where none has a value."""
        self._air = air_of(self.item, self._told(), self.job.quantity, self.job.options)
        return self._air

    def blank(self) -> list[str]:
        """Bands, from 1, that are 0 in all pixels of the histogram, of which others show something."""
        none = ~(np.nan_to_num(self.numbers) != 0).any(axis=1)
        return [] if none.all() else [str(band) for band, is_blank in zip(self.chosen, none, strict=True) if is_blank]

    def match(self) -> list[int]:
        """Bring the image to the first one's middle and spread, which pixels at even distances tell.

        Returns:
            Bands, from 1, of which one of the two has no spread, so that no gain is known.
        """
        told = self._told()
        if not np.isfinite(told).any():
            return []  # an image without a valid pixel is refused later on
        low, middle, high = np.nanpercentile(told, [16, 50, 84], axis=1)
        level_and_spread = np.stack([middle, high - low])
        if self.job.reference is None:  # the first one stays as it is
            self.job.reference = level_and_spread
            return []
        self._matched = gain_and_offset(level_and_spread, self.job.reference)
        flat = (level_and_spread[1] <= 0) | (self.job.reference[1] <= 0)
        return [band for band, without in zip(self.chosen, flat, strict=True) if without]

    def block(self, rows: slice, cols: slice) -> np.ndarray:
        """Some pixels ``[C, h, w]`` float32 radiance, which are counted."""
        bands, radiance, empty, full = self._values(rows, cols)
        if self._matched is not None:
            gain, offset = (part[:, None, None] for part in self._matched)
            radiance = (radiance * gain + offset).astype(np.float32)
        row, col = self._places
        own = np.flatnonzero((row >= rows.start) & (row < rows.stop) & (col >= cols.start) & (col < cols.stop))
        here = (slice(None), row[own] - rows.start, col[own] - cols.start)
        self.numbers[:, own], self.radiance[:, own] = bands[here], radiance[here]
        known = np.isfinite(radiance)
        above = radiance > 1
        bright = (above & ~full).sum()  # a glint that is kept says nothing of the scale
        counted = (empty.size, empty.sum(), full.sum(), known.sum(), (radiance < 0).sum(), above.sum(), bright)
        for name, count in zip(self.counts, counted, strict=True):
            self.counts[name] += int(count)
        return radiance

    def shares(self) -> dict[str, float]:
        """Of the pixels without data, of saturated ones, and of what is known below 0 and above 1."""
        pixels, known = self.counts["pixels"], max(self.counts["known"], 1)
        shares = {name: self.counts[name] / pixels for name in ("no_data", "saturated")}
        return shares | {name: self.counts[name] / known for name in ("below_0", "above_1")}


def _one(job: _Job, item: Item, output: Path, notes: list[str]) -> dict[str, float]:
    options, bits = job.options, job.bits[item.id]
    part = image_part(job.scene, item)
    blocks = _Blocks(job, item, part)
    item.properties.pop("sattools:atmosphere", None)
    if options.atmosphere != "none":
        air = blocks.look_through_air()
        if air is not None:
            job.air[item.id] = item.properties["sattools:atmosphere"] = air.to_dict()
        else:
            job.alike.setdefault(NO_AIR, []).append(item.id)
    if options.match and (flat := blocks.match()):
        job.flat.setdefault(", ".join(map(str, flat)), []).append(item.id)
    if not options.bands and len(blocks.chosen) < part.bands:
        taken = ", ".join(map(str, blocks.chosen))
        job.alike.setdefault(
            f"bands {taken} of {part.bands} are taken, red, green and blue (others: --bands)", []
        ).append(item.id)
    bands_of = eo_bands(item.properties.get("platform"), job.scales[item.id].names, blocks.chosen)
    if part.referred:
        rpc = RPC.from_file(job.scene.path(item.assets["rpc"].href)).to_tags()
    else:
        with opened(part.path) as source:
            rpc = rpc_tags(source)
    names = [str(band["name"]) for band in bands_of]
    write_sensor_blocks(output, part.shape, len(names), blocks.block, rpc, descriptions=names, source_block=part.block)
    conversion = blocks.conversion()
    noted = {NOTED: conversion.to_dict()} if conversion else {}
    item.assets["radiance"] = Asset(f"radiance/{item.id}.tif", GEOTIFF_TYPE, ["data"], {"eo:bands": bands_of, **noted})
    item.properties["sattools:radiance"] = "relative" if options.match else job.quantity
    left = blocks.tone_mapped and options.gamma is None
    item.properties["sattools:tone"] = "tone-mapped" if left else "linear"
    if blocks.tone_mapped:
        what = "left as they are (give --gamma)" if left else f"linearised by the exponent {options.gamma:g}, a guess"
        job.alike.setdefault(f"8-bit numbers: found a tone-mapped image, {what}", []).append(item.id)
    elif options.gamma is not None:
        job.alike.setdefault("--gamma is for 8-bit images, not applied", []).append(item.id)
    if job.quantity != "relative" and options.atmosphere == "none" and hazy(blocks.radiance):
        job.alike.setdefault(HAZY, []).append(item.id)
    if blank := blocks.blank():
        job.alike.setdefault(f"band {', '.join(blank)} is 0 throughout: {BLANK}", []).append(item.id)
    job.numbers.append(list(blocks.numbers))
    job.radiance.append(list(blocks.radiance))
    if not blocks.counts["known"]:
        raise SceneError(
            f"{part.path}: found no valid pixel after masking, expected an image (is --bits {bits} right?)"
        )
    shares = blocks.shares()
    notes += _doubts(job, item, shares, blocks)
    return {name: round(share, 6) for name, share in shares.items()}


def _shared(job: _Job) -> list[str]:
    """Notes that many images may have, in one line each."""
    notes = [f"{some_of(ids)}: {text}" for text, ids in job.alike.items()]
    for right, found in job.bright.items():
        share = f"{'up to ' if len(found) > 1 else ''}{max(found.values()):.0f} %"
        notes.append(f"{some_of(list(found))}: {share} of the pixels have a reflectance above 1 ({right})")
    if job.flat:
        where = "; ".join(f"{some_of(ids)}: band {bands}" for bands, ids in job.flat.items())
        notes.append(f"{where}: most pixels here or in the first image are one number, no gain is known")
    return notes


def _doubts(job: _Job, item: Item, shares: dict[str, float], blocks: _Blocks) -> list[str]:
    """What of the result may not be meant."""
    saturation, what = blocks.saturation, "masked: no radiance there" if blocks.masks else "kept"
    percent, found = {name: 100 * share for name, share in shares.items()}, []
    bright = 100 * blocks.counts["bright"] / max(blocks.counts["known"], 1)
    if job.quantity != "relative" and not job.options.match and bright > MOST_BRIGHT:
        declared = job.scales[item.id].declared is not None
        right = "is the scale right?" if declared else "are gains and offsets of the metadata right?"
        right += "" if bright > 50 else " Clouds, snow and walls in a low sun may have that"
        job.bright.setdefault(right, {})[item.id] = bright
    if percent["below_0"] > 50 and not job.options.match:
        found.append(f"{percent['below_0']:.0f} % of the pixels are below 0 (are --black and --offset right?)")
    if percent["saturated"] > 5:
        found.append(f"{percent['saturated']:.1f} % of the pixels are saturated at {saturation:g} and {what}")
    return [f"{item.id}: {text}" for text in found]


def _saturation(job: _Job, item: Item) -> float:
    """Digital number from which a pixel is saturated; infinity where floating point numbers have no known largest."""
    if job.options.saturation is not None:
        return job.options.saturation
    if without_bits(item.properties) and not job.options.bits:
        return np.inf
    return job.scales[item.id].saturation(job.bits[item.id])


def _check_black(job: _Job, item: Item) -> None:
    """Raise SceneError for a black level above white, which would turn light into dark."""
    black, bits = job.options.black, job.bits[item.id]
    full = full_scale(bits)
    if job.quantity == "relative" and black >= full:
        raise SceneError(
            f"--black: found {black:g}, expected less than {full:g}, white in the {bits} bits of {item.id}"
        )
    saturation = job.options.saturation
    if saturation is not None and saturation <= black:
        raise SceneError(f"--saturation: found {saturation:g}, expected more than {black:g}, the number of no light")


def _bits(items: list[Item], options: NormaliseOptions) -> tuple[dict[str, int], dict[str, list[str]]]:
    """Significant bits per image, and notes -> images that fewer would do for.

    Images of one sensor share the largest, as a dark scene's values prove nothing.
    """
    bits_of = {item.id: options.bits or shared_bits(item, items) for item in items}
    notes: dict[str, list[str]] = {}
    groups = {item.id: (item.properties.get("platform"), item.properties.get("sattools:dtype")) for item in items}
    for group in set(groups.values()):
        members = [i for i in bits_of if groups[i] == group]
        highest = max(bits_of[i] for i in members)
        for name in members:
            if bits_of[name] < highest:
                told = f"values fit {bits_of[name]} bits, taken as {highest} like its sensor's others"
                notes.setdefault(told, []).append(name)
                bits_of[name] = highest
    return bits_of, notes


def _bands(item: Item, count: int, options: NormaliseOptions, scale: ImageScale) -> list[int]:
    """Numbers from 1 of the bands to take from an image of so many; its scale tells their names."""
    chosen = options.bands
    if not chosen:
        eight = count == 8 and item.properties.get("platform") in EIGHT_BAND_PLATFORMS
        named = red_green_blue(item.assets["image"].extra.get("eo:bands") or [])
        return (named or RGB_OF_EIGHT) if eight else list(range(1, count + 1))
    return numbers_of(chosen, eo_bands(item.properties.get("platform"), scale.names, range(1, count + 1)), item.id)


__all__ = ["RGB_OF_EIGHT", "check_start", "normalise"]
