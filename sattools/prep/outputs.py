"""What `prep` writes: pixels with corrected cameras, and reports on the correction."""

from __future__ import annotations

import json
from collections.abc import Sequence
from typing import Any

import numpy as np

from sattools.camera.adjust import Adjustment
from sattools.errors import InputError
from sattools.prep.images import SourceImage, write_image
from sattools.prep.items import describe, tie_point_features
from sattools.prep.layout import crop_window
from sattools.progress import Progress
from sattools.scene import Scene
from sattools.scene.files import write_text

MARGIN_PX = 16  # around the area asked for, once the cameras are corrected
REPORTS = {
    "adjustment": "adjustment.json",
    "adjustment_report": "adjustment.txt",
    "tie_points": "tie_points.geojson",
}


def write_images(
    scene: Scene, sources: Sequence[SourceImage], result: Adjustment, crop: bool, progress: Progress
) -> None:
    """Write pixels and cameras, and add the items.

    Args:
        scene: with its grid and height range; gets the items.
        sources: the images.
        result: their corrected cameras.
        crop: to the scene's area.
        progress: told the share done.

    Raises:
        InputError: an image that shows nothing of the area.
    """
    grid, heights = scene.require_grid(), scene.require_height_range()
    full = [r.cropped(-s.window[0], -s.window[1]) for r, s in zip(result.rpcs, sources, strict=True)]
    for k, (source, rpc) in enumerate(zip(sources, full, strict=True)):
        progress(k / len(sources), f"writing {source.id}")
        if crop:
            source.window = crop_window(rpc, grid.crs, grid.bounds, heights, source.size, MARGIN_PX)
            if min(source.window[2:]) < 1:
                raise InputError(f"{source.path}: found nothing of the area once its camera was corrected")
        camera = rpc.cropped(source.window[0], source.window[1])
        write_image(source, camera, scene.output(f"images/{source.id}.tif"))
        write_text(scene.output(f"rpc/{source.id}_RPC.TXT"), camera.to_rpc_txt())
        scene.items.append(describe(source, camera, result.views[k], grid, heights))


def write_reports(scene: Scene, result: Adjustment) -> None:
    """Write what was done to the cameras, for programs and for people, and the tie points; adds the products."""
    write_text(scene.output(REPORTS["adjustment"]), json.dumps(_no_nan(result.to_dict()), indent=1) + "\n")
    write_text(scene.output(REPORTS["adjustment_report"]), result.to_text())
    write_text(scene.output(REPORTS["tie_points"]), tie_point_features(result))
    scene.products |= REPORTS


def _no_nan(value: Any) -> Any:
    if isinstance(value, dict):
        return {k: _no_nan(v) for k, v in value.items()}
    if isinstance(value, list):
        return [_no_nan(v) for v in value]
    return None if isinstance(value, float) and not np.isfinite(value) else value


__all__ = ["REPORTS", "write_images", "write_reports"]
