"""What `prep` writes: pixels with corrected cameras, and reports on the correction."""

from __future__ import annotations

import json
from collections.abc import Sequence
from typing import Any

import numpy as np

from sattools.camera.adjust import Adjustment
from sattools.camera.ground import crop_window
from sattools.prep.images import SourceImage, at_once
from sattools.prep.items import describe, tie_point_features
from sattools.prep.layout import with_surroundings
from sattools.prep.pairs import residual_vectors
from sattools.prep.pixels import write_image
from sattools.processors import side_by_side
from sattools.progress import Progress
from sattools.scene import Asset, Item, Scene
from sattools.scene.blocks import Blocks
from sattools.scene.document import GEOTIFF_TYPE
from sattools.scene.files import write_text
from sattools.scene.jsonio import JsonObject
from sattools.scene.location import RemotePath
from sattools.scene.pixels import BLOCKS, CLOUDS, WINDOW
from sattools.scene.sensor_files import write_sensor_image

COPY_LIMIT = 2 << 30  # bytes of pixels in all, above which images are referred to
MARGIN_PX = 16  # around the area asked for, once the cameras are corrected
REPORTS = {
    "adjustment": "adjustment.json",
    "adjustment_report": "adjustment.txt",
    "tie_points": "tie_points.geojson",
}


def write_images(
    scene: Scene,
    sources: Sequence[SourceImage],
    result: Adjustment,
    progress: Progress,
    *,
    crop: bool,
    copy: bool | None = None,
) -> None:
    """Write pixels, unless they stay where they are, and cameras, and add the items.

    Args:
        scene: with its grid and height range; gets the items.
        sources: the images.
        result: their corrected cameras.
        crop: to the scene's area and what stands around it.
        copy: the pixels, or refer to them; None = as many as `COPY_LIMIT`.
        progress: told the share done.
    """
    grid, heights = scene.require_grid(), scene.require_height_range()
    full = [r.cropped(-s.window[0], -s.window[1]) for r, s in zip(result.rpcs, sources, strict=True)]
    if crop:
        around = with_surroundings(grid.bounds)
        for source, rpc in zip(sources, full, strict=True):
            window = crop_window(rpc, grid.crs, around, heights, source.size, MARGIN_PX)
            if min(window[2:]) > 0:  # else it lies beside the area and is set aside as it is
                source.window = window
    if copy is None:
        copy = sum(_bytes(source) for source in sources) <= COPY_LIMIT
    cameras = [rpc.cropped(source.window[0], source.window[1]) for source, rpc in zip(sources, full, strict=True)]
    copied = [copy or isinstance(source.path, RemotePath) for source in sources]

    def write(k: int) -> None:
        if copied[k]:
            write_image(sources[k], cameras[k], scene.output(f"images/{sources[k].id}.tif"))

    for k, _ in enumerate(side_by_side(write, range(len(sources)), at_once(sources))):
        source, camera = sources[k], cameras[k]
        progress(k / len(sources), f"writing {source.id}")
        item = describe(source, camera, result.views[k], grid, heights)
        if not copied[k]:
            for frame in source.frames:
                source.warn(f"is not copied, so its frame of {frame.value:g} is ground later on: declare it as no data")
            if source.hot:
                source.warn("is not copied, so its hot pixels are brightness later on: declare them as no data")
            if source.clouds is not None:
                _write_clouds(scene, item, source.clouds)
            item.assets["image"].href = str(source.path.absolute())
            item.assets["image"].extra[WINDOW] = list(source.window)
        write_text(scene.output(f"rpc/{source.id}_RPC.TXT"), camera.to_rpc_txt())
        scene.items.append(item)


def _write_clouds(scene: Scene, item: Item, clouds: Blocks) -> None:
    """What clouds hide of an original, which nothing is written into."""
    href = clouds_href(item.id)
    write_sensor_image(scene.output(href), clouds.places[None].astype(np.uint8))
    asset = Asset(href, GEOTIFF_TYPE, ["metadata"], {BLOCKS: [*clouds.corner, clouds.step]})
    item.assets[CLOUDS] = asset


def clouds_href(name: str) -> str:
    """Where the mask of an image's clouds is.

    Args:
        name: id of the item.
    """
    return f"clouds/{name}.tif"


def _bytes(source: SourceImage) -> int:
    return source.window[2] * source.window[3] * source.bands * np.dtype(source.dtype).itemsize


def write_reports(scene: Scene, result: Adjustment, pairs: Sequence[JsonObject]) -> None:
    """Write what was done to the cameras, for programs and for people, and the tie points; adds the products.

    Args:
        scene: gets the products.
        result: of the adjustment.
        pairs: table of the pairs of images, see `sattools.prep.pairs`.
    """
    document = {**result.to_dict(), "pairs": list(pairs)}
    for view, rows in zip(document["views"], residual_vectors(result), strict=True):
        view["residuals"] = rows
    write_text(scene.output(REPORTS["adjustment"]), json.dumps(_no_nan(document), indent=1) + "\n")
    lines = [f"{'pair':49s} {'angle':>6s} {'points':>7s} {'med before':>10s} {'after':>6s}"]
    for row in pairs:
        first, second = row["images"]
        figures = f"{row['angle_deg']:6.1f} {row['tie_points']:7d} {row['before_px']:10.2f} {row['after_px']:6.2f}"
        lines.append(f"{first:24s} {second:24s} {figures}")
    write_text(scene.output(REPORTS["adjustment_report"]), result.to_text() + "\n" + "\n".join(lines) + "\n")
    write_text(scene.output(REPORTS["tie_points"]), tie_point_features(result))
    scene.products |= REPORTS


def _no_nan(value: Any) -> Any:
    if isinstance(value, dict):
        return {k: _no_nan(v) for k, v in value.items()}
    if isinstance(value, list):
        return [_no_nan(v) for v in value]
    return None if isinstance(value, float) and not np.isfinite(value) else value


__all__ = ["MARGIN_PX", "REPORTS", "clouds_href", "write_images", "write_reports"]
