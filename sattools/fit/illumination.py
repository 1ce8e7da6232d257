"""What a scene's numbers are, under which angles it was seen, and what that allows to find out."""

from __future__ import annotations

import logging
import math
from collections.abc import Sequence
from dataclasses import replace
from typing import cast

import numpy as np
import torch
from torch import Tensor

from sattools.errors import SceneError
from sattools.fit.depth_prior import DepthPrior
from sattools.fit.described import Description, Radiance
from sattools.fit.losses import CALIBRATED_SHARE
from sattools.fit.materials.normals import surface_normals
from sattools.fit.materials.parameters import SHAPE
from sattools.fit.materials.scene import ReflectiveScene
from sattools.fit.options import FitOptions, parse_views
from sattools.scene import Grid, Item, Scene
from sattools.scene.regrid import resize_map
from sattools.views import Source

log = logging.getLogger(__name__)

KINDS = ("reflectance_factor", "toa_reflectance", "relative")
NARROW_PHASE_DEG = 10.0  # below this span a phase function is a constant
CALIBRATED_SMOOTH = 0.2
PLAIN_PRIOR = 5.0  # factor of the prior's weight where one colour per cell has to explain calibrated images
NORMAL_SMOOTHING_M = 6.0
EXPOSURE = 1 / 3  # median radiance of images that fill their range
LEAST_LEVEL = 0.05  # sine of the sun's elevation that still lights level ground
LEAST_KNOWN = 0.5  # share of the prior's variance that the images must take away before a parameter counts as found
UNKNOWN_SHARE = 0.2  # standard deviation, as share of the range, from which a parameter counts as unknown


def radiance_kind(scene: Scene, items: Sequence[Item]) -> Radiance:
    """What the items' numbers are (property ``sattools:radiance``); ``relative`` where nothing is said.

    ``reflectance_factor`` is pi L / E with the sun's irradiance E across its beam, ``toa_reflectance`` pi L / (E sin
    (sun elevation)), ``relative`` has an unknown scale.

    Raises:
        SceneError: an unknown kind, or items of different kinds.
    """
    kinds = {str(item.properties.get("sattools:radiance", "relative")) for item in items}
    for kind in sorted(kinds):
        if kind not in KINDS:
            raise SceneError(f"scene {scene.id}: found sattools:radiance {kind!r}, expected one of {', '.join(KINDS)}")
    if len(kinds) > 1:
        raise SceneError(f"scene {scene.id}: found images with sattools:radiance {sorted(kinds)}, expected one kind")
    return cast(Radiance, kinds.pop())


def light_scale(kind: Radiance, sun: tuple[float, float, float] | None) -> float:
    """Numbers in the image per pi L / E."""
    if kind == "toa_reflectance" and sun is not None:
        return 1 / max(sun[2], 0.02)
    return 1.0


def levels(kind: Radiance, suns: Sequence[tuple[float, float, float] | None], bands: int) -> np.ndarray:
    """Gains ``[V, bands]`` of images of one scale where the light of a cell has no cosine of the incidence, Lambert's.

    Level ground shows a reflectance factor times the sine of the sun's elevation, so this belongs to the image, not to
    the albedo.

    Args:
        kind: what the images' numbers are.
        suns: unit vectors to the suns of the images; None = unknown, and taken for as high as the others usually are.
        bands: number of bands.
    """
    if kind != "reflectance_factor":
        return np.ones((len(suns), bands), np.float32)
    known = [max(sun[2], LEAST_LEVEL) for sun in suns if sun]
    usual = float(np.median(known)) if known else 1.0
    each = [max(sun[2], LEAST_LEVEL) if sun else usual for sun in suns]
    return np.repeat(np.array(each, np.float32)[:, None], bands, axis=1)


def level_towards(model: Description, gain: Tensor, sun: tuple[float, float, float] | None) -> float:
    """The gain of a picture under a sun that no image has, see `levels`; 1 for a model that has none.

    Args:
        model: what was fitted.
        gain: ``[V, C]`` of its images.
        sun: unit vector to the sun, or None.
    """
    if model.brdf != "lambert" or not model.absolute or bool((gain == 1).all()):
        return 1.0
    if sun is None:
        return float(gain.median())
    return float(levels(model.radiance, [sun], 1)[0, 0])


def calibrated(options: FitOptions, kind: Radiance) -> FitOptions:
    """The options with the weights of the loss set for images that agree to a per cent, as calibrated ones do.

    They are given for images of many dates, in units of `FitOptions.robust`, a tenth of the range from black to white;
    calibrated images differ by less before something is wrong, and the smoothness may be overruled by less. The prior
    may not: what a reflectance model leaves unexplained would be taken for heights, most of all what one colour does.
    """
    if kind == "relative":
        return options
    smooth = CALIBRATED_SMOOTH if options.smooth is None else options.smooth
    return replace(
        options,
        robust=options.robust * CALIBRATED_SHARE,
        smooth=smooth,
        prior_weight=options.prior_weight * (PLAIN_PRIOR if options.brdf == "lambert" else 1.0),
    )


def exposed(sources: list[Source]) -> tuple[list[Source], float]:
    """Linear images brightened by a common factor, so that the median pixel is no darker than `EXPOSURE`; the factor.

    Full scale of a sensor is far above what a city usually fills. Steps of the fit and what counts as an edge of the
    albedo are meant for images that fill it, as tone-mapped ones do: the surface must not depend on the unit of
    radiance.
    """
    if not all(source.linear for source in sources):
        return sources, 1.0
    seen = np.concatenate([source.radiance[..., ::3, ::3].ravel() for source in sources])
    seen = seen[np.isfinite(seen)]
    factor = max(1.0, EXPOSURE / max(float(np.median(seen)), 1e-6)) if len(seen) else 1.0
    return [replace(source, radiance=source.radiance * np.float32(factor)) for source in sources], factor


def views_left_out(scene: Scene, which: str) -> list[str]:
    """Ids of the training images that ``which`` (``all`` or ``nearest-nadir:N``) leaves out.

    Raises:
        InputError: another text.
        SceneError: an image without its off-nadir angle.
    """
    count = parse_views(which)
    if count is None:
        return []
    items = scene.train_items()
    for item in items:
        if item.properties.get("view:off_nadir") is None:
            raise SceneError(f"scene {scene.id}: item {item.id} has no view:off_nadir, expected it for --views {which}")
    items.sort(key=lambda item: float(item.properties["view:off_nadir"]))
    return [item.id for item in items[count:]]


def phase_angles(items: Sequence[Item]) -> np.ndarray:
    """Angle between sun and sensor of every item that has both [degrees]."""
    angles = []
    for item in items:
        azimuth, tilt = item.properties.get("view:azimuth"), item.properties.get("view:incidence_angle")
        if tilt is None:
            tilt = item.properties.get("view:off_nadir")
        if item.sun is None or azimuth is None or tilt is None:
            continue
        a, b = math.radians(item.sun[0] - float(azimuth)), math.radians(float(tilt))
        z = math.radians(90 - item.sun[1])
        cosine = math.cos(z) * math.cos(b) + math.sin(z) * math.sin(b) * math.cos(a)
        angles.append(math.degrees(math.acos(min(1.0, max(-1.0, cosine)))))
    return np.array(angles)


def check_light(scene: Scene, items: Sequence[Item], kind: Radiance, brdf: str) -> list[str]:
    """Remarks about phase and incidence angles and what they allow.

    Args:
        scene: the scene.
        items: the training images.
        kind: what their numbers are.
        brdf: reflectance model.

    Raises:
        SceneError: a reflectance model is asked for and a sun is unknown.
    """
    if brdf == "lambert":
        return []
    for item in items:
        if item.sun is None:
            raise SceneError(f"scene {scene.id}: item {item.id} has no sun angles, expected them for --brdf {brdf}")
    phase = phase_angles(items)
    zeniths = sorted({round(90 - item.sun[1], 1) for item in items if item.sun is not None})
    notes = []
    if len(phase):
        span = float(np.ptp(phase))
        text = (
            f"phase angles {phase.min():.0f} to {phase.max():.0f} degrees, "
            f"sun {zeniths[0]:g} to {zeniths[-1]:g} degrees from the vertical"
        )
        if span < NARROW_PHASE_DEG:
            text += f": a span of {span:.0f} degrees does not show a phase function; its shape is the prior's"
        elif brdf == "hapke" and zeniths[-1] - zeniths[0] < NARROW_PHASE_DEG:
            text += ": b and c are known along one line only, the prior says where on it; theta comes from the slopes"
        notes.append(text)
    if kind == "relative":
        notes.append("radiance of unknown scale: amplitudes are relative, their ratios mean something, their level not")
    if zeniths and zeniths[-1] > 70:
        notes.append(f"sun only {90 - zeniths[-1]:.0f} degrees high: long shadows, and slopes in grazing light")
    for text in notes:
        log.info(text)
    return notes


def material_notes(scene: ReflectiveScene, std: dict[str, Tensor], sky: str = "none") -> list[str]:
    """What was found of the materials' shapes, in the parameters' units, and what the data do not determine.

    Args:
        scene: the fitted surface.
        std: standard deviations of the parameters by name.
        sky: what was asked for.
    """
    _, shape = scene.values()
    notes = [f"{scene.endmembers.shape[0]} endmembers"]
    own = torch.ones_like(scene.height, dtype=torch.bool)  # ground that has shape parameters
    if (plain := scene.plain_share()) is not None:
        notes[0] += f", {int(scene.plain.sum())} of them Lambert's ({100 * float(plain.mean()):.0f} % of the ground)"
        own = plain <= plain.min().clamp_min(0.5)
    for k, (parameter, value) in enumerate(zip(SHAPE[scene.kind], shape, strict=True)):
        spread, here = float(std[parameter.name][own].median()), value[own]
        text = f"{parameter.name} {float(here.min()):.2f} to {float(here.max()):.2f}, std {spread:.2f}"
        found = float(scene.identifiable[..., k][own].median()) if scene.identifiable.numel() else 1.0
        if spread > UNKNOWN_SHARE * (parameter.high - parameter.low) or found < LEAST_KNOWN:
            text += " (not determined by these views: its prior)"
        notes.append(text)
    if scene.identifiable.numel():
        one, other = (parameter.name for parameter in SHAPE[scene.kind][:2])
        notes.append(f"errors of {one} and {other} correlate by {scene.correlation:+.2f}")
    if scene.has_sky:
        share = ", ".join(f"{100 * float(value):.1f}" for value in scene.sky_share)
        known = (
            f"from shade, {scene.sky_ratio:.0f} standard deviations from none" if scene.sky_ratio else "as it was set"
        )
        note = f"sky light {share} % of the sun's in the bands ({known})"
        if scene.opened.numel():
            hidden = 100 * (1 - float(scene.opened.mean()))
            note += f"; where other ground hides it ({hidden:.0f} %), that ground's light"
        notes.append(note)
    return [*scene.reasons, "; ".join(notes), *_without_sky(scene, sky)]


def _without_sky(scene: ReflectiveScene, sky: str) -> list[str]:
    """That a sky was looked for and the surface has none, in which case the light is that of ``--sky none``."""
    if scene.has_sky or sky == "none":
        return []
    if sky == "auto":
        return ["no light of the sky was kept: shade does not surely show any"]
    note = "--sky fitted found no light of the sky: too little deep shade, or none that an even sky explains"
    log.warning(note)
    return [note]


def prior_normals(prior: DepthPrior | None, grid: Grid) -> Tensor:
    """Unit vectors ``[H, W, 3]`` normal to the prior's surface, smoothed over `NORMAL_SMOOTHING_M`, on a grid.

    Raises:
        SceneError: there is no prior.
    """
    if prior is None:
        raise SceneError("--normals prior: found no prior, expected one (--prior-weight above 0)")
    from scipy.ndimage import gaussian_filter

    height, own = prior.height.numpy(), prior.grid
    known = np.isfinite(height)
    sigma = NORMAL_SMOOTHING_M / own.cell_size
    weight = gaussian_filter(known.astype(np.float64), sigma, mode="nearest")
    smooth = gaussian_filter(np.where(known, height, 0.0).astype(np.float64), sigma, mode="nearest")
    smooth = np.where(weight > 1e-3, smooth / np.maximum(weight, 1e-3), np.nanmean(height))
    on_grid = torch.from_numpy(resize_map(smooth, own, grid))
    return surface_normals(torch.nan_to_num(on_grid, nan=float(np.nanmean(height))), grid.cell_size)


__all__ = [
    "KINDS",
    "LEAST_KNOWN",
    "calibrated",
    "check_light",
    "exposed",
    "level_towards",
    "levels",
    "light_scale",
    "material_notes",
    "phase_angles",
    "prior_normals",
    "radiance_kind",
    "views_left_out",
]
