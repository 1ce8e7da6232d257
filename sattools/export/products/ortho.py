"""True orthophotos: every point of the surface as the image shows it that sees it best.

Points that stand behind others in one image are taken from the images that see them, points in shadow from those in
whose sun they lie. All images are brought to the albedo's colours first, and pass into each other over some pixels, so
that no seam is left.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from sattools.export.datum import to_datum
from sattools.export.products.maps import Maps
from sattools.export.products.seen import Camera, Patch, Shown, cameras_of, make_patch, pixel_size, reach_of, shown_at
from sattools.fit.model import FittedModel
from sattools.progress import Progress
from sattools.scene import Grid, Scene
from sattools.scene.cog import CogWriter
from sattools.scene.opening import opened

PIXELS = 1024  # along a block of the orthophoto
_FINEST = 16  # points along the edge of a cell
_FEATHER = 4.0  # pixels, from the edge of what an image sees or of its shadows, over which it gains its full weight
_SHADE = 0.05  # weight of a point in shadow over one in the sun
_OBLIQUE = 8.0  # by how much squared tangents of the incidence angle count against an image
_SHARP = 6.0  # exponent of the weights: the best image has nearly all
_SHADED = 1.0  # the same where every image has shadow: lifted noise wants a mean of many
_SUNNY = (0.03, 0.3)  # weights of the best image at which a point counts as in shadow, and as in the sun
_SMOOTH = 1.0  # pixels: by how much weights are smoothed, lest single pixels be from other images
_SURE = 0.98  # visible, lit
_SAMPLES, _FEWEST = 40_000, 300  # points that a balance is made from
_SAMPLE_BLOCKS = 9
_BRIGHT = 99.5  # per cent of the samples that are no brighter than the brightest ground
_DARKEST = 0.05  # light in shadow over that in the sun
_DARK_GROUND = 0.02  # albedo
_DARKEST_PIXELS = 0.05  # per cent of an image that is nearly without light
_HAZY = 0.8  # haze over these
_HAZIEST = 0.5  # haze over what shadows show


@dataclass(frozen=True)
class Balance:
    """How an image's radiance follows from the albedo: ``radiance = gain * albedo + offset`` per band ``[C]``.

    Attributes:
        gain, offset: in the sun.
        shade: light in shadow over that in the sun; NaN where nothing tells.
        brightest: albedo of the scene's brightest ground.
        haze: part of the albedo that is the air's and is in shadows as well: the fit takes its first image as it is.
    """

    gain: np.ndarray
    offset: np.ndarray
    shade: np.ndarray
    brightest: np.ndarray
    haze: np.ndarray

    def albedo(self, shown: Shown) -> np.ndarray:
        """The image's own albedo ``[C, h, w]``, shadows lifted.

        What would be brighter than anything in the scene lies in the sun, whatever the surface says of its shadows.
        """
        # a panchromatic image has the colours of the multispectral one of the same moment
        lifted = self._grey(shown)
        return lifted if shown.ratio is None else lifted.mean(axis=0) * shown.ratio

    def _grey(self, shown: Shown) -> np.ndarray:
        at = (slice(None), None, None)
        bright = (shown.value - self.offset[at]) / self.gain[at]
        light = shown.lit + (1 - shown.lit) * self.shade[at]
        lifted = (bright - self.haze[at]) / light + self.haze[at]
        # darker than the darkest that the balance knew: nothing is less than black
        return np.maximum(np.where((lifted <= self.brightest[at]).all(axis=0), lifted, bright), 0.0)


def _colour_names(job: _Job) -> list[str]:
    """Of the multispectral images' bands, as their files say; three that say nothing are taken for a picture's."""
    said = job.cameras[0].item.assets["colours"].extra.get("eo:bands") or []
    if len(said) == job.colours:
        return [str(band.get("common_name", band["name"])) for band in said]
    return ["red", "green", "blue"] if job.colours == 3 else [str(k + 1) for k in range(job.colours)]


def write_ortho(
    scene: Scene, model: FittedModel, maps: Maps, files: tuple[Path, Path], vertical: str, progress: Progress
) -> dict[str, float]:
    """Write the orthophoto and the map of the images that it is from; the shares of the surface that it shows.

    Args:
        scene: with the images.
        model: of the fit.
        maps: DSM and albedo.
        files: orthophoto and map of sources.
        vertical: datum of the DSM.
        progress: told the share done.
    """
    job = _Job.of(scene, model, maps, vertical)
    balances = job.balances()
    with opened(maps.paths["albedo"]) as data:
        bands = [str(text or "").replace("albedo", "colour") for text in data.descriptions]
        kept = {k: v for k, v in data.tags().items() if k in ("SCALE", "WAVELENGTHS_UM")}
    if job.colours:
        bands = [f"colour {name}" for name in _colour_names(job)]
        kept.pop("WAVELENGTHS_UM", None)  # of the panchromatic albedo
    names = {f"IMAGE_{k + 1}": camera.item.id for k, camera in enumerate(job.cameras)}
    grid = maps.grid
    grid = Grid(grid.crs, grid.left, grid.top, job.size, grid.width * job.fine, grid.height * job.fine)
    about = {**kept, **names, "SOFTWARE": "sattools"}
    number = "uint8" if len(job.cameras) < 255 else "uint16"
    surface = filled = 0
    with ExitStack() as stack:
        photo = stack.enter_context(
            CogWriter(files[0], grid, bands=len(bands), descriptions=bands, units="1", tags=about)
        )
        meaning = {"MEANING": "number of the image that shows most of a point, see IMAGE_n; 0 = none"}
        meaning |= {**names, "SOFTWARE": "sattools"}  # numbers of images have neither scale nor wavelength
        sources = stack.enter_context(
            CogWriter(files[1], grid, dtype=number, nodata=0, descriptions=["image"], tags=meaning)
        )
        blocks = list(maps.blocks(max(64, PIXELS // job.fine)))
        for k, (rows, cols) in enumerate(blocks):
            progress(k / len(blocks), "orthophoto")
            patch = job.patch(rows, cols, job.fine)
            colours, source = mosaic(patch, job.cameras, balances)
            down, across = (slice(part.start * job.fine, part.stop * job.fine) for part in (rows, cols))
            photo.write(colours, down, across)
            sources.write(source, down, across)
            surface += int(np.isfinite(patch.height).sum())
            filled += int((source > 0).sum())
    return {"shown": round(filled / max(surface, 1), 4), "pixel_m": job.size}


def mosaic(patch: Patch, cameras: Sequence[Camera], balances: Sequence[Balance]) -> tuple[np.ndarray, np.ndarray]:
    """Colours ``[C, h, w]`` (albedo; NaN where no image sees the surface) and the number of the source, from 1.

    Args:
        patch: of the surface.
        cameras: of the images.
        balances: of the images.
    """
    bands = (cameras[0].colours.part.bands if cameras[0].colours else 0) or len(balances[0].gain)
    # means where an image shows the sun, and where none does
    means = {power: np.zeros((bands + 1, *patch.height.shape)) for power in (_SHARP, _SHADED)}
    best, source = np.zeros(patch.height.shape), np.zeros(patch.height.shape, np.uint16)
    for k, (camera, balance) in enumerate(zip(cameras, balances, strict=True)):
        shown = shown_at(camera, patch)
        if shown is None:
            continue
        weight, albedo = _weight_of(camera, shown), balance.albedo(shown)
        for power, sums in means.items():
            share = weight**power
            sums[:-1] += share * albedo
            sums[-1] += share
        source[weight > best] = k + 1
        best = np.maximum(best, weight)
    sunny = np.interp(best, _SUNNY, (0.0, 1.0))
    sharp, shaded = (means[power][:-1] / np.maximum(means[power][-1], 1e-300) for power in (_SHARP, _SHADED))
    return np.where(source > 0, shaded + sunny * (sharp - shaded), np.nan).astype(np.float32), source


def _weight_of(camera: Camera, shown: Shown) -> np.ndarray:
    """How good an image is at every point ``[h, w]``, in [0, 1]; 0 where it does not see it."""
    import cv2

    seen = shown.visible >= 0.5
    inner = _ramp(shown.visible >= _SURE)
    sunny = _SHADE + (1 - _SHADE) * _ramp(shown.lit >= _SURE)
    upright = 1.0 / (1.0 + _OBLIQUE * (camera.slope.east**2 + camera.slope.north**2))
    weight = np.where(seen, upright * np.maximum(inner, 0.02) * sunny, 0.0)
    # of what the image sees alone: its edges are sharp
    around = cv2.GaussianBlur(weight, (0, 0), _SMOOTH), cv2.GaussianBlur(seen.astype(np.float32), (0, 0), _SMOOTH)
    return np.asarray(np.where(seen, around[0] / np.maximum(around[1], 1e-6), 0.0))


def _ramp(mask: np.ndarray) -> np.ndarray:
    """0 outside of a mask, rising inside to 1 with the distance from its edge."""
    import cv2

    if mask.all():
        return np.ones(mask.shape, np.float32)
    distance = cv2.distanceTransform(mask.astype(np.uint8), cv2.DIST_L2, 3)
    return np.asarray(np.clip(distance / _FEATHER, 0.0, 1.0))


@dataclass(frozen=True)
class _Job:
    """An orthophoto that is made.

    Attributes:
        maps: DSM and albedo.
        cameras: of the images.
        vertical: datum of the DSM.
        reach: cells that are read around a block.
        fine: points along a cell.
    """

    maps: Maps
    cameras: list[Camera]
    vertical: str
    reach: int
    fine: int

    @classmethod
    def of(cls, scene: Scene, model: FittedModel, maps: Maps, vertical: str) -> _Job:
        """See `write_ortho`."""
        low, high = _range(maps)
        cell = maps.grid.cell_size
        cameras = cameras_of(scene, model, (low, high))
        coloured = [camera for camera in cameras if camera.colours is not None]
        if coloured:  # colours of some images and grey of others would make patches
            cameras = coloured
        fine = round(cell / pixel_size(cameras, maps.grid, low))
        return cls(maps, cameras, vertical, reach_of(cameras, high - low, cell), min(max(1, fine), _FINEST))

    @property
    def colours(self) -> int:
        """Bands of the multispectral images; 0 without any."""
        own = self.cameras[0].colours
        return own.part.bands if own else 0

    @property
    def size(self) -> float:
        """Edge of a pixel of the orthophoto [m]."""
        return self.maps.grid.cell_size / self.fine

    def patch(self, rows: slice, cols: slice, fine: int) -> Patch:
        """A block of the surface with what may hide or shade it, in ellipsoidal heights."""
        wide = [
            slice(max(0, part.start - self.reach), min(size, part.stop + self.reach))
            for part, size in zip((rows, cols), self.maps.grid.shape)
        ]
        grid = self.maps.grid.part(*wide)
        height = self.maps.read("dsm", *wide)[0]
        if self.vertical != "ellipsoid":
            height = height - to_datum(np.zeros(grid.shape, np.float32), grid, self.vertical)[0]
        own = [slice(part.start - around.start, part.stop - around.start) for part, around in zip((rows, cols), wide)]
        return make_patch(height, grid, (own[0], own[1]), fine)

    def balances(self) -> list[Balance]:
        """Of all images, from blocks all over the scene."""
        blocks = list(self.maps.blocks(max(64, PIXELS // self.fine)))
        some = [blocks[k] for k in np.unique(np.linspace(0, len(blocks) - 1, _SAMPLE_BLOCKS).round().astype(int))]
        found: list[list[np.ndarray]] = [[] for _ in self.cameras]
        for rows, cols in some:
            patch = self.patch(rows, cols, 1)
            albedo = self.maps.read("albedo", rows, cols)
            for camera, samples in zip(self.cameras, found, strict=True):
                samples.extend(_samples(camera, patch, albedo, _SAMPLES // len(some)))
        bands = len(self.maps.read("albedo", slice(0, 1), slice(0, 1)))
        empty = np.zeros((2 * bands + 1, 0))
        points = [np.concatenate([empty, *samples], axis=1) for samples in found]
        return with_usual_shadows(without_haze([balance_of(samples, bands) for samples in points], points))


def _samples(camera: Camera, patch: Patch, albedo: np.ndarray, most: int) -> Iterator[np.ndarray]:
    """Points that are surely seen: rows are the radiances, the albedos, and 1 in the sun or 0 in shadow."""
    shown = shown_at(camera, patch)
    if shown is None:
        return
    sure = (_ramp(shown.visible >= _SURE) > 0.3) & np.isfinite(albedo).all(axis=0)
    for lit, where in ((1.0, _ramp(shown.lit >= _SURE) > 0.5), (0.0, _ramp(shown.lit <= 1 - _SURE) > 0.5)):
        points = np.flatnonzero(sure & where)
        points = points[:: max(1, len(points) // most)]
        values, colours = (layers.reshape(len(layers), -1)[:, points] for layers in (shown.value, albedo))
        yield np.concatenate([values, colours, np.full((1, len(points)), lit)])


def balance_of(samples: np.ndarray, bands: int) -> Balance:
    """An image's balance from its samples; without any, it counts as albedo itself.

    Args:
        samples: ``[2 C + 1, N]``, see `_samples`: radiance, albedo, 1 = in the sun.
        bands: their number C.
    """
    albedo, sunny = samples[bands : 2 * bands], samples[-1] > 0.5
    darkest = np.percentile(samples[:bands], _DARKEST_PIXELS, axis=1) if samples.size else np.zeros(bands)
    gain, offset = _lines(samples[:, sunny], bands, darkest)
    unknown = ~np.isfinite(gain) | (gain <= 0)
    gain, offset = np.where(unknown, 1.0, gain), np.where(unknown, 0.0, offset)
    brightest = np.percentile(albedo, _BRIGHT, axis=1) if albedo.size else np.full(bands, np.inf)
    return _shaded(Balance(gain, offset, np.full(bands, np.nan), brightest, np.zeros(bands)), samples)


def without_haze(balances: Sequence[Balance], samples: Sequence[np.ndarray]) -> list[Balance]:
    """The same with the scene's haze, which is no less in shadows: only what is left of the light is less there.

    The haze is what the darkest points show, as far as shadows have more than that. Images of one band have no colour
    to lose, and are left alone: where the surface's shadows are not quite theirs, as in trees, more light would be
    lifted that is none.

    Args:
        balances: of the images, without haze.
        samples: of the images, ``[2 C + 1, N]`` each, see `balance_of`.
    """
    darkest, shaded = [], []
    if len(balances[0].gain) < 2:
        return list(balances)
    for balance, points in zip(balances, samples, strict=True):
        bands = len(balance.gain)
        bright = (points[:bands] - balance.offset[:, None]) / balance.gain[:, None]
        shadow = bright[:, points[-1] <= 0.5]
        if shadow.shape[1] >= _FEWEST:
            darkest.append(np.percentile(bright, _DARKEST_PIXELS, axis=1))
            shaded.append(np.median(shadow, axis=1))
    if not darkest:
        return list(balances)
    haze = np.clip(_HAZY * np.median(darkest, axis=0), 0.0, _HAZIEST * np.maximum(np.median(shaded, axis=0), 0.0))
    return [_shaded(replace(b, haze=haze), points) for b, points in zip(balances, samples, strict=True)]


def _shaded(balance: Balance, samples: np.ndarray) -> Balance:
    """The same with the light in shadow that its samples in shadow have over that in the sun, where there are some."""
    bands, shadow = len(balance.gain), samples[:, samples[-1] <= 0.5]
    if shadow.shape[1] < _FEWEST:
        return balance
    haze = balance.haze[:, None]
    light = (shadow[:bands] - balance.offset[:, None]) / balance.gain[:, None] - haze
    light /= np.maximum(shadow[bands : 2 * bands] - haze, _DARK_GROUND)
    return replace(balance, shade=np.clip(np.median(light, axis=1), _DARKEST, 1.0))


def with_usual_shadows(balances: Sequence[Balance]) -> list[Balance]:
    """The same where shadows of images of which nothing tells are as dark over their light as those of the others."""
    known = [b.shade for b in balances if np.isfinite(b.shade).all()]
    usual = np.median(known, axis=0) if known else np.ones(len(balances[0].gain))
    return [b if np.isfinite(b.shade).all() else replace(b, shade=usual) for b in balances]


def _lines(samples: np.ndarray, bands: int, darkest: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Gain and offset ``[C]`` of radiance over albedo, outliers left out; NaN where too few points say.

    Where nothing is there but light of the air, an image shows its offset, so none is above its darkest pixels
    (``darkest`` [C]), whatever a line through few brightnesses says.
    """
    gain, offset = np.full(bands, np.nan), np.full(bands, np.nan)
    if samples.shape[1] < _FEWEST:
        return gain, offset
    for b in range(bands):
        value, albedo = samples[b], samples[bands + b]
        kept = np.ones(len(value), bool)
        for _ in range(3):
            if np.ptp(albedo[kept]) == 0:  # as over water in infrared, where all of it is 0
                break
            gain[b], offset[b] = np.polyfit(albedo[kept], value[kept], 1)
            left = np.abs(value - gain[b] * albedo - offset[b])
            kept = left <= max(3.0 * 1.4826 * float(np.median(left)), 1e-6)
        if offset[b] > darkest[b]:
            offset[b] = darkest[b]
            gain[b] = float((value[kept] - offset[b]) @ albedo[kept]) / max(float(albedo[kept] @ albedo[kept]), 1e-9)
    return gain, offset


def _range(maps: Maps) -> tuple[float, float]:
    """Lowest and highest height of the DSM [m]."""
    low, high = np.inf, -np.inf
    for rows, cols in maps.blocks():
        block = maps.read("dsm", rows, cols)
        if np.isfinite(block).any():
            low, high = min(low, float(np.nanmin(block))), max(high, float(np.nanmax(block)))
    return (low, high) if low <= high else (0.0, 1.0)


__all__ = ["Balance", "balance_of", "mosaic", "with_usual_shadows", "without_haze", "write_ortho"]
