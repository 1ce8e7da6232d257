"""Where do the errors that `prior` states come from (`dsm_std`, `dsm_error95`), and do they hold elsewhere?

    python benchmarks/height_errors.py --fit SCENE/scene.json=REFERENCE.tif[@REGION] ... [--test SCENE=REFERENCE ...]
        [--cache FOLDER]

Scenes, references and what counts as an error are those of `benchmarks/probability.py`. With --fit the weights are
found anew: the logarithms of the quantiles (68.3 and 95.4 %) of the absolute error, linear in the same features
(quantile regression, every scene counting the same). For every scene: share of the errors below one and two standard
deviations and below the 95 % bound, medians of both, and the shares below them in the surest, the middle and the least
sure third of the cells.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from probability import asked, cells
from scipy.optimize import minimize

from sattools.prior.probability import ERROR95_WEIGHTS, STD_WEIGHTS

MOST = 40_000  # cells of a scene
LEAST_M = 0.01  # smaller errors are as good as none
SMOOTH = 0.05  # half width over which the loss is rounded off
Cells = tuple[str, np.ndarray, np.ndarray]


def some_cells(text: str, cache: Path | None) -> Cells:
    """Name of a scene, features ``[N, K]`` of some cells, their absolute errors [m]."""
    name, features, error, _ = cells(text, cache)
    chosen = np.random.default_rng(0).permutation(len(error))[:MOST]
    return name, features[chosen].astype(np.float64), np.abs(error[chosen])


def quantile(scenes: list[Cells], share: float) -> np.ndarray:
    """Weights ``[K]`` of the logarithm of the error that a share of the errors are below."""
    x = np.concatenate([features for _, features, _ in scenes])
    y = np.log(np.maximum(np.concatenate([error for _, _, error in scenes]), LEAST_M))
    w = np.concatenate([np.full(len(e), 1 / len(e)) for _, _, e in scenes]) / len(scenes)

    def loss(weights: np.ndarray) -> tuple[float, np.ndarray]:
        rest = y - x @ weights
        value = (w * (share * rest + SMOOTH * np.logaddexp(0, -rest / SMOOTH))).sum()
        above = 1 / (1 + np.exp(-np.clip(rest / SMOOTH, -50, 50)))
        return value, -(x.T @ (w * (share - 1 + above)))

    return np.asarray(minimize(loss, np.zeros(x.shape[1]), jac=True, method="L-BFGS-B", options={"maxiter": 5000}).x)


def show(scene: Cells, std_weights: np.ndarray, bound_weights: np.ndarray) -> None:
    name, features, error = scene
    std, bound = np.exp(features @ std_weights), np.exp(features @ bound_weights)
    one, two, most = (float((error < limit).mean()) for limit in (std, 2 * std, bound))
    thirds = np.array_split(np.argsort(std), 3)
    parts = ", ".join(f"{(error < std)[k].mean():.2f} {(error < bound)[k].mean():.2f}" for k in thirds)
    print(
        f"{name:10s} 1 std {one:.2f}, 2 std {two:.2f}, bound {most:.2f}; medians {np.median(std):.2f} "
        f"{np.median(bound):.2f} m; thirds {parts}",
        flush=True,
    )


def main() -> None:
    options = asked(__doc__)
    std_weights, bound_weights = np.array(STD_WEIGHTS), np.array(ERROR95_WEIGHTS)
    scenes = [some_cells(text, options.cache) for text in options.fit]
    if scenes:
        std_weights, bound_weights = (quantile(scenes, share) for share in (0.683, 0.954))
        print("std", np.round(std_weights, 4), "bound", np.round(bound_weights, 4))
    for scene in scenes:
        show(scene, std_weights, bound_weights)
    for text in options.test:
        show(some_cells(text, options.cache), std_weights, bound_weights)


if __name__ == "__main__":
    main()
