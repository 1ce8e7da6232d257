"""Where do the constants of `sattools.prior.probability` come from, and does it hold elsewhere?

    python benchmarks/probability.py --fit SCENE/scene.json=REFERENCE.tif[@REGION] ... [--test SCENE=REFERENCE ...]
        [--cache FOLDER]

Scenes and references are those of `benchmarks/steps.py`. With --fit the weights are found anew (logistic regression,
every scene counts the same) and printed; without it those in the code are judged. An error is the difference from the
reference after registration by whole cells, about its median: the mean that the protocol removes is itself moved by
errors at walls. For every scene: share of cells with less than 1 m, mean of the predicted probability, expected
calibration error (ten classes of equal width), the same about the protocol's mean, the largest gap of a class that
holds 2 % of the cells, and the Brier score beside that of the share alone. --cache keeps what matching found.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np
from scipy.optimize import minimize
from steps import matched, reference

from sattools.compare import compare_dsm
from sattools.prior import PriorOptions
from sattools.prior.confidence import match_confidence
from sattools.prior.matching.match import Match
from sattools.prior.probability import LIMIT_M, NAMES, WEIGHTS, features, from_features
from sattools.scene import Grid, Scene
from sattools.scene.regrid import reproject_map

CLASSES = 10
RIDGE = 1e-4  # keeps weights finite that the scenes do not determine


def found(scene: Scene, cache: Path | None) -> tuple[Match, Grid]:
    """What `sattools prior` finds."""
    path = None if cache is None else cache / f"{scene.id}.npz"
    if path is not None and path.exists():
        return Match(**np.load(path)), scene.require_grid()
    match, grid, _ = matched(scene, PriorOptions())
    if path is not None:
        path.parent.mkdir(parents=True, exist_ok=True)
        np.savez(path, **vars(match))
    return match, grid


def cells(text: str, cache: Path | None) -> tuple[str, np.ndarray, np.ndarray, np.ndarray]:
    """Name of a scene; features ``[N, K]`` of its scored cells, their errors about the median and about the mean."""
    path, _, against = text.partition("=")
    scene, truth = Scene.from_file(Path(path)), reference(against)
    match, grid = found(scene, cache)
    compared = compare_dsm(match.height, truth, grid)
    east, north, _ = compared.figures["shift_m"]
    moved = Grid(grid.crs, grid.left + east, grid.top + north, grid.cell_size, grid.width, grid.height)
    every = features(match_confidence(match), grid.cell_size)
    there = np.stack([reproject_map(np.ascontiguousarray(f), moved, truth.grid) for f in np.moveaxis(every, -1, 0)], -1)
    known = np.isfinite(compared.difference) & np.isfinite(there).all(axis=-1)
    error = compared.difference[known]
    return scene.id, there[known], error - np.median(error), error


def fitted(scenes: list[tuple[str, np.ndarray, np.ndarray, np.ndarray]]) -> np.ndarray:
    """Weights ``[K]`` of least mean log loss, every scene counting the same."""
    x = np.concatenate([f for _, f, _, _ in scenes])
    y = np.concatenate([np.abs(e) < LIMIT_M for _, _, e, _ in scenes]).astype(np.float64)
    w = np.concatenate([np.full(len(e), 1 / len(e)) for _, _, e, _ in scenes]) / len(scenes)

    def loss(weights: np.ndarray) -> tuple[float, np.ndarray]:
        z = x @ weights
        p = 1 / (1 + np.exp(-z))
        value = (w * (np.logaddexp(0, z) - y * z)).sum() + RIDGE * (weights**2).sum()
        return value, x.T @ (w * (p - y)) + 2 * RIDGE * weights

    return np.asarray(minimize(loss, np.zeros(x.shape[1]), jac=True, method="L-BFGS-B", options={"maxiter": 2000}).x)


def calibration(p: np.ndarray, right: np.ndarray) -> tuple[float, float]:
    """Expected calibration error, and the largest gap of a class with at least 2 % of the cells."""
    which = np.minimum((p * CLASSES).astype(int), CLASSES - 1)
    count = np.bincount(which, minlength=CLASSES)
    gap = np.abs(np.bincount(which, p - right, CLASSES))
    share = count >= 0.02 * len(p)
    return float(gap.sum() / len(p)), float((gap[share] / count[share]).max())


def asked(about: str) -> argparse.Namespace:
    """Scenes to fit weights on, and to test them on."""
    parser = argparse.ArgumentParser(description=about.splitlines()[0])
    parser.add_argument("--fit", nargs="+", default=[], metavar="SCENE=REFERENCE[@REGION]")
    parser.add_argument("--test", nargs="+", default=[], metavar="SCENE=REFERENCE[@REGION]")
    parser.add_argument("--cache", type=Path, help="folder that keeps what matching found")
    return parser.parse_args()


def main() -> None:
    options = asked(__doc__)
    weights = np.array(WEIGHTS)
    training = [cells(text, options.cache) for text in options.fit]
    if training:
        weights = fitted(training)
        print("WEIGHTS = (" + ", ".join(f"{w:.4g}" for w in weights) + ")  # " + ", ".join(NAMES))
    print(f"{'':26s} {'right':>6s} {'said':>6s} {'ECE':>6s} {'(mean)':>6s} {'gap':>6s} {'Brier':>6s} {'share':>6s}")
    for scene in [*training, *(cells(text, options.cache) for text in options.test)]:
        name, x, error, about_mean = scene
        p, right = from_features(x, weights), np.abs(error) < LIMIT_M
        ece, gap = calibration(p, right)
        other = calibration(p, np.abs(about_mean) < LIMIT_M)[0]
        brier, alone = float(((p - right) ** 2).mean()), float(right.mean() * (1 - right.mean()))
        title = name + (" (fitted)" if any(scene is one for one in training) else "")
        print(
            f"{title:26s} {right.mean():6.3f} {p.mean():6.3f}"
            f" {ece:6.3f} {other:6.3f} {gap:6.3f} {brier:6.3f} {alone:6.3f}",
            flush=True,
        )


if __name__ == "__main__":
    main()
