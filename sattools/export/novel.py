"""The fitted scene as other cameras and other suns would show it."""

from __future__ import annotations

import logging
import math
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from sattools.camera.ground import grid_sun
from sattools.camera.rpc import RPC
from sattools.camera.view_direction import ViewDirection
from sattools.errors import SceneError
from sattools.export.context import RELIT, band_names, radiance_scale, view_href
from sattools.export.field_views import field_picture, surface_picture
from sattools.export.parts import Part, Parts, WholeModel
from sattools.export.pictures import ColourScale, Picture
from sattools.fit.described import Description
from sattools.fit.illumination import level_towards, light_scale
from sattools.fit.materials.scene import ReflectiveScene
from sattools.fit.model import FittedModel
from sattools.fit.surface.scene import SurfaceScene
from sattools.radiometry.bands import BANDS_MEMBER
from sattools.render import ParallelRays
from sattools.scene import Asset, Grid, Item, Scene
from sattools.scene.cog import CogWriter
from sattools.scene.datums import ELLIPSOID
from sattools.scene.document import GEOTIFF_TYPE
from sattools.scene.sensor_files import write_sensor_maps
from sattools.views import View, line_of_sight, load_sources, with_bands
from sattools.views.resample import make_view

log = logging.getLogger(__name__)
# On a simulated town shadows that were learned under seven suns are as good as cast ones up to 3 degrees from the
# nearest of them (IoU 0.8 both), and 0.74, 0.68 and 0.57 at 6, 9 and 16 degrees, where cast ones are as good as ever
# (`benchmarks/far_suns.py`)
FAR_SUN_DEG = 5.0
SCALED = "from the western half of the image, of unknown scale: only the eastern half can be scored"
REACH_SPARE = 1.25  # times how far rays go within the height range
Vector = tuple[float, float, float]


@dataclass(frozen=True)
class Shown:
    """A scene and its fitted model, to be shown.

    Attributes:
        scene: gets the files.
        parts: the model.
    """

    scene: Scene
    parts: Parts


@torch.no_grad()
def _light_towards(surface: SurfaceScene, visibility: Tensor | None, sun: Vector | None, towards: Vector) -> Tensor:
    """Light ``[H, W, C]`` of every cell in the direction ``towards``.

    It is pi L / E of a reflectance model, else in units of the albedo.

    Shade has the mean ambient light of the images.

    Args:
        surface: the fitted scene.
        visibility: ``[H, W]`` share of the sun's light that reaches the cells; None = all of it.
        sun: unit vector (east, north, up) to the sun, or None.
        towards: unit vector (east, north, up) to the sensor.
    """
    ambient = surface.ambient.mean(0)
    if isinstance(surface, ReflectiveScene):
        if sun is None:
            raise SceneError("export: found no sun for a reflectance model, expected sun angles or --sun")
        sun_at, towards_at = (surface.height.new_tensor(v) for v in (sun, towards))
        return surface.light(sun_at, towards_at, visibility, ambient)
    if visibility is None:
        return surface.albedo
    v = visibility[..., None]
    return surface.albedo * (v + (1 - v) * ambient)


def _numbers_of_light(part: Part, sun: Vector | None) -> float:
    """Factor of `_light_towards` that makes the images' numbers of it under a sun (unit vector) that no image has."""
    level = level_towards(part.model, part.surface.gain, sun)
    return level * light_scale(part.model.radiance, sun) if isinstance(part.surface, ReflectiveScene) else level


def render_item(
    scene: Scene, item_id: str, parts: Parts, sun_angles: tuple[float, float] | None, folder: Path | None = None
) -> Picture:
    """An item's image as the model predicts it, on the image's own pixels, and the heights that they show.

    A training image has the gain and offset that the fit found. Any other one has none where the radiance is absolute;
    where it is relative, both are fitted on its western half, and the eastern half alone can be scored (`scored`).
    Lines of sight are those of every part of the model.

    Args:
        scene: holds the item.
        item_id: its id.
        parts: the model.
        sun_angles: (azimuth, elevation) of another sun [degrees], or None for the item's own.
        folder: for temporary files; None = the system's.

    Returns:
        Its bands ``[h, w]`` [radiance] and height ``[h, w]`` [m], maps that are read by rows (`sattools.scene.stored`);
        NaN beyond the model and where it may not be shown.

    Raises:
        SceneError: the scene has no such item, or it shows nothing of the model.
    """
    items = [item for item in scene.items if item.id == item_id]
    if not items:
        raise SceneError(f"scene {scene.id}: found no item {item_id!r}, expected one for --view")
    head, z_range = parts.head, scene.require_height_range()
    known = head.items.index(item_id) if item_id in head.items else None
    scale = ColourScale(head.albedo.shape[-1]) if _is_scaled(head, item_id) else None
    picture = Picture(scene, items[0], head.albedo.shape[-1], folder, in_part=scale is not None)
    slope, _ = line_of_sight(picture.rpc, parts.grid, head.z_ref, z_range)
    steepest = max(abs(slope.east), abs(slope.north)) if all(map(math.isfinite, slope)) else 0.0
    pose = tuple(head.pose[known].tolist()) if known is not None else (0.0, 0.0)
    reach = REACH_SPARE * steepest * (z_range[1] - z_range[0]) + max(map(abs, pose))
    for part in parts.parts(reach):
        window = picture.window(part, parts.grid, head.z_ref)
        if window is None:
            continue
        view = _view(scene, items[0], part.model, picture.rpc, sun_angles, scale is not None)
        radiance, height = _shown(parts.grid, part, view, known, (pose[0], pose[1]), z_range)
        scored = None
        if scale is not None:
            west = max(0, min(parts.grid.width // 2 - part.cols.start, radiance.shape[1]))
            told = radiance
            if sun_angles and items[0].sun is not None:  # the image shows the shadows of its own sun
                own = replace(view, sun=grid_sun(part.model.grid, *items[0].sun))
                told, _ = _shown(parts.grid, part, own, known, (pose[0], pose[1]), z_range)
            scale.add(told, view, part, west)
            scored = np.where(np.isfinite(radiance).all(axis=-1), np.float32(1), np.float32(np.nan))
            scored[:, :west] = np.nan
        picture.put(window, part, radiance, height, head.z_ref, scored=scored)
    picture.check()
    if scale is not None:
        scale.apply(picture.bands)
    return picture


def _is_scaled(about: Description, item_id: str) -> bool:
    """Whether a picture of an image gets its gain and offset from the image itself, as a fit knows none."""
    return item_id not in about.items and not about.absolute


def _view(
    scene: Scene, item: Item, model: FittedModel, rpc: RPC, sun_angles: tuple[float, float] | None, pixels: bool
) -> View:
    """The line of sight and the sun over a part, with what the image shows there if that is asked for."""
    grid, z_range = model.grid, scene.require_height_range()
    if pixels:
        (source,) = with_bands(load_sources(replace(scene, grid=grid), [item]), [item], model.bands)
        view = make_view(source.id, source.radiance, source.rpc, grid, model.z_ref, z_range, sun=item.sun)
    else:
        slope, spread = line_of_sight(rpc, grid, model.z_ref, z_range)
        sun = grid_sun(grid, *item.sun) if item.sun is not None else None
        nothing = np.zeros((*grid.shape, 1), np.float32), np.zeros(grid.shape, np.uint8)
        view = View(item.id, *nothing, slope, model.z_ref, sun, spread)
    return replace(view, sun=grid_sun(grid, *sun_angles)) if sun_angles else view


@torch.no_grad()
def _shown(
    whole: Grid, part: Part, view: View, known: int | None, pose: tuple[float, float], z_range: tuple[float, float]
) -> tuple[np.ndarray, np.ndarray]:
    """What a view shows of a part, at the reference height: ``[h, w, C]`` radiance and ``[h, w]`` height [m]."""
    model, surface, grid = part.model, part.surface, part.model.grid
    if model.field == "surface":
        light = _light_towards(surface, part.lit(view.sun), view.sun, view.slope.unit())
        if known is not None and not model.absolute:
            light = surface.gain[known] * light + surface.offset[known]
        light = light * _numbers_of_light(part, view.sun)
        rays = ParallelRays(view.slope, view.z_ref, pose)
        picture, depth, opacity = surface_picture(model, surface.height, light, rays, z_range)
    else:
        picture, depth, opacity = field_picture(model, view, known, z_range)
    # rays that reach the ground beyond the model show its border over and over
    rise = depth - model.z_ref
    rows, cols = depth.shape
    col = np.arange(cols)[None] + (pose[0] + view.slope.east * rise) / grid.cell_size
    row = np.arange(rows)[:, None] - (pose[1] + view.slope.north * rise) / grid.cell_size
    inside = (col >= -part.cols.start) & (row >= -part.rows.start) & (opacity > 0.5)
    inside &= (col <= whole.width - 1 - part.cols.start) & (row <= whole.height - 1 - part.rows.start)
    if part.valid is not None:
        near_row, near_col = (np.clip(np.rint(at), 0, n - 1).astype(np.intp) for at, n in ((row, rows), (col, cols)))
        inside &= part.valid[near_row, near_col]
    return np.where(inside[..., None], picture, np.nan), np.where(inside, depth, np.nan).astype(np.float32)


def write_view(exported: Shown, item_id: str, sun_angles: tuple[float, float] | None) -> None:
    """Write the item's assets ``rendered`` and ``rendered_height`` (with another sun: ``relit``).

    Args:
        exported: what is exported.
        item_id: id of the item.
        sun_angles: (azimuth, elevation) of another sun [degrees], or None.
    """
    scene, bands = exported.scene, exported.parts.head.bands
    item = next((item for item in scene.items if item.id == item_id), None)
    parts, tags = exported.parts, dict[str, str]()
    if sun_angles:
        parts, tags = _casting_under(parts, grid_sun(parts.grid, *sun_angles))
    elif item is not None and item.sun and (away := beyond_learned(parts.head, grid_sun(parts.grid, *item.sun))):
        tags = {"SHADOWS": f"as learned, under suns {away:.0f} degrees or more away"}
        log.warning("%s: shadows %s", item_id, tags["SHADOWS"])
    picture = render_item(scene, item_id, parts, sun_angles, scene.root)
    assert item is not None  # `render_item`
    files = {"relit": picture.bands} if sun_angles else {"rendered": picture.bands, "rendered_height": [picture.height]}
    if picture.scored is not None:
        tags |= {"GAIN": SCALED}
        log.info("%s: gain and offset %s", item_id, SCALED)
        if not sun_angles:
            files["rendered_scored"] = [picture.scored]
    for name, maps in files.items():
        href = view_href(name, item_id)
        shown = name in ("rendered", "relit")
        words, own = [name.removeprefix("rendered_")], dict[str, str]()
        if shown:
            words, own = band_names(scene, exported.parts.head, "radiance", len(maps))
            own |= tags
        elif name == "rendered_height":
            own["VERTICAL_DATUM"] = ELLIPSOID  # the model's, whatever --vertical says of the DSM
        write_sensor_maps(scene.output(href), maps, picture.rpc.to_tags(), own, words)
        item.assets[name] = Asset(href, GEOTIFF_TYPE, extra={BANDS_MEMBER: bands} if shown and bands else {})


def write_relit(exported: Shown, sun_angles: tuple[float, float]) -> None:
    """The scene from above under another sun, on the ground grid: product ``relit``.

    Args:
        exported: what is exported.
        sun_angles: (azimuth, elevation) of the sun [degrees].
    """
    scene, head, grid = exported.scene, exported.parts.head, exported.parts.grid
    sun = grid_sun(grid, *sun_angles)
    tags = {"SUN_AZIMUTH": f"{sun_angles[0]:g}", "SUN_ELEVATION": f"{sun_angles[1]:g}", "SOFTWARE": "sattools"}
    parts, more = _casting_under(exported.parts, sun)
    if more:
        log.warning("--sun: shadows %s", more["SHADOWS"])
    count = head.albedo.shape[-1]
    names, lengths = band_names(scene, head, "radiance", count)
    tags |= more | lengths | {"SCALE": radiance_scale(head)}
    with CogWriter(scene.output(RELIT), grid, bands=count, units="1", tags=tags, descriptions=names) as out:
        for part in parts.parts():
            if head.field == "surface":
                light = _light_towards(part.surface, part.lit(sun), sun, (0.0, 0.0, 1.0)).detach().numpy()
                light = light * _numbers_of_light(part, sun)
            else:
                light, _, _ = field_picture(part.model, from_above(part.model, sun), None, scene.require_height_range())
            light = np.maximum(light, 0)  # as the albedo is exported, whose darkest ground may be below none at all
            shown = light if part.valid is None else np.where(part.valid[..., None], light, np.nan)
            rows, cols = part.own
            own = shown[
                rows.start - part.rows.start : rows.stop - part.rows.start,
                cols.start - part.cols.start : cols.stop - part.cols.start,
            ]
            out.write(own.transpose(2, 0, 1), rows, cols)
    scene.products["relit"] = RELIT


def _casting_under(parts: Parts, sun: Vector) -> tuple[Parts, dict[str, str]]:
    """A model as it is shown under a sun that was asked for, and tag ``SHADOWS`` where that is not as it was fitted.

    Under a sun that learned shadows do not reach, the volume casts them instead.

    Args:
        parts: the model.
        sun: unit vector (east, north, up) to the sun.
    """
    away = beyond_learned(parts.head, sun)
    if away is None or not isinstance(parts, WholeModel):
        return parts, {}
    words = f"cast by the volume, not as learned: the nearest sun of the training is {away:.0f} degrees away"
    return replace(parts, head=replace(parts.head, shadow="geometric")), {"SHADOWS": words}


def beyond_learned(about: Description, sun: Vector) -> float | None:
    """Degrees from a sun (unit vector) to the nearest of the training where learned shadows do not reach it, else None.

    A fitted surface casts its shadows under every sun.
    """
    if about.field == "surface" or about.shadow != "learned":
        return None
    cosines = [math.fsum(a * b for a, b in zip(sun, known, strict=True)) for known in about.suns if known is not None]
    away = math.degrees(math.acos(max(-1.0, min(1.0, max(cosines, default=-1.0)))))
    return away if away > FAR_SUN_DEG else None


def from_above(model: FittedModel, sun: Vector) -> View:
    """A vertical line of sight over a model under a sun (unit vector east, north, up); it has no pixels."""
    rows, cols, bands = model.albedo.shape
    nothing = np.zeros((rows, cols, bands), np.float32), np.zeros((rows, cols), np.uint8)
    return View("above", *nothing, ViewDirection(0.0, 0.0), model.z_ref, sun, 0.0)


__all__ = [
    "FAR_SUN_DEG",
    "Shown",
    "beyond_learned",
    "from_above",
    "render_item",
    "write_relit",
    "write_view",
]
