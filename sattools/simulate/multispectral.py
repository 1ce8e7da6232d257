"""Two sensors on one satellite: a panchromatic one, and one of several bands with larger pixels."""

from __future__ import annotations

import numpy as np

from sattools.scene.document import Scene
from sattools.scene.files import write_text
from sattools.scene.sensor_files import write_sensor_image
from sattools.simulate.views import SimulatedView


def colour_files(name: str) -> tuple[str, str]:
    """Hrefs of the multispectral image of a view and of its true camera."""
    return f"colours/{name}_MS.tif", f"truth/rpc/{name}_MS_RPC.TXT"


def write_colours(
    scene: Scene, view: SimulatedView, image: np.ndarray, ratio: int, rng: np.random.Generator
) -> np.ndarray:
    """Write the multispectral image of a view, and its true camera; the panchromatic image ``[1, H, W]``.

    Its pixels are means of ratio x ratio of the panchromatic ones, from a first one that differs from view to view, so
    that no grid is common to both. Attitude errors of the satellite are in both cameras.

    Args:
        scene: gets the files.
        view: when and from where it was taken.
        image: ``[3, H, W]`` digital numbers with the panchromatic sensor's pixels.
        ratio: of the pixels' edges.
        rng: random numbers.
    """
    left, top = (int(v) for v in rng.integers(0, ratio, 2))
    rows, columns = (image.shape[1] - top) // ratio, (image.shape[2] - left) // ratio
    part = image[:, top : top + rows * ratio, left : left + columns * ratio].astype(np.float64)
    means = part.reshape(3, rows, ratio, columns, ratio).mean(axis=(2, 4))
    true = view.rpc.cropped(left, top).reduced(ratio)
    delivered = view.rpc.shifted(*view.bias).cropped(left, top).reduced(ratio)
    taken = {"TIFFTAG_DATETIME": view.time.strftime("%Y:%m:%d %H:%M:%S")}
    own = np.rint(means).astype(image.dtype)
    href, camera = colour_files(view.id)
    write_sensor_image(scene.output(href), own, delivered.to_tags(), tags=taken)
    write_text(scene.output(camera), true.to_rpc_txt())
    return np.asarray(np.rint(image.mean(axis=0, keepdims=True)).astype(image.dtype))


__all__ = ["colour_files", "write_colours"]
