"""The fitted scene as other cameras and other suns would show it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch
from torch import Tensor

from sattools.camera.ground import from_geographic, grid_direction, to_geographic
from sattools.camera.rpc import RPC
from sattools.camera.view_direction import ViewDirection
from sattools.errors import SceneError
from sattools.export.context import Exported
from sattools.export.field_views import field_picture, surface_picture
from sattools.fit.illumination import light_scale
from sattools.fit.materials.scene import ReflectiveScene
from sattools.fit.model import FittedModel
from sattools.fit.surface.scene import SurfaceScene
from sattools.radiometry.bands import BANDS_MEMBER
from sattools.render import ParallelRays, sun_visibility
from sattools.scene import Asset, Grid, Scene
from sattools.scene.document import GEOTIFF_TYPE
from sattools.scene.raster import write_cog, write_image_like
from sattools.views import View, load_sources, views_on, with_bands

RELIT = "export/relit.tif"
_STRIDE = 16  # pixels
Vector = tuple[float, float, float]


def grid_sun(grid: Grid, azimuth_deg: float, elevation_deg: float) -> Vector:
    """Unit vector (east, north, up) on the grid to a sun given from true north and the horizon.

    Args:
        grid: ground grid.
        azimuth_deg: from north, clockwise [degrees].
        elevation_deg: above the horizon [degrees].
    """
    west, south, east, north = grid.bounds
    lon, lat = to_geographic(grid.crs, (west + east) / 2, (south + north) / 2)
    vector = grid_direction(azimuth_deg, elevation_deg, grid.crs, float(lon), float(lat))
    return float(vector[0]), float(vector[1]), float(vector[2])


@torch.no_grad()
def light_towards(surface: SurfaceScene, cell: float, shadow: bool, sun: Vector | None, towards: Vector) -> Tensor:
    """Light ``[H, W, C]`` of every cell in the direction ``towards``.

    It is pi L / E of a reflectance model, else in units of the albedo.

    Shade has the mean ambient light of the images.

    Args:
        surface: the fitted scene.
        cell: edge of a cell [m].
        shadow: whether it casts shadows.
        sun: unit vector (east, north, up) to the sun, or None.
        towards: unit vector (east, north, up) to the sensor.
    """
    visibility = sun_visibility(surface.casting(), cell, sun) if shadow and sun is not None else None
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


@torch.no_grad()
def render_item(
    scene: Scene,
    item_id: str,
    surface: SurfaceScene,
    model: FittedModel,
    sun_angles: tuple[float, float] | None,
    valid: np.ndarray | None = None,
) -> tuple[np.ndarray, np.ndarray]:
    """An item's image as the model predicts it, on the image's own pixels, and the heights that they show.

    A training image has the gain and offset that the fit found. Any other one has none where the radiance is absolute;
    where it is relative, both are fitted on its western half, which is then left out (NaN), so that the eastern half
    can be scored.

    Args:
        scene: holds the item.
        item_id: its id.
        surface: of the model.
        model: how the images were fitted.
        sun_angles: (azimuth, elevation) of another sun [degrees], or None for the item's own.
        valid: ``[H, W]`` bool, cells of the model that images reach; pixels that show others are NaN. None = all.

    Returns:
        ``[C, h, w]`` float32 radiance, ``[1, h, w]`` float32 height of what a pixel shows [m]; NaN beyond the model.

    Raises:
        SceneError: the scene has no such item.
    """
    import cv2

    grid = model.grid
    items = [item for item in scene.items if item.id == item_id]
    if not items:
        raise SceneError(f"scene {scene.id}: found no item {item_id!r}, expected one for --view")
    (source,) = with_bands(load_sources(scene, items), items, model.bands)
    z_range = scene.require_height_range()
    z_ref = model.z_ref
    (view,) = views_on([source], grid, z_ref, z_range)
    sun = grid_sun(grid, *sun_angles) if sun_angles else view.sun
    known = model.items.index(item_id) if item_id in model.items else None
    pose = tuple(surface.pose[known].tolist()) if known is not None else (0.0, 0.0)
    if model.field == "surface":
        light = light_towards(surface, grid.cell_size, model.shadow != "none", sun, view.slope.unit())
        if known is not None:
            light = surface.gain[known] * light + surface.offset[known]
        light = light * light_scale(model.radiance, sun) if isinstance(surface, ReflectiveScene) else light
        rays = ParallelRays(view.slope, view.z_ref, (pose[0], pose[1]))
        picture, depth, opacity = surface_picture(model, surface.height, light, rays, z_range)
    else:
        picture, depth, opacity = field_picture(model, replace(view, sun=sun), known, z_range)
    # rays that reach the ground beyond the model show its border over and over
    rise = depth - z_ref
    rows, cols = picture.shape[:2]
    col = np.arange(cols)[None] + (pose[0] + view.slope.east * rise) / grid.cell_size
    row = np.arange(rows)[:, None] - (pose[1] + view.slope.north * rise) / grid.cell_size
    height = depth.astype(np.float32)
    inside = (col >= 0) & (row >= 0) & (col <= cols - 1) & (row <= rows - 1) & (opacity > 0.5)
    if valid is not None:
        near_row, near_col = (np.clip(np.rint(at), 0, n - 1).astype(np.intp) for at, n in ((row, rows), (col, cols)))
        inside &= valid[near_row, near_col]
    height[~inside] = np.nan
    if known is None and not model.absolute:
        picture = _matched(picture, view.target, (view.mask > 0) & inside)
        inside[:, : cols // 2] = False
    picture[~inside] = np.nan
    at_col, at_row = _pixels_on(source.rpc, source.radiance.shape[1:], grid, z_ref)

    def on_pixels(values: np.ndarray) -> np.ndarray:
        shown = cv2.remap(
            values, at_col, at_row, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT, borderValue=(np.nan,) * 4
        )
        return np.asarray(shown.reshape(*at_col.shape, -1).transpose(2, 0, 1))

    return on_pixels(picture), on_pixels(height)


def _matched(picture: np.ndarray, target: np.ndarray, counted: np.ndarray) -> np.ndarray:
    """``picture`` with gain and offset per band that bring its western half to the target's."""
    half = counted.copy()
    half[:, counted.shape[1] // 2 :] = False
    if half.sum() < 10:
        return picture
    result = picture.copy()
    for b in range(picture.shape[-1]):
        design = np.stack([picture[half][:, b], np.ones(int(half.sum()))], axis=1)
        (gain, offset), *_ = np.linalg.lstsq(design, target[half][:, b], rcond=None)
        result[..., b] = gain * picture[..., b] + offset
    return result


def _pixels_on(rpc: RPC, shape: tuple[int, ...], grid: Grid, z_ref: float) -> tuple[np.ndarray, np.ndarray]:
    """Where the lines of sight of an image's pixels cross the reference height: (column, row) of the grid, float32.

    The camera is asked at every `_STRIDE`-th pixel only, and is as good as straight between them.
    """
    from scipy.interpolate import RegularGridInterpolator

    rows, cols = shape[-2:]
    knots = [np.append(np.arange(0, size - 1, _STRIDE), size - 1).astype(np.float64) for size in (rows, cols)]
    if min(len(axis) for axis in knots) < 2:
        knots = [np.array([0.0, max(1.0, size - 1)]) for size in (rows, cols)]
    row, col = np.meshgrid(*knots, indexing="ij")
    lon, lat = rpc.localization(col.ravel(), row.ravel(), np.full(col.size, z_ref))
    east, north = from_geographic(grid.crs, lon, lat)
    at_col = (np.asarray(east) - grid.left) / grid.cell_size - 0.5
    at_row = (grid.top - np.asarray(north)) / grid.cell_size - 0.5
    between = RegularGridInterpolator(tuple(knots), np.stack([at_col, at_row], axis=1).reshape(*col.shape, 2))
    every = np.stack(np.meshgrid(np.arange(rows), np.arange(cols), indexing="ij"), axis=-1)
    found = between(every.reshape(-1, 2)).reshape(rows, cols, 2).astype(np.float32)
    return np.ascontiguousarray(found[..., 0]), np.ascontiguousarray(found[..., 1])


def write_view(exported: Exported, item_id: str, surface: SurfaceScene, sun_angles: tuple[float, float] | None) -> None:
    """Write the item's assets ``rendered`` and ``rendered_height`` (with another sun: ``relit``).

    Args:
        exported: what is exported.
        item_id: id of the item.
        surface: of the model.
        sun_angles: (azimuth, elevation) of another sun [degrees], or None.
    """
    scene = exported.scene
    picture, height = render_item(scene, item_id, surface, exported.model, sun_angles, exported.valid)
    item = next(item for item in scene.items if item.id == item_id)
    like = next(item.assets[asset] for asset in ("radiance", "image") if asset in item.assets)
    files = {"relit": picture} if sun_angles else {"rendered": picture, "rendered_height": height}
    for name, array in files.items():
        href = view_href(name, item_id)
        write_image_like(scene.output(href), array, scene.path(like.href))
        spectral = name != "rendered_height" and exported.model.bands
        item.assets[name] = Asset(href, GEOTIFF_TYPE, extra={BANDS_MEMBER: exported.model.bands} if spectral else {})


def write_relit(exported: Exported, surface: SurfaceScene, sun_angles: tuple[float, float]) -> None:
    """The scene from above under another sun, on the ground grid: product ``relit``.

    Args:
        exported: what is exported.
        surface: of the model.
        sun_angles: (azimuth, elevation) of the sun [degrees].
    """
    scene, model = exported.scene, exported.model
    grid = model.grid
    sun = grid_sun(grid, *sun_angles)
    if model.field == "surface":
        light = light_towards(surface, grid.cell_size, model.shadow != "none", sun, (0.0, 0.0, 1.0)).numpy()
    else:
        light, _, _ = field_picture(model, _from_above(model, sun), None, scene.require_height_range())
    tags = {"SUN_AZIMUTH": f"{sun_angles[0]:g}", "SUN_ELEVATION": f"{sun_angles[1]:g}", "SOFTWARE": "sattools"}
    array = exported.shown(light.transpose(2, 0, 1))
    write_cog(scene.output(RELIT), array, grid, units="1", tags=tags)
    scene.products["relit"] = RELIT


def _from_above(model: FittedModel, sun: Vector) -> View:
    rows, cols, bands = model.albedo.shape
    nothing = np.zeros((rows, cols, bands), np.float32), np.zeros((rows, cols), np.uint8)
    return View("above", *nothing, ViewDirection(0.0, 0.0), model.z_ref, sun, 0.0)


def view_href(name: str, item_id: str) -> str:
    """Where a map or picture of an image goes."""
    return f"export/{name}/{item_id}.tif"


__all__ = ["RELIT", "light_towards", "render_item", "view_href", "write_relit", "write_view"]
