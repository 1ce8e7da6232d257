"""Multispectral images of the same acquisitions as the panchromatic ones: one item per acquisition.

Pixels are not resampled: both keep their own, and their own cameras. The panchromatic camera is corrected by tie
points; what the correction means on the ground holds for the multispectral one, which flew on the same satellite.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from sattools.camera.ground import crop_window, to_geographic
from sattools.camera.rpc import RPC
from sattools.errors import InputError, counted
from sattools.prep.beside import beside
from sattools.prep.images import SourceImage
from sattools.prep.loading import load_source
from sattools.prep.names import image_id
from sattools.prep.pixels import look_for_frames, write_image
from sattools.prep.times import same_moment
from sattools.radiometry.bands import named_bands
from sattools.scene import Scene
from sattools.scene.document import GEOTIFF_TYPE, Asset
from sattools.scene.files import write_text
from sattools.scene.location import RemotePath, images_in
from sattools.scene.opening import opened

# words of a name that say which sensor took an image, not which acquisition it is
SENSORS = {
    *("pan", "p", "p1bs", "p2as", "pan1", "pan2", "panchromatic"),
    *("ms", "fs", "mul", "mux", "mss", "mss1", "mss2", "m", "m1bs", "m2as", "xs", "multi", "multispectral", "analytic"),
    *("rgb", "colour", "color"),
}
MARGIN_PX = 8
GRID = 7  # points along an axis at which two cameras are compared


def colour_files(folder: str) -> list[Path]:
    """The images in a folder, sorted. Raises InputError where there is none."""
    path = Path(folder)
    if not path.is_dir():
        raise InputError(f"--colours: found no folder {path}, expected one of multispectral images")
    found = images_in(path)
    if not found:
        raise InputError(f"--colours: found no images in {path}, expected a folder of multispectral images")
    return found


def hrefs(ids: Sequence[str]) -> list[str]:
    """Files that may be written for items with these names."""
    return [href for i in ids for href in (_image(i), _camera(i))]


def _image(name: str) -> str:
    return f"colours/{name}.tif"


def _camera(name: str) -> str:
    return f"rpc/{name}_COLOURS_RPC.TXT"


def partners(pans: Sequence[SourceImage], colours: Sequence[SourceImage]) -> list[SourceImage | None]:
    """Of every panchromatic image the multispectral one of the same acquisition: by name, else by time.

    Raises:
        InputError: none has one, or two claim the same.
    """
    found: list[SourceImage | None] = []
    for pan in pans:
        own = [c for c in colours if _words(c.id) == _words(pan.id)] or [
            c for c in colours if same_moment(c.metadata.time, pan.metadata.time)
        ]
        if len(own) > 1:
            raise InputError(f"--colours: found {own[0].path} and {own[1].path} for {pan.id}, expected one of them")
        if own and (earlier := [p.id for p, c in zip(pans, found, strict=False) if c is own[0]]):
            raise InputError(f"--colours: found {own[0].path} for {earlier[0]} and {pan.id}, expected one for each")
        found.append(own[0] if own else None)
    if not any(found):
        raise InputError(
            f"--colours: found no image with the name or the time of {pans[0].id} or another one, expected names that "
            "differ in words such as PAN and MS only"
        )
    return found


def _words(name: str) -> list[str]:
    return [word for word in re.split(r"[^a-z0-9]+", name.lower()) if word and word not in SENSORS]


def load_colours(options_folder: str, metadata: Path | None, pans: Sequence[SourceImage]) -> list[SourceImage | None]:
    """Of every image its partner with pixels and camera, see `partners`.

    Args:
        options_folder: of the multispectral images.
        metadata: folder of metadata files.
        pans: the panchromatic images.

    Raises:
        InputError: what cannot be read or belongs to none.
    """
    colours = [load_source(path, image_id(path), metadata) for path in colour_files(options_folder)]
    for colour in colours:
        if colour.bands < 2:
            raise InputError(f"--colours: found one band in {colour.path}, expected a multispectral image")
        if colour.bands != colours[0].bands:
            raise InputError(
                f"--colours: found {counted(colour.bands, 'bands')} in {colour.path}, expected {colours[0].bands} as "
                f"in {colours[0].path}"
            )
    return partners(pans, colours)


def corrected(colour: RPC, raw: RPC, camera: RPC, places: np.ndarray) -> tuple[RPC, float]:
    """The multispectral camera with the panchromatic one's correction, and how well that fits [px].

    Args:
        colour: multispectral camera as it was delivered.
        raw: panchromatic camera as it was delivered.
        camera: the same, corrected.
        places: ``[N, 3]`` longitude, latitude [degrees], height [m] in the scene.
    """
    before = np.stack(raw.projection(*places.T), axis=1)
    after = np.stack(camera.projection(*places.T), axis=1)
    own = np.stack(colour.projection(*places.T), axis=1)
    # from panchromatic to multispectral pixels, by the ground that both see
    ones = np.ones((len(places), 1))
    across, *_ = np.linalg.lstsq(np.hstack([before, ones]), own, rcond=None)
    moved = own + (after - before) @ across[:2]
    matrix, *_ = np.linalg.lstsq(np.hstack([own, ones]), moved, rcond=None)
    left = float(np.abs(np.hstack([own, ones]) @ matrix - moved).max())
    shift = np.median(moved - own, axis=0)
    if np.abs(own + shift - moved).max() < 0.02:
        return colour.shifted(float(shift[0]), float(shift[1])), 0.0
    low, high = places.min(axis=0), places.max(axis=0)
    domain = (low[0], low[1], high[0], high[1], low[2], high[2])
    result, misfit = colour.with_affine(matrix.T, domain)
    return result, max(left, misfit)


def add_colours(
    scene: Scene,
    pans: Sequence[SourceImage],
    colours: Sequence[SourceImage | None],
    cameras: Sequence[RPC],
) -> list[str]:
    """Write the multispectral pixels of the area with their cameras, as assets of the items; notes for the user.

    Args:
        scene: with its items.
        pans: source of every item.
        colours: its partner, or None.
        cameras: corrected ones of the whole panchromatic images.
    """
    grid, heights = scene.require_grid(), scene.require_height_range()
    west, south, east, north = grid.bounds
    x, y, z = (
        axis.ravel()
        for axis in np.meshgrid(
            np.linspace(west, east, GRID), np.linspace(south, north, GRID), np.linspace(*heights, 3), indexing="ij"
        )
    )
    lon, lat = to_geographic(grid.crs, x, y)
    places = np.stack([lon, lat, z], axis=1)
    notes = []
    for item, pan, colour, camera in zip(scene.items, pans, colours, cameras, strict=True):
        if colour is None:
            notes.append(f"{item.id}: no multispectral image is of its acquisition")
            continue
        rpc, misfit = corrected(colour.rpc, pan.rpc, camera, places)
        if misfit > 0.1:
            notes.append(f"{item.id}: the camera of its colours follows the correction to {misfit:.2f} px only")
        colour.window = crop_window(rpc, grid.crs, grid.bounds, heights, colour.size, MARGIN_PX)
        if min(colour.window[2:]) < 1:
            if item.role == "unused":  # beside the area
                continue
            raise InputError(f"{colour.path}: found nothing of the area, expected colours of {item.id}")
        own = rpc.cropped(colour.window[0], colour.window[1])
        with opened(colour.path) as data:
            look_for_frames(data, colour)
        notes += [f"{item.id}: its colours: {frame}" for frame in colour.frames]
        notes += beside(colour, rpc, pan, camera, float(np.mean(heights)))
        write_image(colour, own, scene.output(_image(item.id)))
        write_text(scene.output(_camera(item.id)), own.to_rpc_txt())
        item.assets["colours"] = Asset(
            _image(item.id), GEOTIFF_TYPE, ["data"], named_bands(colour.metadata.platform, colour.descriptions)
        )
        item.assets["colours_rpc"] = Asset(_camera(item.id), "text/plain", ["metadata"])
        item.properties["sattools:colour_bands"] = colour.bands
        where = colour.path if isinstance(colour.path, RemotePath) else colour.path.absolute()
        item.properties["sattools:colours_source"] = str(where)
    return notes


__all__ = ["add_colours", "colour_files", "corrected", "hrefs", "load_colours", "partners"]
