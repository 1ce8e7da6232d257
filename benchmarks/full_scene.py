"""Whole satellite images through `sattools prep`: does it finish, in which memory, and how good are the cameras?

    python benchmarks/full_scene.py --size 20000 --views 3 --out FOLDER [--memory-gb 4] [--keep]

Makes images of SIZE x SIZE pixels of 0.5 m by warping an endless random texture over rolling ground of 60 m, seen by
RPC cameras of known error (up to 12 pixels), strip by strip, without ever holding one in memory; runs `prep` on them
in a process of its own; prints its seconds, CPU seconds and peak memory, what is left of the cameras' errors (the part
that tie points can see, in pixels at the image's corners and centre), and what the scene takes on the disk. 8-bit
pixels, about SIZE^2 bytes an image. The exit status is 1 where the memory was exceeded or a camera is off by more than
half a pixel.
"""

from __future__ import annotations

import argparse
import json
import math
import os
import shutil
import subprocess
import sys
import time
from pathlib import Path

import cv2
import numpy as np
import rasterio
from rasterio.windows import Window

from sattools.camera import RPC

GSD_M = 0.5
LON, LAT, ALT = 15.0, 46.0, 300.0
RUNS = [(0.25, 0.05), (-0.2, 0.15), (0.02, -0.22), (0.1, 0.3)]  # horizontal metres per metre of height
BIAS_PX = [(0.0, 0.0), (9.0, -7.0), (-6.0, 10.0), (4.0, 4.0)]
PERIODS = (2048, 1789)  # cells of two textures, which together do not repeat within a scene


def camera(run: tuple[float, float], size: int, bias: tuple[float, float]) -> RPC:
    """Parallel lines of sight over a plane ground: col and row are linear in longitude, latitude and height."""
    e2 = 6.69437999014e-3
    w2 = 1 - e2 * math.sin(math.radians(LAT)) ** 2
    east = math.radians(6378137.0 / math.sqrt(w2) * math.cos(math.radians(LAT)))
    north = math.radians(6378137.0 * (1 - e2) / w2**1.5)
    scale, degrees, metres = size / 2, size * GSD_M / 2 / north, 300.0
    col, row, one = np.zeros(20), np.zeros(20), np.zeros(20)
    one[0] = 1.0
    col[1], col[3] = degrees * east / GSD_M / scale, -run[0] * metres / GSD_M / scale
    row[2], row[3] = -degrees * north / GSD_M / scale, run[1] * metres / GSD_M / scale
    middle = (size - 1) / 2
    return RPC(
        middle + bias[1], middle + bias[0], LAT, LON, ALT, scale, scale, degrees, degrees, metres, row, one, col, one
    )


def height(east: np.ndarray, north: np.ndarray) -> np.ndarray:
    """Of the ground above ALT [m]."""
    return 30.0 * np.sin(east / 700.0) * np.cos(north / 900.0)


def textures(seed: int = 0) -> list[np.ndarray]:
    """Two square pieces of random ground that continue themselves, cells of 0.5 m."""
    rng = np.random.default_rng(seed)
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


def write_image(path: Path, run: tuple[float, float], rpc: RPC, size: int, pieces: list[np.ndarray]) -> None:
    """An image of the ground, strip by strip."""
    profile = {"driver": "GTiff", "width": size, "height": size, "count": 1, "dtype": "uint8", "tiled": True}
    rows_at_once = 512
    with rasterio.open(path, "w", blockxsize=512, blockysize=512, bigtiff="if_safer", **profile) as out:
        cols = (np.arange(size, dtype=np.float64) - (size - 1) / 2) * GSD_M
        for first in range(0, size, rows_at_once):
            count = min(rows_at_once, size - first)
            rows = -(np.arange(first, first + count, dtype=np.float64) - (size - 1) / 2) * GSD_M
            east0, north0 = np.meshgrid(cols, rows)
            h = height(east0, north0)
            for _ in range(4):
                h = height(east0 + run[0] * h, north0 + run[1] * h)
            east, north = (east0 + run[0] * h) / GSD_M, (north0 + run[1] * h) / GSD_M
            total = np.zeros((count, size), np.float32)
            for piece in pieces:
                period = len(piece)
                wrapped = np.pad(piece, 1, mode="wrap")
                at_col, at_row = (np.mod(v, period).astype(np.float32) + 1 for v in (east, -north))
                for c in range(0, size, 16384):  # OpenCV's limit for the size of a map is 32767
                    part = slice(c, min(size, c + 16384))
                    total[:, part] += cv2.remap(wrapped, at_col[:, part], at_row[:, part], cv2.INTER_LINEAR)
            grey = np.clip(120 + 18 * total, 1, 254).astype(np.uint8)
            out.write(grey, 1, window=Window(0, first, size, count))
        out.update_tags(ns="RPC", **rpc.to_tags())


def errors_px(scene: dict, true: list[RPC], root: Path, size: int) -> list[float]:
    """What is left of each camera's error, less a common shift and a common height, at five pixels [px]."""
    low, high = scene["sattools"]["height_range_m"]
    middle = (low + high) / 2
    places = [(0, 0), (size - 1, 0), (0, size - 1), (size - 1, size - 1), (size / 2, size / 2)]
    rows = []
    for feature, rpc in zip(scene["features"], true, strict=True):
        found = RPC.from_file(root / feature["assets"]["rpc"]["href"])
        rows.append([np.subtract(found.projection(*rpc.localization(c, r, middle), middle), (c, r)) for c, r in places])
    found = np.array(rows)  # [V, 5, 2]
    design = np.zeros((*found.shape, 3))
    design[..., 0, 0] = design[..., 1, 1] = 1.0
    for k in range(len(true)):
        design[k, :, :, 2] = np.array([-RUNS[k][0], RUNS[k][1]]) / GSD_M
    flat, target = design.reshape(-1, 3), found.ravel()
    rest = (target - flat @ np.linalg.lstsq(flat, target, rcond=None)[0]).reshape(found.shape)
    return [round(float(np.hypot(*view.T).max()), 3) for view in rest]


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--size", type=int, default=20000)
    parser.add_argument("--views", type=int, default=3)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--memory-gb", type=float, default=4.0)
    parser.add_argument("--keep", action="store_true")
    options = parser.parse_args()

    options.out.mkdir(parents=True, exist_ok=True)
    true = [camera(RUNS[k], options.size, (0.0, 0.0)) for k in range(options.views)]
    files = [options.out / f"full_{k}.tif" for k in range(options.views)]
    pieces = textures()
    begun = time.perf_counter()
    for k, file in enumerate(files):
        if not file.exists():
            write_image(file, RUNS[k], camera(RUNS[k], options.size, BIAS_PX[k]), options.size, pieces)
    print(f"images made in {time.perf_counter() - begun:.0f} s", flush=True)
    target = options.out / "scene"
    shutil.rmtree(target, ignore_errors=True)
    command = [sys.executable, "-m", "sattools", "prep", *map(str, files), "--out", str(target), "--id", "FULL"]
    begun = time.perf_counter()
    process = subprocess.Popen(command, stdout=subprocess.PIPE)
    output = process.stdout.read() if process.stdout else b""
    _, status, usage = os.wait4(process.pid, 0)
    seconds, code = time.perf_counter() - begun, os.waitstatus_to_exitcode(status)
    peak = usage.ru_maxrss / 2**20
    print(
        f"prep: exit status {code}, {seconds:.0f} s, {usage.ru_utime + usage.ru_stime:.0f} CPU s, {peak:.2f} GiB peak"
    )
    if code:
        return 1
    left = errors_px(json.loads(output), true, target / "FULL", options.size)
    size = sum(p.stat().st_size for p in target.rglob("*") if p.is_file()) / 2**20
    print(f"cameras: {', '.join(f'{e:.2f}' for e in left)} px left; scene {size:.1f} MiB on the disk")
    if not options.keep:
        shutil.rmtree(options.out)
    return int(peak > options.memory_gb or max(left) > 0.5)


if __name__ == "__main__":
    sys.exit(main())
