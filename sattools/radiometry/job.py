"""What `normalise` knows of a scene's images before it reads their pixels: quantity, scales, bits, bands."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from sattools.errors import SceneError, counted
from sattools.radiometry.atmosphere import check_air
from sattools.radiometry.bands import RGB_OF_EIGHT, eo_bands, numbers_of, red_green_blue
from sattools.radiometry.kind import ImageScale, choose_quantity, contradictions, image_scales
from sattools.radiometry.linear import full_scale, own_bits, shared_bits, without_bits
from sattools.radiometry.options import NormaliseOptions
from sattools.scene import Item, Scene
from sattools.scene.jsonio import JsonObject
from sattools.scene.pixels import image_part

EIGHT_BAND_PLATFORMS = ("WorldView-2", "WorldView-3", None)  # None: eight bands are WorldView's unless somebody says so


@dataclass
class Job:
    """What is known of the images before the first is written, and what is gathered on the way."""

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

    def saturation(self, item: Item) -> float:
        """Digital number from which a pixel is saturated; infinity where floats have no known largest."""
        if self.options.saturation is not None:
            return self.options.saturation
        if without_bits(item.properties) and not self.options.bits:
            return np.inf
        return self.scales[item.id].saturation(self.bits[item.id])

    def bands(self, item: Item, count: int) -> list[int]:
        """Numbers from 1 of the bands to take from an image of so many."""
        platform = item.properties.get("platform")
        said = eo_bands(platform, self.scales[item.id].names, range(1, count + 1))
        if self.options.bands:
            return numbers_of(self.options.bands, said, item.id)
        if count != 8 or platform not in EIGHT_BAND_PLATFORMS:
            return list(range(1, count + 1))
        return red_green_blue(said) or RGB_OF_EIGHT


def images_of(scene: Scene) -> list[Item]:
    """The items that have an image."""
    return [item for item in scene.items if "image" in item.assets]


def job_of(scene: Scene, options: NormaliseOptions) -> tuple[Job, list[str]]:
    """The job, and notes. Arguments and errors as of `normalise`."""
    items = images_of(scene)
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
    job = Job(scene, options, quantity, scales, bits, alike=darker)
    taken = {}
    for item in items:
        _check_black(job, item)
        taken[item.id] = len(job.bands(item, image_part(scene, item).bands))
        if taken[item.id] != taken[items[0].id]:
            raise SceneError(
                f"{item.id}: found {counted(taken[item.id], 'bands')}, expected {taken[items[0].id]} as of "
                f"{items[0].id} (--bands takes the same of all)"
            )
    return job, notes


def _check_black(job: Job, item: Item) -> None:
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
    """Significant bits per image, and notes -> images that fewer would do for."""
    if options.bits:
        return dict.fromkeys((item.id for item in items), options.bits), {}
    bits_of = {item.id: shared_bits(item, items) for item in items}
    notes: dict[str, list[str]] = {}
    for item in items:
        bits = own_bits(item, items)
        if bits < bits_of[item.id]:
            told = f"values fit {bits} bits, taken as {bits_of[item.id]} like its sensor's others"
            notes.setdefault(told, []).append(item.id)
    return bits_of, notes


__all__ = ["Job", "images_of", "job_of"]
