"""The prior's files: maps on an image's own pixels, and the prior of a scene as it is read back."""

from __future__ import annotations

import math
from collections.abc import Mapping
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import numpy as np

from sattools.camera.rpc import RPC
from sattools.errors import InputError, SceneError
from sattools.prior.normals import normals
from sattools.prior.probability import (
    ERROR95_MEANING,
    ERROR_METHOD,
    MEANING,
    METHOD,
    STD_MEANING,
    height_doubt,
    margin,
)
from sattools.render.around import PRODUCT as AROUND
from sattools.scene import Grid, Scene
from sattools.scene.cog import CogWriter, cogs
from sattools.scene.files import remove, written
from sattools.scene.raster import read_raster
from sattools.scene.sensor_files import write_sensor_image
from sattools.scene.stored import pieces

DSM, CONFIDENCE, NORMALS = "prior/dsm.tif", "prior/confidence.tif", "prior/normals.tif"
PROBABILITY = "prior/probability.tif"
STD, ERROR95 = "prior/dsm_std.tif", "prior/dsm_error95.tif"
WATER = "prior/water.tif"
WATER_MEANING = "1 = water with waves, about which images do not agree, laid level with its shore; 0 = all other ground"
SURROUNDINGS = "prior/surroundings.tif"
RIM_M = 4.0  # of the area itself that is in that file, too: between cells there are no gaps
DATUM = {"VERTICAL_DATUM": "WGS84 ellipsoid"}
MAPS = {
    "dsm": DSM, "confidence": CONFIDENCE, "probability": PROBABILITY, "dsm_std": STD, "dsm_error95": ERROR95,
    "normals": NORMALS, "water": WATER,
}  # fmt: skip


def write_sensor_map(
    path: Path, array: np.ndarray, rpc: RPC, name: str, unit: str, tags: Mapping[str, str] | None = None
) -> None:
    """Write a map of an image's pixels as tiled GeoTIFF with the image's camera in its RPC tags.

    Args:
        path: file to write.
        array: ``[rows, columns]``.
        rpc: the camera.
        name: of the band.
        unit: of the values.
        tags: beside the software's.

    Raises:
        SattoolsError: the file cannot be written.
    """
    write_sensor_image(
        path, array[None].astype(np.float32), rpc.to_tags(), nodata=float("nan"), descriptions=[name], units=unit,
        tags={"SOFTWARE": "sattools", **(tags or {})},
    )  # fmt: skip


def _error(name: str, meaning: str) -> dict[str, Any]:
    """How a map of errors is described."""
    return {
        "units": "m",
        "tags": {"METHOD": ERROR_METHOD, "MEANING": meaning, "SOFTWARE": "sattools"},
        "descriptions": [name],
    }


class MapFiles:
    """The files of a scene's prior, written in strips; used by ``with``, at the end of which they are there.

    Args:
        scene: gets the products.
        grid: of the maps.
    """

    def __init__(self, scene: Scene, grid: Grid) -> None:
        about = {"SOFTWARE": "sattools"}
        datum = {**DATUM, **about}
        height: dict[str, Any] = {"units": "m", "tags": datum, "descriptions": ["height"]}
        trust: dict[str, Any] = {"units": "1", "tags": about, "descriptions": ["confidence"]}
        method = {"METHOD": METHOD, **about}
        probable: dict[str, Any] = {"units": "1", "tags": method, "descriptions": [f"probability of {MEANING}"]}
        names = ["normal east", "normal north", "normal up"]
        slant: dict[str, Any] = {"units": "1", "tags": about, "descriptions": names}
        self.scene, self.grid = scene, grid
        low, high = scene.require_height_range()
        self._span = high - low
        self._stack = ExitStack()
        self._files = [
            CogWriter(scene.output(DSM), grid, **height),
            CogWriter(scene.output(CONFIDENCE), grid, **trust),
            CogWriter(scene.output(PROBABILITY), grid, **probable),
            CogWriter(scene.output(STD), grid, **_error("standard deviation of the height", STD_MEANING)),
            CogWriter(
                scene.output(ERROR95), grid, **_error("95 % of the errors of the height are smaller", ERROR95_MEANING)
            ),
            CogWriter(scene.output(NORMALS), grid, bands=3, **slant),
            CogWriter(
                scene.output(WATER), grid, dtype=np.uint8, nodata=None, tags={"MEANING": WATER_MEANING, **about},
                descriptions=["laid level as water"],
            ),
        ]  # fmt: skip

    def __enter__(self) -> MapFiles:
        self._stack.enter_context(cogs(self._files))
        return self

    def around(self, rows: slice) -> slice:
        """Rows that `write` wants to see to write some: what follows from heights depends on those around."""
        beyond = max(1, margin(self.grid.cell_size))  # a row for the normals
        return slice(max(0, rows.start - beyond), min(self.grid.height, rows.stop + beyond))

    def write(self, height: np.ndarray, confidence: np.ndarray, rows: slice, water: np.ndarray | None = None) -> None:
        """Write some rows of height and confidence, and of what follows from them.

        Args:
            height: ``[h, W]`` [m], of the rows that `around` tells.
            confidence: ``[h, W]`` in [0, 1], of the same.
            rows: to write.
            water: ``[h, W]``, of the same, whether it was laid level as such; None = nowhere.
        """
        laid = np.zeros(height.shape, bool) if water is None else water
        cell, first = self.grid.cell_size, self.around(rows).start
        own = slice(rows.start - first, rows.stop - first)
        maps = height, confidence, *height_doubt(height, confidence, cell, self._span), normals(height, cell), laid
        for file, values in zip(self._files, maps, strict=True):
            file.write(values[..., own, :], rows)

    def __exit__(self, *error: Any) -> None:
        self._stack.__exit__(*error)
        self.scene.products.update({f"prior_{name}": href for name, href in MAPS.items()})


def write_surroundings(scene: Scene, height: np.ndarray, grid: Grid | None) -> None:
    """Write the heights around a scene's area, beyond whose border its images go on; nothing but a rim within.

    Args:
        scene: gets the product, or loses one of before where nothing is around.
        height: ``[H, W]`` [m], of the area, too.
        grid: of these; None = nothing is known around the area.
    """
    if grid is None:
        scene.products.pop(AROUND, None)
        remove(scene.output(SURROUNDINGS))
        return
    inside = grid.window(scene.require_grid())
    rim = max(1, math.ceil(RIM_M / grid.cell_size))
    deep = [range(part.start + rim, part.stop - rim) for part in inside]
    about: dict[str, Any] = {"units": "m", "tags": {**DATUM, "SOFTWARE": "sattools"}, "descriptions": ["height"]}
    with CogWriter(scene.output(SURROUNDINGS), grid, **about) as file:
        for rows in pieces(grid.shape):
            values = np.array(height[rows], np.float32)
            first, last = (min(max(row - rows.start, 0), len(values)) for row in (deep[0].start, deep[0].stop))
            values[first:last, deep[1].start : deep[1].stop] = np.nan
            file.write(values, rows)
    scene.products[AROUND] = SURROUNDINGS


def read_prior(scene: Scene, within: Grid | None = None) -> tuple[np.ndarray, np.ndarray, Grid]:
    """Height [m] and confidence ``[H, W]`` of the scene's prior, and their grid; ``within``: only this part.

    Raises:
        SceneError: one of them is missing.
        InputError: a file that cannot be read, or is none of a prior of this scene.
    """
    arrays, grids = [], []
    for name in ("prior_dsm", "prior_confidence"):
        if name not in scene.products:
            raise SceneError(f"scene {scene.id}: found no product {name!r}, expected one made by `sattools prior`")
        path = scene.path(scene.products[name])
        array, grid = read_raster(written(path), within)
        if array.shape[0] != 1:
            raise InputError(f"{path}: found {array.shape[0]} bands, expected one as {name} has")
        known = array[np.isfinite(array)]
        if not known.size:
            raise InputError(f"{path}: found no data, expected the {name} of this scene")
        if name == "prior_confidence":
            right, what = known.min() >= 0 and known.max() <= 1, "0 to 1"
        else:
            low, high = scene.require_height_range()
            span = high - low
            middle = float(np.median(known))
            right, what = low - span <= middle <= high + span, f"heights around {low:g} to {high:g} m"
        if not right:
            raise InputError(f"{path}: found numbers from {known.min():g} to {known.max():g}, expected {what}")
        arrays.append(array[0])
        grids.append(grid)
    if grids[0] != grids[1]:
        raise InputError(f"{path}: found another grid than that of prior_dsm, expected the same")
    return arrays[0], arrays[1], grids[0]


__all__ = [
    "CONFIDENCE", "DATUM", "DSM", "MAPS", "NORMALS", "PROBABILITY", "SURROUNDINGS", "WATER", "MapFiles", "read_prior",
    "write_sensor_map", "write_surroundings",
]  # fmt: skip
