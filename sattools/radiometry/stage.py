"""The stage `normalise`: digital numbers become linear radiance, and the scene says of what kind."""

from __future__ import annotations

import logging
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from sattools.camera.rpc import RPC
from sattools.errors import SceneError
from sattools.progress import Progress, silent
from sattools.radiometry.bands import eo_bands
from sattools.radiometry.histogram import histogram_figure
from sattools.radiometry.kind import ImageScale, choose_quantity, image_scales
from sattools.radiometry.linear import gain_and_offset, invalid_numbers, item_bits, linear_radiance, undo_gamma
from sattools.radiometry.options import NormaliseOptions
from sattools.scene import GEOTIFF_TYPE, Asset, Item, Scene
from sattools.scene.dependencies import MADE, begin, record
from sattools.scene.jsonio import JsonObject
from sattools.scene.pixels import image_part
from sattools.scene.raster import write_image_like, write_sensor_image

log = logging.getLogger(__name__)
FIGURE = "normalise/histogram.png"
RGB_OF_EIGHT = [5, 3, 2]
EIGHT_BAND_PLATFORMS = ("WorldView-2", "WorldView-3", None)  # None: eight bands are WorldView's unless somebody says so
SAMPLE = 20000  # pixels per image and band in the histogram
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
    numbers: list[list[np.ndarray]] = field(default_factory=list)
    radiance: list[list[np.ndarray]] = field(default_factory=list)
    rng: np.random.Generator = field(default_factory=lambda: np.random.default_rng(0))


def normalise(
    scene: Scene, options: NormaliseOptions, progress: Progress = silent, overwrite: bool = True
) -> JsonObject:
    """Write a linear float32 `radiance` asset for every image; NaN where it has no data or is saturated.

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
    items = [item for item in scene.items if "image" in item.assets]
    if not items:
        raise SceneError(f"scene {scene.id}: found no item with an asset 'image', expected images to normalise")
    notes: list[str] = []
    scales = image_scales(scene, items, options)
    quantity = choose_quantity(scene, scales, options, notes)
    job = _Job(scene, options, quantity, scales, _bits(items, options, notes))
    for item in items:
        _check_black(job, item)
    paths = begin(scene, "normalise", [FIGURE, *(f"radiance/{item.id}.tif" for item in items)], overwrite)
    shares = {}
    for k, item in enumerate(items):
        progress(k / len(items), item.id)
        shares[item.id] = _one(job, item, paths[f"radiance/{item.id}.tif"], notes)
    pooled = [[np.concatenate(band) for band in zip(*part, strict=True)] for part in (job.numbers, job.radiance)]
    label = LABELS[job.quantity]
    histogram_figure(pooled[0], pooled[1], ("digital number", label), f"{scene.id}: {len(items)} images", paths[FIGURE])
    scene.products["radiance_histogram"] = FIGURE
    for text in notes:
        log.warning("%s", text)
    progress(1.0, "normalised")
    made = record(scene, "normalise", items)
    return {"notes": notes, "quantity": job.quantity, "images": shares, MADE: made}


def _one(job: _Job, item: Item, output: Path, notes: list[str]) -> dict[str, float]:
    options, bits = job.options, job.bits[item.id]
    part = image_part(job.scene, item)
    path, everything = part.path, part.read()
    chosen = _bands(job.scene, item, everything.shape[0], options)
    bands = everything[[b - 1 for b in chosen]]
    scale = job.scales[item.id]
    saturation = _saturation(job, item)
    empty, full = invalid_numbers(bands, saturation)
    values = np.where(empty, np.nan, bands)
    if options.saturated == "mask":
        values = np.where(full, np.nan, values)
    tone_mapped = bits <= 8 and scale.reflectance is None
    if job.quantity == "relative":
        radiance = linear_radiance(values, bits, options.black)
        if tone_mapped and options.gamma is not None:
            radiance = undo_gamma(radiance, options.gamma)
    else:
        radiance = scale.apply(values - options.black, chosen, job.quantity)
    if options.match:
        radiance = _match(job, radiance)
    bands_of = eo_bands(item.properties.get("platform"), scale.names, chosen)
    names = [str(band["name"]) for band in bands_of]
    if part.referred:
        camera = RPC.from_file(job.scene.path(item.assets["rpc"].href))
        write_sensor_image(output, radiance, camera.to_tags(), nodata=float("nan"), descriptions=names)
    else:
        write_image_like(output, radiance, path, names)
    extra = {"eo:bands": bands_of}
    item.assets["radiance"] = Asset(f"radiance/{item.id}.tif", GEOTIFF_TYPE, ["data"], extra)
    item.properties["sattools:radiance"] = "relative" if options.match else job.quantity
    left = tone_mapped and options.gamma is None
    item.properties["sattools:tone"] = "tone-mapped" if left else "linear"
    if tone_mapped:
        what = "left as they are (give --gamma)" if left else f"linearised by the exponent {options.gamma:g}, a guess"
        notes.append(f"{item.id}: 8-bit numbers: found a tone-mapped image, {what}")
    elif options.gamma is not None:
        notes.append(f"{item.id}: --gamma is for 8-bit images, not applied")
    job.numbers.append(_sample(job, bands))
    job.radiance.append(_sample(job, radiance))
    known = radiance[np.isfinite(radiance)]
    shares = {
        "no_data": float(empty.mean()),
        "saturated": float(full.mean()),
        "below_0": float((known < 0).mean()) if known.size else 0.0,
        "above_1": float((known > 1).mean()) if known.size else 0.0,
    }
    if not known.size:
        raise SceneError(f"{path}: found no valid pixel after masking, expected an image (is --bits {bits} right?)")
    notes += _doubts(job, item, shares, saturation)
    return {name: round(share, 6) for name, share in shares.items()}


def _doubts(job: _Job, item: Item, shares: dict[str, float], saturation: float) -> list[str]:
    """What of the result may not be meant."""
    percent, found = {name: 100 * share for name, share in shares.items()}, []
    if job.scales[item.id].reflectance is not None and percent["above_1"] > 50:
        found.append(f"{percent['above_1']:.0f} % of the pixels have a reflectance above 1 (is the scale right?)")
    if percent["below_0"] > 50 and not job.options.match:
        found.append(f"{percent['below_0']:.0f} % of the pixels are below 0 (are --black and --offset right?)")
    if percent["saturated"] > 5:
        found.append(f"{percent['saturated']:.1f} % of the pixels are saturated at {saturation:g}")
    return [f"{item.id}: {text}" for text in found]


def _saturation(job: _Job, item: Item) -> float:
    """Digital number from which a pixel is saturated; infinity where floating point numbers have no known largest."""
    if job.options.saturation is not None:
        return job.options.saturation
    floating = np.dtype(item.properties.get("sattools:dtype") or "uint16").kind == "f"
    if floating and not (job.options.bits or item.properties.get("sattools:bits")):
        return np.inf
    return job.scales[item.id].saturation(job.bits[item.id])


def _check_black(job: _Job, item: Item) -> None:
    """Raise SceneError for a black level above white, which would turn light into dark."""
    black, bits = job.options.black, job.bits[item.id]
    full = 2.0**bits - 1
    if job.quantity == "relative" and black >= full:
        raise SceneError(
            f"--black: found {black:g}, expected less than {full:g}, white in the {bits} bits of {item.id}"
        )


def _sample(job: _Job, bands: np.ndarray) -> list[np.ndarray]:
    flat = bands.reshape(bands.shape[0], -1)
    where = job.rng.integers(flat.shape[1], size=min(SAMPLE, flat.shape[1]))
    return list(flat[:, where])


def _match(job: _Job, radiance: np.ndarray) -> np.ndarray:
    """The image brought to the first one's middle and spread."""
    low, middle, high = np.nanpercentile(radiance, [16, 50, 84], axis=(1, 2))
    level_and_spread = np.stack([middle, high - low])
    if job.reference is None:
        job.reference = level_and_spread
    gain, offset = gain_and_offset(level_and_spread, job.reference)
    return np.asarray((radiance * gain[:, None, None] + offset[:, None, None]).astype(np.float32))


def _bits(items: list[Item], options: NormaliseOptions, notes: list[str]) -> dict[str, int]:
    """Significant bits per image; images of one sensor share the largest, as a dark scene's values prove nothing."""
    bits_of = {item.id: options.bits or item_bits(item.properties) for item in items}
    groups = {item.id: (item.properties.get("platform"), item.properties.get("sattools:dtype")) for item in items}
    for group in set(groups.values()):
        members = [i for i in bits_of if groups[i] == group]
        highest = max(bits_of[i] for i in members)
        for name in members:
            if bits_of[name] < highest:
                notes.append(f"{name}: values fit {bits_of[name]} bits, taken as {highest} like its sensor's others")
                bits_of[name] = highest
    return bits_of


def _bands(scene: Scene, item: Item, count: int, options: NormaliseOptions) -> list[int]:
    chosen = options.bands
    if not chosen:
        eight = count == 8 and item.properties.get("platform") in EIGHT_BAND_PLATFORMS
        return RGB_OF_EIGHT if eight else list(range(1, count + 1))
    wrong = [b for b in chosen if not 1 <= b <= count]
    if wrong:
        raise SceneError(f"scene {scene.id}: item {item.id} has {count} bands, expected --bands within them: {wrong}")
    return chosen


__all__ = ["normalise"]
