"""The prior's matching against OpenCV's StereoSGBM and CNES pandora with libsgm, on rectified pairs, in one run.

    python benchmarks/stereo.py SCENE/scene.json --truth DIR [--region west]        (after `sattools prep`)
    python benchmarks/stereo.py SCENE/scene.json --dsm REFERENCE.tif [--packages FOLDER]

pandora is no part of sattools: `pip install --target FOLDER pandora[sgm]` and --packages FOLDER; without it its rows
are left out. Every method gets the same two images (the pairs that `sattools prior` likes best, or --pair), cameras,
height range, 3 x 3 median at the end, and filling of holes (nearest height), and is scored like `sattools compare`.
Over a tile, lines of sight are parallel, so a turned ground frame at one height is a rectification: what is left of a
pair's displacement runs along the rows. A last part fuses each method's pairs by their median, the usual way of
two-view pipelines to many views.
The other methods match at the scene's cell and at the images' own pixel; seconds are CPU seconds of matching, without
resampling.
"""

from __future__ import annotations

import argparse
import logging
import math
import os
import platform
import sys
import tempfile
import time
import warnings
from collections.abc import Callable
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np

from sattools.camera.ground import ground_sample_distance, middle_lon_lat, project
from sattools.compare import compare_dsm, read_reference
from sattools.compare.holes import fill_holes
from sattools.compare.truth import Truth, read_dfc2019
from sattools.prior import PriorOptions
from sattools.prior.matched import crop, make_frame
from sattools.prior.matching.match import match
from sattools.prior.matching.pairs import angle_deg, choose_pairs
from sattools.prior.tones import LINEAR_TONE, tone_of, toned, with_contrast
from sattools.scene import Grid, Scene
from sattools.views import Source, line_of_sight, load_sources, read_at

SPARE = 16  # pixels around what is looked at, for windows
MIN_WEIGHT = 0.25  # of the points around a cell, below which it is a hole
WINDOW = 5  # pixels, of both other methods


@dataclass(frozen=True)
class Rectified:
    """Two images on one turned ground frame.

    Attributes:
        images: ``[2, h, w]`` float32 grey; the first is the one seen more from above.
        masks: same shape, 1 = valid.
        origin: (east, north) of the first pixel's centre [m].
        u, v: (east, north) unit vectors along columns and rows; ``pixel``: their length [m].
        moves: ``[2, 2]`` (column, row) pixels by which a point moves in each image per metre of height.
        z_ref: height at which nothing moves [m].
        range: smallest and largest disparity, column of the first image minus column of the second.
    """

    images: np.ndarray
    masks: np.ndarray
    origin: np.ndarray
    u: np.ndarray
    v: np.ndarray
    pixel: float
    moves: np.ndarray
    z_ref: float
    range: tuple[int, int]

    @property
    def per_metre(self) -> float:
        """Disparity per metre of height."""
        return float(self.moves[0, 0] - self.moves[1, 0])

    def heights(self, disparity: np.ndarray, grid: Grid) -> np.ndarray:
        """Heights ``[H, W]`` on a grid from disparities ``[h, w]`` of the first image; NaN = none in either.

        Every point is shared among the four cells around it; a cell is their weighted mean.
        """
        rows, cols = np.nonzero(np.isfinite(disparity))
        dz = disparity[rows, cols] / self.per_metre
        across = (cols - self.moves[0, 0] * dz)[:, None] * self.u
        ground = self.origin + self.pixel * (across + (rows - self.moves[0, 1] * dz)[:, None] * self.v)
        col, row = (ground[:, 0] - grid.left) / grid.cell_size - 0.5, (grid.top - ground[:, 1]) / grid.cell_size - 0.5
        total, weight = np.zeros(grid.shape), np.zeros(grid.shape)
        c0, r0 = np.floor(col).astype(int), np.floor(row).astype(int)
        for r, wr in ((r0, r0 + 1 - row), (r0 + 1, row - r0)):
            for c, wc in ((c0, c0 + 1 - col), (c0 + 1, col - c0)):
                ok = (r >= 0) & (r < grid.height) & (c >= 0) & (c < grid.width)
                np.add.at(total, (r[ok], c[ok]), (wr * wc * (self.z_ref + dz))[ok])
                np.add.at(weight, (r[ok], c[ok]), (wr * wc)[ok])
        # points are sparser where pixels are larger than cells
        enough = MIN_WEIGHT * min(1.0, (grid.cell_size / self.pixel) ** 2)
        return np.where(weight >= enough, total / np.maximum(weight, 1e-9), np.nan).astype(np.float32)


def rectify(sources: list[Source], grid: Grid, z_range: tuple[float, float], pixel: float) -> Rectified:
    """Resample two images so that what height displaces between them runs along the rows."""
    z_ref = 0.5 * (z_range[0] + z_range[1])
    slopes = [line_of_sight(s.rpc, grid, z_ref, z_range)[0] for s in sources]
    order = sorted((0, 1), key=lambda k: math.hypot(*slopes[k]))
    # what stands higher is displaced away from the sensor
    first, second = (-np.array(slopes[k]) for k in order)
    u = (first - second) / np.linalg.norm(first - second)
    v = np.array([u[1], -u[0]])
    moves = np.array([[d @ u, d @ v] for d in (first, second)]) / pixel
    reach = 0.5 * (z_range[1] - z_range[0])
    limit = math.ceil(reach * float(moves[0, 0] - moves[1, 0])) + 1
    west, south, east, north = grid.bounds
    corners = np.array([(x, y) for x in (west, east) for y in (south, north)])
    along, down = corners @ u / pixel, corners @ v / pixel
    spare = np.abs(moves).max(axis=0) * reach + SPARE + np.array([limit, 0])
    c0, r0 = along.min() - spare[0], down.min() - spare[1]
    cols, rows = math.ceil(along.max() + spare[0] - c0), math.ceil(down.max() + spare[1] - r0)
    x, y = (pixel * ((c0 + np.arange(cols)) * u[k] + (r0 + np.arange(rows))[:, None] * v[k]) for k in (0, 1))
    images, masks = [], []
    for k in order:
        col, row = project(sources[k].rpc, grid.crs, x.ravel(), y.ravel(), np.full(x.size, z_ref))
        bands, mask = read_at(sources[k].radiance, col.reshape(x.shape), row.reshape(x.shape))
        one, shown = bands.mean(axis=-1)[None], mask[None]
        tone = LINEAR_TONE if sources[k].linear else tone_of(one, shown)
        images.append(with_contrast(toned(one, tone), shown)[0])
        masks.append(mask)
    origin = np.array([x[0, 0], y[0, 0]])
    return Rectified(np.stack(images), np.stack(masks), origin, u, v, pixel, moves, z_ref, (-limit, limit))


def eight_bits(pair: Rectified) -> list[np.ndarray]:
    """Both images as ``[h, w]`` uint8, each from its 1st to its 99th percentile."""
    result = []
    for image, mask in zip(pair.images, pair.masks, strict=True):
        low, high = np.percentile(image[mask > 0], [1, 99])
        result.append((np.clip((image - low) / (high - low), 0, 1) * 255).astype(np.uint8))
    return result


def opencv(pair: Rectified) -> tuple[np.ndarray, float]:
    """StereoSGBM over 8 paths: disparity ``[h, w]`` (NaN = none) and CPU seconds.

    P1, P2 = 8 and 32 times the window's pixels as its manual advises, uniqueness 5 %, left-right check of 1 pixel,
    specks of fewer than 100 pixels removed.
    """
    import cv2

    first, second = eight_bits(pair)
    low, high = pair.range
    count = -(-(high - low + 1) // 16) * 16
    start = time.process_time()
    matcher = cv2.StereoSGBM_create(  # type: ignore[attr-defined]
        minDisparity=low,
        numDisparities=count,
        blockSize=WINDOW,
        P1=8 * WINDOW**2,
        P2=32 * WINDOW**2,
        disp12MaxDiff=1,
        preFilterCap=63,
        uniquenessRatio=5,
        speckleWindowSize=100,
        speckleRange=2,
        mode=cv2.STEREO_SGBM_MODE_HH,
    )
    found = matcher.compute(first, second).astype(np.float32) / 16
    seconds = time.process_time() - start
    return np.where((found >= low) & (pair.masks[0] > 0), found, np.nan), seconds


PANDORA: dict[str, Any] = {
    "matching_cost": {"matching_cost_method": "census", "window_size": WINDOW, "subpix": 1},
    "optimization": {
        "optimization_method": "sgm",
        "overcounting": False,
        "penalty": {"penalty_method": "sgm_penalty", "P1": 4, "P2": 20},
    },
    "disparity": {"disparity_method": "wta", "invalid_disparity": "NaN"},
    "refinement": {"refinement_method": "vfit"},
    "filter": {"filter_method": "median", "filter_size": 3},
    "validation": {"validation_method": "cross_checking_accurate"},
}
"""Census of 5 x 5 pixels, P1 = 4 and P2 = 20 (the plugin's own for census), V-fit, median, left-right check."""


def pandora(pair: Rectified) -> tuple[np.ndarray, float]:
    """pandora with libsgm: disparity ``[h, w]`` (NaN = none) and CPU seconds."""
    import rasterio
    from pandora import import_plugin, run
    from pandora.check_configuration import check_conf
    from pandora.constants import Criteria
    from pandora.img_tools import create_dataset_from_inputs
    from pandora.state_machine import PandoraMachine

    logging.getLogger("transitions").setLevel(logging.ERROR)
    import_plugin()
    low, high = pair.range
    # its disparity is the column of the second image minus that of the first
    limits = {"left": [-high, -low], "right": [low, high]}
    with tempfile.TemporaryDirectory() as folder:
        inputs: dict[str, Any] = {}
        for side, image, mask in zip(("left", "right"), pair.images, pair.masks, strict=True):
            path = Path(folder) / f"{side}.tif"
            h, w = image.shape
            # it asks for no camera, but a raster without any georeference makes the reader warn
            turned = rasterio.Affine.scale(pair.pixel, -pair.pixel)
            profile = {"width": w, "height": h, "count": 1, "dtype": "float32", "transform": turned}
            with rasterio.open(path, "w", driver="GTiff", **profile) as data:
                data.write(np.where(mask > 0, 255 * image, np.float32(-9999)).astype(np.float32), 1)
            inputs[side] = {"img": str(path), "nodata": -9999, "disp": limits[side]}
        machine = PandoraMachine()
        settings = check_conf({"input": inputs, "pipeline": PANDORA}, machine)
        left, right = (create_dataset_from_inputs(input_config=settings["input"][side]) for side in ("left", "right"))
    start = time.process_time()
    found, _ = run(machine, left, right, settings)
    seconds = time.process_time() - start
    valid = (found["validity_mask"].data & int(Criteria.PANDORA_MSK_PIXEL_INVALID)) == 0
    return np.where(valid, -found["disparity_map"].data, np.nan).astype(np.float32), seconds


def smoothed(height: np.ndarray) -> np.ndarray:
    """Median of the known among 3 x 3 cells, holes kept: `sattools prior` ends with a median of this size."""
    from scipy.ndimage import median_filter

    return np.where(np.isfinite(height), median_filter(fill_holes(height), 3, mode="nearest"), np.nan)


def own(sources: list[Source], grid: Grid, z_range: tuple[float, float], pairs: int) -> tuple[np.ndarray, Any, float]:
    """`sattools prior` on these images: all heights, those with two consistent views (else NaN), CPU seconds."""
    options = PriorOptions(pairs=pairs)
    frame, views = make_frame(sources, grid, z_range, options.window)
    chosen = choose_pairs([v.slope for v in views], [v.sun for v in views], options.pairs)
    start = time.process_time()
    found = match(frame, chosen, z_range, options)
    seconds = time.process_time() - start
    height, seen = crop(found.height, grid.shape), crop(found.consistent_views, grid.shape) >= 2
    return height, np.where(seen, height, np.nan), seconds


def row(name: str, height: np.ndarray, grid: Grid, truth: Truth, seconds: float) -> dict[str, Any]:
    """One line of the table; `height` with its holes."""
    f = compare_dsm(height, truth, grid).figures
    filled = compare_dsm(fill_holes(height), truth, grid).figures
    kept = ("mae", "median", "completeness")
    return {"name": name, **{k: f[k] for k in kept}, "filled": filled["mae"], "half": filled["median"], "s": seconds}


def methods(pixels: list[float]) -> dict[str, tuple[Callable[[Rectified], tuple[np.ndarray, float]], float]]:
    """Other methods by name, each with the pixel it matches at."""
    known: dict[str, Callable[[Rectified], tuple[np.ndarray, float]]] = {"StereoSGBM": opencv}
    missing = [name for name in ("pandora", "pandora_plugin_libsgm", "libsgm_c") if find_spec(name) is None]
    if missing:
        print(f"pandora with libsgm left out: no package {', '.join(missing)}", file=sys.stderr)
    else:
        known["pandora"] = pandora
    return {f"{name}, {pixel:.2f} m": (call, pixel) for name, call in known.items() for pixel in pixels}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("scene", type=Path, help="scene.json, after `sattools prep`")
    parser.add_argument("--truth", help="folder of the 2019 contest's reference files")
    parser.add_argument("--dsm", type=Path, help="any reference DSM")
    parser.add_argument("--classes", type=Path, help="class map of --dsm")
    parser.add_argument("--region", help="west, east, north, south or W,S,E,N")
    parser.add_argument("--pair", nargs=2, action="append", metavar="ID", help="a pair; repeatable (default: --best)")
    parser.add_argument("--best", type=int, default=3, help="number of pairs, those that `prior` likes best")
    parser.add_argument("--packages", help="folder with pandora, looked in last")
    arguments = parser.parse_args()
    if bool(arguments.truth) == bool(arguments.dsm):
        parser.error("give either --truth or --dsm")
    if arguments.packages:
        sys.path.append(arguments.packages)
    scene = Scene.from_file(arguments.scene)
    truth = (
        read_reference(arguments.dsm, arguments.classes) if arguments.dsm else read_dfc2019(arguments.truth, scene.id)
    )
    if arguments.region:
        truth = truth.within(arguments.region)
    grid, z_range = scene.require_grid(), scene.require_height_range()
    sources = load_sources(scene, scene.train_items())
    by_id = {s.id: s for s in sources}
    views = make_frame(sources, grid, z_range, 1)[1]
    slopes = [v.slope for v in views]
    chosen = choose_pairs(slopes, [v.sun for v in views], arguments.best)[: arguments.best]
    pairs = arguments.pair or [[sources[a].id, sources[b].id] for a, b in chosen]
    lon, lat = middle_lon_lat(grid)
    native = min(ground_sample_distance(s.rpc, lon, lat, z_range[0]) for s in sources)
    others = methods([grid.cell_size, native])

    machine = f"{platform.processor() or platform.machine()}, {os.cpu_count()} cores"
    print(f"{machine}; {scene.id}, cells of {grid.cell_size:g} m")
    own([by_id[i] for i in pairs[0]], grid, z_range, 1)  # compiles
    table: dict[str, list[dict[str, Any]]] = {}
    maps: dict[str, list[np.ndarray]] = {}

    def note(name: str, height: np.ndarray, seconds: float) -> None:
        maps.setdefault(name, []).append(height)
        table.setdefault(name, []).append(row(name, height, grid, truth, seconds))
        show(table[name][-1])

    for names in pairs:
        both = [by_id[i] for i in names]
        angle = angle_deg(*((*slopes[sources.index(s)], 1.0) for s in both))
        print(f"{' + '.join(names)}: {angle:.0f} degrees")
        whole, seen, seconds = own(both, grid, z_range, 1)
        note("sattools prior", seen, seconds)
        note("sattools prior, own heights in holes", whole, seconds)
        for name, (call, pixel) in others.items():
            rectified = rectify(both, grid, z_range, pixel)
            disparity, seconds = call(rectified)
            note(name, smoothed(rectified.heights(disparity, grid)), seconds)
    print(f"means over {len(pairs)} pairs")
    for name, entries in table.items():
        show({"name": name, **{k: float(np.mean([e[k] for e in entries])) for k in entries[0] if k != "name"}})
    print(f"median of the heights of {len(pairs)} pairs; all pairs' seconds")
    for name, heights in maps.items():
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", RuntimeWarning)  # a cell that no pair found stays a hole
            fused = np.nanmedian(np.stack(heights), axis=0)
        show(row(name, fused, grid, truth, sum(e["s"] for e in table[name])))
    print("all pairs matched at once")
    whole, seen, seconds = own(sources, grid, z_range, PriorOptions.pairs)
    show(row(f"sattools prior, all {len(sources)} views", whole, grid, truth, seconds))


def show(entry: dict[str, Any]) -> None:
    print(
        f"  {entry['name']:38} where found: MAE {entry['mae']:5.2f} m  median {entry['median']:5.2f} m  "
        f"{100 * entry['completeness']:5.1f} %   holes filled: MAE {entry['filled']:5.2f} m  median "
        f"{entry['half']:5.2f} m   {entry['s']:6.1f} s"
    )


if __name__ == "__main__":
    main()
