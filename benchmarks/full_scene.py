"""Whole satellite images through the suite: does it finish, in which memory, and how good is what comes out?

    python benchmarks/full_scene.py --size 20000 --views 3 --out FOLDER [--memory-gb 4] [--keep]
    python benchmarks/full_scene.py --size 10000 --city --pipe --out FOLDER [--tile 448] [--threads 2] [--keep]

Makes images of SIZE x SIZE pixels of 0.5 m, seen by RPC cameras of known error (up to 12 pixels), strip by strip,
without ever holding one in memory: an endless random texture warped over rolling ground of 60 m, or with --city houses
on that ground, traced ray by ray (`large_world.py`). 8-bit pixels, about SIZE^2 bytes an image. Then `prep`, and with
--pipe `fit | export | compare` as well, each in a process of its own.

Printed: seconds, CPU seconds and peak memory of every command; what is left of the cameras' errors (the part that tie
points can see, in pixels at the image's corners and centre); with --pipe CPU seconds per km2, the error of the DSM on
five squares of 256 m against the truth, the same squares prepared and fitted alone at the heights of the whole
(--alone), and whether the joined surface steps where tiles meet: the step of the error across the lines where tiles
were joined, as a share of that across lines of the same houses, against the 95th percentile of this share on all other
lines. The exit status is 1 where the memory was exceeded or a camera is off by more than half a pixel.
"""

from __future__ import annotations

import argparse
import json
import math
import shutil
import sys
import time
from pathlib import Path

import cv2
import numpy as np
import rasterio
from large_world import DATE, PERIOD_M, SUN, City, look, rolling
from launched import Outcome, command
from rasterio.windows import Window

from sattools.camera import RPC
from sattools.camera.ground import to_geographic
from sattools.fit.options import FitOptions
from sattools.fit.tiles.plan import Plan
from sattools.scene import Grid, Scene
from sattools.scene.raster import raster_grid, write_cog
from sattools.scene.tiles import Tile
from sattools.simulate.files import sat_nerf_metadata

GSD_M = 0.5
LON, LAT, ALT = 15.0, 46.0, 300.0
RUNS = [
    (0.25, 0.05),
    (-0.2, 0.15),
    (0.02, -0.22),
    (0.1, 0.3),
    (-0.3, -0.1),
    (0.33, -0.2),
]  # horizontal metres per metre of height
BIAS_PX = [(0.0, 0.0), (9.0, -7.0), (-6.0, 10.0), (4.0, 4.0), (-8.0, -3.0), (5.0, 7.0)]
PERIODS = (2048, 1789)  # cells of two textures, which together do not repeat within a scene


def metres_per_degree() -> tuple[float, float]:
    """(east, north) at the middle of the scene [m]."""
    e2 = 6.69437999014e-3
    w2 = 1 - e2 * math.sin(math.radians(LAT)) ** 2
    east = math.radians(6378137.0 / math.sqrt(w2) * math.cos(math.radians(LAT)))
    return east, math.radians(6378137.0 * (1 - e2) / w2**1.5)


def camera(run: tuple[float, float], size: int, bias: tuple[float, float]) -> RPC:
    """Parallel lines of sight over a plane ground: col and row are linear in longitude, latitude and height."""
    east, north = metres_per_degree()
    scale, degrees, metres = size / 2, size * GSD_M / 2 / north, 300.0
    col, row, one = np.zeros(20), np.zeros(20), np.zeros(20)
    one[0] = 1.0
    col[1], col[3] = degrees * east / GSD_M / scale, -run[0] * metres / GSD_M / scale
    row[2], row[3] = -degrees * north / GSD_M / scale, run[1] * metres / GSD_M / scale
    middle = (size - 1) / 2
    return RPC(
        middle + bias[1], middle + bias[0], LAT, LON, ALT, scale, scale, degrees, degrees, metres, row, one, col, one
    )


def textures() -> list[np.ndarray]:
    """Two square pieces of random ground that continue themselves, cells of 0.5 m."""
    rng = np.random.default_rng(0)
    pieces = []
    for period in PERIODS:
        noise = sum(
            cv2.GaussianBlur(np.tile(rng.normal(size=(period, period)).astype(np.float32), (2, 2)), (0, 0), s)[
                period // 2 : period // 2 + period, period // 2 : period // 2 + period
            ]
            * s
            for s in (1.5, 4.0, 12.0)
        )
        pieces.append(np.asarray(noise, np.float32))
    return pieces


def write_image(
    path: Path, run: tuple[float, float], rpc: RPC, size: int, pieces: list[np.ndarray], city: City | None
) -> None:
    """An image of the ground, strip by strip."""
    profile = {"driver": "GTiff", "width": size, "height": size, "count": 1, "dtype": "uint8", "tiled": True}
    rng = np.random.default_rng(round(1000 * (run[0] + 10 * run[1])) % 2**32)
    rows_at_once = 512
    with rasterio.open(path, "w", blockxsize=512, blockysize=512, bigtiff="if_safer", **profile) as out:
        cols = (np.arange(size, dtype=np.float64) - (size - 1) / 2) * GSD_M
        for first in range(0, size, rows_at_once):
            count = min(rows_at_once, size - first)
            rows = -(np.arange(first, first + count, dtype=np.float64) - (size - 1) / 2) * GSD_M
            if city is None:
                seen, east, north = None, *on_ground(run, cols, rows)
            else:
                limits = (city.low, city.top)
                seen, east, north = look(city.height, city.bright, city.wall, limits, np.array(run), cols, rows)
            texture = sampled(pieces, east / GSD_M, north / GSD_M)
            if seen is None:
                grey = 120 + 18 * texture
            else:  # stains of a few metres on everything, and the sensor's noise
                grey = 400 * seen * (1 + 0.05 * texture) + 10 + rng.normal(0, 1.0, seen.shape)
            out.write(np.clip(grey, 1, 254).astype(np.uint8), 1, window=Window(0, first, size, count))
        out.update_tags(ns="RPC", **rpc.to_tags())


def write_sun(path: Path, rpc: RPC, size: int) -> None:
    """The metadata that tell where the sun stood."""
    corners = [[float(v) for v in rpc.localization(c, r, ALT)] for c, r in ((0, 0), (size, 0), (size, size), (0, size))]
    record = sat_nerf_metadata(path.name, rpc, (size, size), SUN, DATE, [*corners, corners[0]])
    path.with_suffix(".json").write_text(json.dumps(record), encoding="utf-8")


def on_ground(run: tuple[float, float], cols: np.ndarray, rows: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Where rays meet the rolling ground (east, north) [m]."""
    east0, north0 = np.meshgrid(cols, rows)
    h = rolling(east0, north0)
    for _ in range(4):
        h = rolling(east0 + run[0] * h, north0 + run[1] * h)
    return east0 + run[0] * h, north0 + run[1] * h


def sampled(pieces: list[np.ndarray], east: np.ndarray, north: np.ndarray) -> np.ndarray:
    """Sum of the textures at places in cells."""
    total = np.zeros(east.shape, np.float32)
    for piece in pieces:
        period = len(piece)
        wrapped = np.pad(piece, 1, mode="wrap")
        at_col, at_row = (np.mod(v, period).astype(np.float32) + 1 for v in (east, -north))
        for c in range(0, east.shape[1], 16384):  # OpenCV's limit for the size of a map is 32767
            part = slice(c, min(east.shape[1], c + 16384))
            total[:, part] += cv2.remap(wrapped, at_col[:, part], at_row[:, part], cv2.INTER_LINEAR)
    return total


def errors_px(scene: dict, true: list[RPC], root: Path, size: int) -> list[float]:
    """What is left of each camera's error, less a common shift and a common height, at five pixels [px]."""
    low, high = scene["sattools"]["height_range_m"]
    middle = (low + high) / 2
    places = [(0, 0), (size - 1, 0), (0, size - 1), (size - 1, size - 1), (size / 2, size / 2)]
    rows: list[list[np.ndarray]] = []
    for feature, rpc in zip(scene["features"], true, strict=True):
        found = RPC.from_file(root / feature["assets"]["rpc"]["href"])
        rows.append([np.subtract(found.projection(*rpc.localization(c, r, middle), middle), (c, r)) for c, r in places])
    left = np.array(rows)  # [V, 5, 2]
    design = np.zeros((*left.shape, 3))
    design[..., 0, 0] = design[..., 1, 1] = 1.0
    for k in range(len(true)):
        design[k, :, :, 2] = np.array([-RUNS[k][0], RUNS[k][1]]) / GSD_M
    flat, target = design.reshape(-1, 3), left.ravel()
    rest = (target - flat @ np.linalg.lstsq(flat, target, rcond=None)[0]).reshape(left.shape)
    return [round(float(np.hypot(*view.T).max()), 3) for view in rest]


def local(grid: Grid) -> tuple[np.ndarray, np.ndarray]:
    """Local coordinates (east, north) ``[H, W]`` [m] of a grid's cells, as the cameras have them."""
    x, y = np.meshgrid(grid.x(), grid.y())
    lon, lat = to_geographic(grid.crs, x, y)
    east, north = metres_per_degree()
    return (lon - LON) * east, (lat - LAT) * north


def squares(scene: dict, edge: float, place: Path, city: City) -> list[tuple[Grid, Path]]:
    """The truth on five squares of the scene: near its middle and its corners."""
    whole = Grid.from_dict(scene["sattools"]["grid"])
    cell, count = 0.5, round(edge / 0.5)
    west, south, east, north = whole.bounds
    found = []
    for k, (a, b) in enumerate([(0.5, 0.5), (0.2, 0.2), (0.8, 0.2), (0.2, 0.8), (0.8, 0.8)]):
        left = round(west + a * (east - west) - edge / 2)
        top = round(south + b * (north - south) + edge / 2)
        grid = Grid(whole.crs, float(left), float(top), cell, count, count)
        path = place / f"truth_{k}.tif"
        write_cog(path, (ALT + city.above(*local(grid))).astype(np.float32), grid, units="m")
        found.append((grid, path))
    return found


def steps(dsm: Path, city: City, shift: tuple[float, float]) -> tuple[np.ndarray, np.ndarray]:
    """Mean step of the error from each row, and each column, to the next one [m], each cell's at most 2 m.

    NaN where less than half of a line is known: at the rim that the images do not show.
    """
    grid = raster_grid(dsm)
    down, along, counts = np.full(grid.height - 1, np.nan), np.zeros(grid.width - 1), np.zeros(grid.width - 1)
    with rasterio.open(dsm) as data:
        for first in range(0, grid.height - 1, 512):
            part = slice(first, min(first + 513, grid.height)), slice(0, grid.width)
            heights = data.read(1, window=Window.from_slices(*part))
            east, north = local(grid.part(*part))
            error = heights - ALT - city.above(east + shift[0], north + shift[1])
            rows, cols = (np.minimum(np.abs(np.diff(error, axis=axis)), 2.0) for axis in (0, 1))
            known = np.isfinite(rows).sum(axis=1)
            mean = np.nansum(rows, axis=1) / np.maximum(known, 1)
            down[part[0].start : part[0].stop - 1] = np.where(2 * known > grid.width, mean, np.nan)
            cols = cols[:512]  # the last row comes again
            along += np.nansum(cols, axis=0)
            counts += np.isfinite(cols).sum(axis=0)
    return down, np.where(2 * counts > grid.height, along / np.maximum(counts, 1), np.nan)


def seams(dsm: Path, lines: tuple[set[int], set[int]], city: City, shift: tuple[float, float]) -> dict[str, float]:
    """Steps of the error across lines where tiles meet, against those across all other lines.

    Errors follow walls, so each step is told as a share of the median step across lines of the same houses: the city
    repeats itself every 512 m, tiles do not, and what a line crosses is crossed again some periods further on, where no
    tiles meet. Other lines are treated alike; beyond the 95th percentile of theirs is by chance one joint of twenty.
    """
    joint, other, metres = [], [], []
    period = round(PERIOD_M / raster_grid(dsm).cell_size)
    for own, between in zip(lines, steps(dsm, city, shift), strict=True):
        # largest of the steps at a line and its neighbours; line k lies between cells k - 1 and k
        largest = np.full(len(between) + 2, np.nan)
        largest[2:-2] = np.max([between[k : len(between) - 2 + k] for k in range(3)], axis=0)
        apart = np.array([min(abs(k - q) for q in own) > 8 for k in range(len(largest))])
        alone = np.where(apart, largest, np.nan)
        for line in range(9, len(largest) - 9):
            same = alone[line % period :: period].copy()
            same[line // period] = np.nan
            if np.isfinite(largest[line]) and np.isfinite(same).any() and (apart[line] or line in own):
                ratio = float(largest[line] / np.nanmedian(same))
                if line in own:
                    joint.append(ratio)
                    metres.append(float(largest[line]))
                else:
                    other.append(ratio)
    if not joint:  # the area is too small for a second row of the same houses
        return {"joints": 0}
    limit = float(np.percentile(other, 95))
    return {
        "joints": len(joint),
        "median_step_m": float(np.median(metres)),
        "median_ratio": float(np.median(joint)),
        "worst_ratio": max(joint),
        "elsewhere_95th_percentile": limit,
        "lines_elsewhere": len(other),
        "joints_above": sum(ratio > limit for ratio in joint),
        "by_chance": 0.05 * len(joint),
    }


def joints(tiles: list[Tile], cell: float) -> tuple[set[int], set[int]]:
    """Rows and columns of the surface, of that cell [m], at the middle of what two tiles share."""
    rows: set[int] = set()
    cols: set[int] = set()
    for one in tiles:
        ratio = one.grid.cell_size / cell
        for lines, part, after in ((rows, one.rows, one.shared[1]), (cols, one.cols, one.shared[3])):
            if after:
                lines.add(round((part.stop - after / 2) * ratio))
    return rows, cols


def fitted_alone(
    square: Grid, truth: Path, files: list[Path], heights: tuple[float, float], options: argparse.Namespace
) -> float:
    """MAE [m] of a square with the margin of a tile, prepared and fitted by itself at the same heights.

    Another range of heights begins with another plane, by which the error of a square changes as much as 0.03 m.
    """
    common = ["--threads", str(options.threads), "--quiet"]
    west, south, east, north = square.bounds
    m = options.overlap
    bounds = [str(v) for v in (west - m, south - m, east + m, north + m)]
    place = options.out / "alone"
    shutil.rmtree(place, ignore_errors=True)
    cells = ["--cell-size", str(options.cell_size)] if options.cell_size else []
    where = ["--crs", square.crs, "--bounds", *bounds, "--out", str(place)]
    limits = ["--min-height", str(heights[0]), "--max-height", str(heights[1])]
    done = command("prep", *map(str, files), *where, *limits, *cells, *common)
    for step in (["fit"], ["export"], ["compare", "--dsm", str(truth)]):
        if done.status:
            return math.nan
        done = command(*step, *common, given=done.output)
    return float(json.loads(next(place.rglob("errors.json")).read_text())["mae"])


def pipe(prepared: Outcome, files: list[Path], options: argparse.Namespace, city: City) -> float:
    """`fit | export | compare` of what `prep` has printed; the most memory that a command took [GiB]."""
    common = ["--threads", str(options.threads), "--quiet"]
    fitted = command(
        "fit", "--tile", str(options.tile), "--overlap", str(options.overlap), *common, given=prepared.output
    )
    exported = command("export", *common, given=fitted.output) if fitted.status == 0 else fitted
    if exported.status:
        raise SystemExit(1)
    document = json.loads(exported.output)
    grid = Grid.from_dict(document["sattools"]["grid"])
    area = grid.width * grid.height * grid.cell_size**2 / 1e6
    steps = (prepared, fitted, exported)
    each = " + ".join(f"{step.cpu_s / area:.1f}" for step in steps)
    spent = sum(step.cpu_s for step in steps) / area
    print(f"{area:.2f} km2, cells of {grid.cell_size} m: {spent:.0f} CPU s a km2 ({each})", flush=True)
    peak = max(fitted.peak_gb, exported.peak_gb)
    root = Path(document["sattools"]["root"])
    shift, differences = (0.0, 0.0), []
    low, high = document["sattools"]["height_range_m"]
    for own, truth in squares(document, 256.0, options.out, city):
        compared = command("compare", "--dsm", str(truth), "--overwrite", *common, given=exported.output)
        peak = max(peak, compared.peak_gb)
        figures = json.loads((root / "compare/errors.json").read_text())
        shift = (figures["shift_m"][0], figures["shift_m"][1])
        alone = ""
        if options.alone:
            mae = fitted_alone(own, truth, files, (low, high), options)
            differences.append(figures["mae"] - mae)
            alone = f"; fitted alone {mae:.3f} m"
        print(f"{truth.name}: MAE {figures['mae']:.3f} m, median {figures['median']:.3f} m{alone}", flush=True)
    if differences:
        print(f"in tiles less alone: {np.mean(differences):+.3f} m on average", flush=True)
    dsm = root / document["sattools"]["products"]["dsm"]
    plan = Plan.make(Scene.from_file(root / "scene.json"), FitOptions(tile=options.tile, overlap=options.overlap))
    print("seams:", seams(dsm, joints(plan.tiles, raster_grid(dsm).cell_size), city, shift))
    return peak


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--size", type=int, default=20000)
    parser.add_argument("--views", type=int, default=3)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--memory-gb", type=float, default=4.0)
    parser.add_argument("--city", action="store_true", help="houses on the ground")
    parser.add_argument("--pipe", action="store_true", help="fit, export and compare as well")
    parser.add_argument("--tile", type=float, default=448.0, help="of the fit [m]; the city repeats itself every 512 m")
    parser.add_argument("--overlap", type=float, default=32.0, help="of tiles [m]")
    parser.add_argument("--cell-size", type=float, help="of the grid [m] (default: as prep chooses)")
    parser.add_argument("--alone", action="store_true", help="fit the squares alone, too")
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--keep", action="store_true")
    options = parser.parse_args()

    options.out.mkdir(parents=True, exist_ok=True)
    city = City(7) if options.city or options.pipe else None
    true = [camera(RUNS[k], options.size, (0.0, 0.0)) for k in range(options.views)]
    files = [options.out / f"full_{k}.tif" for k in range(options.views)]
    pieces = textures()
    begun = time.perf_counter()
    for k, file in enumerate(files):
        if not file.exists():
            rpc = camera(RUNS[k], options.size, BIAS_PX[k])
            write_image(file, RUNS[k], rpc, options.size, pieces, city)
            if city is not None:
                write_sun(file, rpc, options.size)
    print(f"images made in {time.perf_counter() - begun:.0f} s", flush=True)
    target = options.out / "scene"
    shutil.rmtree(target, ignore_errors=True)
    cells = ["--cell-size", str(options.cell_size)] if options.cell_size else []
    common = ["--id", "FULL", "--threads", str(options.threads)]
    done = command("prep", *map(str, files), "--out", str(target), *cells, *common)
    if done.status:
        return 1
    left = errors_px(json.loads(done.output), true, target / "FULL", options.size)
    size = sum(p.stat().st_size for p in target.rglob("*") if p.is_file()) / 2**20
    print(f"cameras: {', '.join(f'{e:.2f}' for e in left)} px left; scene {size:.1f} MiB on the disk", flush=True)
    peak = done.peak_gb
    if options.pipe and city is not None:
        peak = max(peak, pipe(done, files, options, city))
    if not options.keep:
        shutil.rmtree(options.out)
    return int(peak > options.memory_gb or max(left) > 0.5)


if __name__ == "__main__":
    sys.exit(main())
