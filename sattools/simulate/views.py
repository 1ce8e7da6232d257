"""The images of a simulated scene: what is to be taken, and the files of one."""

from __future__ import annotations

import contextvars
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from datetime import datetime

import numpy as np

from sattools.camera.rpc import RPC
from sattools.processors import threads
from sattools.progress import Progress
from sattools.scene.document import GEOTIFF_TYPE, Asset, Item, Scene
from sattools.scene.files import write_text
from sattools.scene.globe import outline_on_globe
from sattools.scene.jsonio import JsonObject
from sattools.scene.sensor_files import write_sensor_image
from sattools.simulate.camera import Pushbroom
from sattools.simulate.files import sat_nerf_metadata, write_json
from sattools.simulate.sensor import Radiometry

BORDER_PX = 8


@dataclass(frozen=True)
class SimulatedView:
    """One image to be taken.

    Attributes:
        id: name; time: UTC; bits: of 16-bit numbers; sun, sensor: (azimuth from true north, elevation) in degrees.
        camera: exact; rpc: fitted to it; rpc_error_px: largest error of the fit.
        shape: (rows, columns); radiometry: of its date; bias: (columns, rows) error of the delivered RPC.
    """

    id: str
    time: datetime
    sun: tuple[float, float]
    sensor: tuple[float, float]
    camera: Pushbroom
    rpc: RPC
    rpc_error_px: float
    shape: tuple[int, int]
    radiometry: Radiometry
    bias: tuple[float, float]
    role: str
    bits: int = 11


def take_all(
    scene: Scene,
    views: Sequence[SimulatedView],
    seed: np.random.SeedSequence,
    take: Callable[[int, SimulatedView, np.random.SeedSequence], Item],
    progress: Progress,
) -> None:
    """Append the item of every view to the scene; ``take`` gets its number, the view and a seed for its noise.

    Args:
        scene: gets the items.
        views: the views.
        seed: of all noise.
        take: see above.
        progress: told the share done and what is being done.
    """
    with ThreadPoolExecutor(max_workers=min(len(views), threads())) as pool:
        # files that are held back until the scene is whole are so in every thread
        jobs = [
            pool.submit(contextvars.copy_context().run, take, number, view, own)
            for number, (view, own) in enumerate(zip(views, seed.spawn(len(views)), strict=True))
        ]
        for number, job in enumerate(jobs, 1):
            scene.items.append(job.result())
            progress(0.1 + 0.9 * number / len(views), f"view {number} of {len(views)}")


def framed(camera: Pushbroom, corners: np.ndarray) -> tuple[Pushbroom, tuple[int, int]]:
    """The camera with its first pixel moved so that the image just holds the corners [N, 3], and the image's shape."""
    from dataclasses import replace

    col, row = camera.project(corners)
    left, top = np.floor(col.min()) - BORDER_PX, np.floor(row.min()) - BORDER_PX
    shape = int(np.ceil(row.max()) - top) + BORDER_PX, int(np.ceil(col.max()) - left) + BORDER_PX
    return replace(camera, col0=camera.col0 - left, row0=camera.row0 - top), shape


@dataclass(frozen=True)
class Rendered:
    """What was seen of the world in one view.

    Attributes:
        image: ``[B, H, W]`` digital numbers.
        lit: ``[H, W]`` share of sunlit ground in a pixel.
        height: ``[H, W]`` height that the pixel's middle shows [m].
    """

    image: np.ndarray
    lit: np.ndarray
    height: np.ndarray


def view_files(name: str) -> dict[str, str]:
    """Hrefs of the files of a view, by its assets."""
    return {
        "image": f"images/{name}.tif",
        "rpc": f"rpc/{name}_RPC.TXT",
        "metadata": f"metadata/{name}.json",
        "truth_lit": f"truth/views/{name}_LIT.tif",
        "truth_height": f"truth/views/{name}_HEIGHT.tif",
    }


def write_view(scene: Scene, view: SimulatedView, rendered: Rendered, sun: np.ndarray, gsd: float) -> Item:
    """Write the files of one view.

    Args:
        scene: gets the files.
        view: when and from where it was taken.
        rendered: what it shows.
        sun: unit vector (east, north, up) to the sun.
        gsd: edge of a pixel [m].

    Returns:
        The view's item.
    """
    delivered = view.rpc.shifted(*view.bias)
    files = view_files(view.id)
    taken = {"TIFFTAG_DATETIME": view.time.strftime("%Y:%m:%d %H:%M:%S")}
    write_sensor_image(scene.output(files["image"]), rendered.image, delivered.to_tags(), tags=taken)
    write_text(scene.output(files["rpc"]), view.rpc.to_rpc_txt())
    corners = _footprint(view, float(np.median(rendered.height)))
    metadata = sat_nerf_metadata(
        f"{view.id}.tif", delivered, view.shape, view.sun, view.time.strftime("%Y%m%d%H%M%S"), corners
    )
    write_json(scene.output(files["metadata"]), metadata)
    write_sensor_image(scene.output(files["truth_lit"]), rendered.lit[None].astype(np.float32))
    write_sensor_image(scene.output(files["truth_height"]), rendered.height[None])
    assets = {
        "image": Asset(files["image"], GEOTIFF_TYPE, ["data"]),
        "rpc": Asset(files["rpc"], "text/plain", ["metadata"]),
        "metadata": Asset(files["metadata"], "application/json", ["metadata"]),
        "truth_lit": Asset(files["truth_lit"], GEOTIFF_TYPE, ["truth"]),
        "truth_height": Asset(files["truth_height"], GEOTIFF_TYPE, ["truth"]),
    }
    geometry, box = outline_on_globe([*corners, corners[0]])
    return Item(view.id, geometry, box, _properties(scene, view, rendered.image, sun, gsd), assets)


def _properties(scene: Scene, view: SimulatedView, image: np.ndarray, sun: np.ndarray, gsd: float) -> JsonObject:
    """STAC properties of a view."""
    assert scene.grid is not None  # set before the views are taken
    return {
        "datetime": view.time.strftime("%Y-%m-%dT%H:%M:%SZ"),
        "platform": "simulated",
        "gsd": gsd,
        "proj:code": None,
        "proj:shape": list(view.shape),
        "view:sun_azimuth": round(view.sun[0], 4),
        "view:sun_elevation": round(view.sun[1], 4),
        "view:azimuth": round(view.sensor[0], 4),
        "view:off_nadir": round(90 - view.sensor[1], 4),
        "view:incidence_angle": round(90 - view.sensor[1], 4),  # the made-up Earth is flat: both are one
        "sattools:view_direction": (-view.camera.look).round(8).tolist(),
        "sattools:sun": "time and place",
        "sattools:sun_direction": sun.round(8).tolist(),
        "sattools:bits": 8 if image.dtype == np.uint8 else view.bits,
        "sattools:dtype": str(image.dtype),
        "sattools:bands": len(image),
        "sattools:value_range": [float(image.min()), float(image.max())],
        "sattools:role": view.role,
        "sattools:simulated": {
            "gain": view.radiometry.gain.round(6).tolist(),
            "haze": view.radiometry.haze.round(6).tolist(),
            "rpc_bias_px": [round(v, 6) for v in view.bias],
            "rpc_fit_error_px": view.rpc_error_px,
        },
    }


def _footprint(view: SimulatedView, height: float) -> list[list[float]]:
    """[lon, lat] of the image's corners at a height, anticlockwise as GeoJSON wants it."""
    rows, columns = view.shape
    col = np.array([-0.5, -0.5, columns - 0.5, columns - 0.5])
    row = np.array([-0.5, rows - 0.5, rows - 0.5, -0.5])
    lon, lat = view.rpc.localization(col, row, height)
    return [[float(a), float(b)] for a, b in zip(lon, lat, strict=True)]


__all__ = ["BORDER_PX", "Rendered", "SimulatedView", "framed", "take_all", "view_files", "write_view"]
