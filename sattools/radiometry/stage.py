"""The stage `normalise`: digital numbers become linear radiance, and the scene says of what kind."""

from __future__ import annotations

import logging
from pathlib import Path

import numpy as np

from sattools.camera.rpc import RPC
from sattools.errors import SceneError, counted, some_of
from sattools.progress import Progress, silent
from sattools.radiometry.atmosphere import HAZY, hazy
from sattools.radiometry.bands import eo_bands
from sattools.radiometry.blocks import Blocks
from sattools.radiometry.histogram import histogram_figure
from sattools.radiometry.job import Job, images_of, job_of
from sattools.radiometry.options import NormaliseOptions
from sattools.radiometry.saturated import NOTED
from sattools.scene import GEOTIFF_TYPE, Asset, Item, Scene
from sattools.scene.dependencies import MADE, begin, may_begin, record, seen
from sattools.scene.gdal import rpc_tags
from sattools.scene.jsonio import JsonObject
from sattools.scene.opening import opened
from sattools.scene.pixels import image_part
from sattools.scene.sensor_files import write_sensor_blocks

log = logging.getLogger(__name__)
FIGURE = "normalise/histogram.png"
MOST_BRIGHT = 1.0  # percent of reflectances above 1 that nothing is said of: glints, walls that face a low sun
NO_AIR = "--atmosphere takes nothing off: found no value in pixels at even distances, expected some that tell the air"
BLANK = "without data? (--bands takes others; --atmosphere has nothing to go by there)"
LABELS = {
    "toa_reflectance": "reflectance at the top of the atmosphere, pi L / (E cos sun zenith)",
    "reflectance_factor": "reflectance factor, pi L / E",
    "relative": "radiance / full scale",
}


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
    job, notes = job_of(scene, options)
    items = images_of(scene)
    paths = begin(scene, "normalise", _hrefs(items), overwrite)
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
    job_of(scene, options)
    may_begin(scene, "normalise", _hrefs(images_of(scene)), overwrite)


def _hrefs(items: list[Item]) -> list[str]:
    """What will be written."""
    return [FIGURE, *(f"radiance/{item.id}.tif" for item in items)]


def _one(job: Job, item: Item, output: Path, notes: list[str]) -> dict[str, float]:
    options, bits = job.options, job.bits[item.id]
    part = image_part(job.scene, item)
    blocks = Blocks(job, item, part)
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


def _shared(job: Job) -> list[str]:
    """Notes that many images may have, in one line each."""
    notes = [f"{some_of(ids)}: {text}" for text, ids in job.alike.items()]
    for right, found in job.bright.items():
        share = f"{'up to ' if len(found) > 1 else ''}{max(found.values()):.0f} %"
        notes.append(f"{some_of(list(found))}: {share} of the pixels have a reflectance above 1 ({right})")
    if job.flat:
        where = "; ".join(f"{some_of(ids)}: band {bands}" for bands, ids in job.flat.items())
        notes.append(f"{where}: most pixels here or in the first image are one number, no gain is known")
    return notes


def _doubts(job: Job, item: Item, shares: dict[str, float], blocks: Blocks) -> list[str]:
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


__all__ = ["check_start", "normalise"]
