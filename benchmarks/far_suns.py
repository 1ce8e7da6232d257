"""Learned shadows under suns that no image of the training had, against those that the volume casts.

    python benchmarks/far_suns.py [--presets satnerf eonerf-learned-shadow] [--steps 500] [--width 64] [--seed 3]

A town of 64 m is simulated on seven dates and fitted. The sun of the first image is then turned about the vertical.
Prints, per sun, the angle to the nearest of the training, and the intersection over union with the shadows of the true
heights of the network's own shadows and of cast ones.
"""

from __future__ import annotations

import argparse
import math
import tempfile
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch

TURNS_DEG = (0, 5, 10, 15, 20, 30, 60, 180)
SHADE = 0.6  # of the albedo, below which a cell is in shade


def intersection_over_union(one: np.ndarray, other: np.ndarray) -> float:
    """Of two masks ``[H, W]``."""
    return float((one & other).sum() / max((one | other).sum(), 1))


def turned(sun: tuple[float, float, float], degrees: float) -> tuple[float, float, float]:
    """A sun (unit vector) at another azimuth."""
    angle = math.radians(degrees)
    east, north, up = sun
    return east * math.cos(angle) + north * math.sin(angle), north * math.cos(angle) - east * math.sin(angle), up


def main() -> None:
    """Simulate, fit, print."""
    from sattools.export.field_views import field_picture
    from sattools.export.novel import from_above
    from sattools.fit.model import FittedModel
    from sattools.fit.presets import resolve
    from sattools.fit.stage import fit
    from sattools.render import sun_visibility
    from sattools.scene.raster import read_raster
    from sattools.scene.regrid import sample_map
    from sattools.simulate import SimulateOptions, simulate

    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--presets", nargs="+", default=["satnerf", "eonerf-learned-shadow"])
    parser.add_argument("--steps", type=int, default=500)
    parser.add_argument("--width", type=int, default=64)
    parser.add_argument("--seed", type=int, default=3)
    asked = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        scene = simulate(
            SimulateOptions(id="town", size=64.0, views=7, dates=3, seed=asked.seed), Path(folder) / "town"
        )
        truth, grid = read_raster(scene.path(scene.products["truth_dsm"]))
        for preset in asked.presets:
            fit(scene, resolve(preset, {"steps": asked.steps, "width": asked.width}))
            model = FittedModel.load(scene.path(scene.products["model"]))
            height = torch.from_numpy(sample_map(truth[0], grid, model.grid))
            first = model.suns[0]
            assert first is not None
            for sun in (turned(first, sign * turn) for turn in TURNS_DEG for sign in ((1,) if turn == 0 else (1, -1))):
                shaded = sun_visibility(height, model.grid.cell_size, sun).numpy() < 0.5
                found = []
                for shown in (model, replace(model, shadow="geometric")):
                    picture, _, _ = field_picture(shown, from_above(shown, sun), None, scene.require_height_range())
                    dark = picture.mean(-1) < SHADE * model.albedo.numpy().mean(-1)
                    found.append(intersection_over_union(dark, shaded))
                nearest = max(sum(a * b for a, b in zip(sun, known, strict=True)) for known in model.suns if known)
                away = math.degrees(math.acos(min(1.0, nearest)))
                print(f"{preset}: {away:5.1f} degrees away, learned {found[0]:.3f}, cast {found[1]:.3f}", flush=True)


if __name__ == "__main__":
    main()
