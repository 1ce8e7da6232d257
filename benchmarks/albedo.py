"""How far is the albedo of a fit from a simulated scene's?

    python benchmarks/albedo.py SCENE/scene.json=SIMULATED ...

SIMULATED is the folder of a scene of `sattools simulate` (cities; its truth has the albedo), SCENE what `prep`, `fit`
and `export` made of its images. Albedos of images of unknown scale are known up to a factor per band: that of the
medians where the sun reaches a cell in four images of five and the height is right to half a metre. Printed: the mean
absolute difference over the mean albedo (mean of the bands) of all cells but water, of those whose height is right to
half a metre, and of these by how many of the images have the sun on them. The truth is shifted by whole cells, up to
three, to where its heights are nearest, as `compare` registers surfaces.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np

from sattools.scene import Grid, Scene
from sattools.scene.raster import raster_grid, read_raster
from sattools.scene.regrid import sample_map

RIGHT_M = 0.5
WATER = 9
REACH = 3  # cells


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("pairs", nargs="+", metavar="SCENE=SIMULATED")
    print(f"{'':34s}{'all':>7s}{'right':>7s}{'lit':>7s}{'mixed':>7s}{'shade':>7s}")
    for pair in parser.parse_args().pairs:
        path, simulated = (Path(part) for part in pair.split("="))
        figures = errors(Scene.from_file(path), simulated)
        print(f"{path.parent.name[:34]:34s}" + "".join(f"{figure:7.3f}" for figure in figures), flush=True)


def errors(scene: Scene, simulated: Path) -> list[float]:
    """Relative errors: all, height right, and of these lit in 80 % of the images or more, between, in 20 % or fewer."""
    grid = raster_grid(scene.path(scene.products["albedo"]))
    found, _ = read_raster(scene.path(scene.products["albedo"]))
    height = read_raster(scene.path(scene.products["dsm"]))[0][0]
    shaded = [read_raster(scene.path(item.assets["shadow"].href))[0][0] for item in scene.train_items()]
    lit = 1 - np.mean(shaded, axis=0)
    true = np.concatenate([_on(simulated, name, grid) for name in ("DSM", "CLS", "ALBEDO")])
    shifts = [(row, col) for row in range(-REACH, REACH + 1) for col in range(-REACH, REACH + 1)]
    true = min((np.roll(true, shift, (1, 2)) for shift in shifts), key=lambda moved: _apart(height - moved[0]))
    apart, classes, albedo = height - true[0], true[1], true[2:]
    known = np.isfinite(found).all(axis=0) & np.isfinite(albedo).all(axis=0) & np.isfinite(apart) & (classes != WATER)
    right = known & (np.abs(apart - np.median(apart[known])) < RIGHT_M)
    plain = right & (lit >= 0.8)
    factor = np.median(albedo[:, plain], axis=1) / np.median(found[:, plain], axis=1)
    wrong, mean = np.abs(found * factor[:, None, None] - albedo).mean(axis=0), albedo.mean(axis=0)
    parts = [known, right, plain, right & (lit > 0.2) & (lit < 0.8), right & (lit <= 0.2)]
    return [float(wrong[part].sum() / mean[part].sum()) for part in parts]


def _apart(errors: np.ndarray) -> float:
    """Mean absolute deviation from the median error [m], each at most 5 m."""
    known = errors[np.isfinite(errors)]
    return float(np.minimum(np.abs(known - np.median(known)), 5.0).mean())


def _on(simulated: Path, name: str, grid: Grid) -> np.ndarray:
    """A map ``[C, H, W]`` of the truth on another grid."""
    path = next((simulated / "truth").glob(f"*_{name}.tif"))
    bands, own = read_raster(path)
    return np.stack([sample_map(band.astype(np.float32), own, grid) for band in bands])


if __name__ == "__main__":
    main()
