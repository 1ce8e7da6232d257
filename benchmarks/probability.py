"""Where do the constants of `sattools.prior.probability` come from, and do they hold elsewhere?

    python benchmarks/probability.py --fit SCENE/scene.json=REFERENCE.tif[@REGION] ... [--test SCENE=REFERENCE ...]
        [--times N ...] [--cache FOLDER] [--out sattools/prior/probability.json]

Scenes and references are those of `benchmarks/steps.py`. With --fit the network is trained anew, every scene counting
the same: log loss of "less than 1 m off", and quantile losses (68.3 and 95.4 %) of the error's logarithm. Without it
the one in the code is judged. An error is the difference from the reference after registration by whole cells, about
its median: the mean that the protocol removes is itself moved by errors at walls. For every scene: share of cells with
less than 1 m, mean of the predicted probability, expected calibration error (ten classes of equal width), the same
about the protocol's mean, the largest gap of a class that holds 2 % of the cells, the Brier score beside that of the
share alone; shares of the errors below the 68 and the 95 % bound; share right and mean probability in trees. --times
takes every scene on so many times wider cells, too, as `prior` brings a surface onto cells wider (or narrower) than
those that suit the pixels; 1 alone where it is not given. --cache keeps what matching found. The averages over scenes
come last.
"""

from __future__ import annotations

import argparse
import json
import zlib
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import torch
from rasterio.enums import Resampling
from rasterio.warp import reproject
from steps import matched, reference

from sattools.compare import compare_dsm
from sattools.prior import PriorOptions
from sattools.prior.confidence import match_confidence
from sattools.prior.matching.match import Match
from sattools.prior.probability import LEAST_M, LIMIT_M, NAMES, SHARES, arrays, features, from_features, the_network
from sattools.scene import Grid, Scene
from sattools.scene.regrid import reproject_map, resize_map

CLASSES = 10
TREES = 5
HIDDEN = 24
STEPS, EACH, RATE, DECAY = 8000, 128, 1e-2, 1e-4  # of the training: steps, cells of every scene, learning rate
QUANTILES = 0.3  # weight of a quantile loss beside the log loss
DIGITS = 5
WIDER = 1.5  # times as wide as the reference's cells, from which a cell is compared with their mean


@dataclass(frozen=True)
class Cells:
    """Scored cells of a scene.

    Attributes:
        name: of the scene.
        features: ``[N, K]``.
        error: ``[N]`` about the median [m].
        about_mean: ``[N]`` about the protocol's mean [m].
        trees: ``[N]`` bool.
    """

    name: str
    features: np.ndarray
    error: np.ndarray
    about_mean: np.ndarray
    trees: np.ndarray


def found(scene: Scene, cache: Path | None) -> tuple[Match, Grid]:
    """What `sattools prior` finds."""
    place = f"{zlib.crc32(str(scene.root).encode()):08x}"  # other images of a scene have its id, too
    path = None if cache is None else cache / f"{scene.id}_{place}.npz"
    if path is not None and path.exists():
        return Match(**np.load(path)), scene.require_grid()
    match, grid, _ = matched(scene, PriorOptions())
    if path is not None:
        path.parent.mkdir(parents=True, exist_ok=True)
        np.savez(path, **{name: part for name, part in vars(match).items() if part is not None})
    return match, grid


def cells(text: str, cache: Path | None, times: float = 1.0) -> Cells:
    """The scored cells of a scene and its reference, on so many times wider cells."""
    path, _, against = text.partition("=")
    scene, truth = Scene.from_file(Path(path)), reference(against)
    match, own = found(scene, cache)
    grid = own.resized(times * own.cell_size)
    height, confidence = (resize_map(values, own, grid) for values in (match.height, match_confidence(match)))
    compared = compare_dsm(height, truth, grid)
    east, north, _ = compared.figures["shift_m"]
    moved = grid.moved(east, north)
    every = np.moveaxis(features(height, confidence, grid.cell_size), -1, 0)
    if grid.cell_size > WIDER * truth.grid.cell_size:  # the height of a wide cell is that of its mean
        there, difference = np.moveaxis(every, 0, -1), height - means(truth.heights, truth.grid, moved)
        classes = None
    else:
        there = np.stack([reproject_map(np.ascontiguousarray(f), moved, truth.grid) for f in every], axis=-1)
        difference, classes = compared.difference, truth.classes
    known = np.isfinite(difference) & np.isfinite(there).all(axis=-1)
    error = difference[known] - np.mean(difference[known])
    trees = np.zeros(len(error), bool) if classes is None else classes[known] == TREES
    return Cells(f"{path} x {times:g}", there[known], error - np.median(error), error, trees)


def means(heights: np.ndarray, own: Grid, target: Grid) -> np.ndarray:
    """Mean heights ``[H, W]`` of cells that are wider than those of a map; NaN where the map is not."""
    found = np.full(target.shape, np.nan, np.float32)
    reproject(
        np.asarray(heights, np.float32), found, src_transform=own.transform, src_crs=own.crs, src_nodata=np.nan,
        dst_transform=target.transform, dst_crs=target.crs, dst_nodata=np.nan, resampling=Resampling.average,
    )  # fmt: skip
    return found


def loss(out: torch.Tensor, error: torch.Tensor) -> torch.Tensor:
    """Log loss and quantile losses of a network's output ``[N, 3]``."""
    total = torch.nn.functional.binary_cross_entropy_with_logits(out[:, 0], (error < LIMIT_M).float())
    for k, share in enumerate(SHARES, start=1):
        rest = torch.log(error + LEAST_M) - out[:, k]
        total = total + QUANTILES * torch.maximum(share * rest, (share - 1) * rest).mean()
    return total


def fitted(scenes: list[Cells]) -> dict[str, Any]:
    """The network of least mean loss, with lists; every scene counts the same."""
    torch.manual_seed(0)
    rng = np.random.default_rng(0)
    some = np.concatenate([one.features[rng.integers(0, len(one.error), 5000)] for one in scenes])
    mean, std = some.mean(axis=0), some.std(axis=0)
    std[std == 0] = 1.0  # of the cell's size, where all are alike
    sizes = (len(NAMES), HIDDEN, HIDDEN, 1 + len(SHARES))
    linear = [torch.nn.Linear(a, b) for a, b in pairwise(sizes)]
    net = torch.nn.Sequential(linear[0], torch.nn.ReLU(), linear[1], torch.nn.ReLU(), linear[2])
    optimizer = torch.optim.AdamW(net.parameters(), RATE, weight_decay=DECAY)
    schedule = torch.optim.lr_scheduler.OneCycleLR(optimizer, RATE, total_steps=STEPS)
    for _ in range(STEPS):
        chosen = [rng.integers(0, len(one.error), EACH) for one in scenes]
        x = np.concatenate([one.features[k] for one, k in zip(scenes, chosen, strict=True)])
        error = np.concatenate([np.abs(one.error[k]) for one, k in zip(scenes, chosen, strict=True)])
        value = loss(net(torch.tensor((x - mean) / std).clamp(-3, 3)), torch.tensor(error).float())
        optimizer.zero_grad()
        value.backward()  # type: ignore[no-untyped-call]
        optimizer.step()
        schedule.step()

    def rounded(values: Any) -> Any:
        return [rounded(v) for v in values] if values.ndim else float(f"{float(values):.{DIGITS}g}")

    layers = [{"weights": rounded(one.weight.detach().T), "bias": rounded(one.bias.detach())} for one in linear]
    return {"features": list(NAMES), "mean": rounded(mean), "std": rounded(std), "layers": layers}


def calibration(p: np.ndarray, right: np.ndarray) -> tuple[float, float]:
    """Expected calibration error, and the largest gap of a class with at least 2 % of the cells."""
    which = np.minimum((p * CLASSES).astype(int), CLASSES - 1)
    count = np.bincount(which, minlength=CLASSES)
    gap = np.abs(np.bincount(which, p - right, CLASSES))
    share = count >= 0.02 * len(p)
    return float(gap.sum() / len(p)), float((gap[share] / count[share]).max())


def figures(scene: Cells, network: dict[str, Any] | None) -> np.ndarray:
    """What is printed of a scene, see the text above."""
    p, std, error95 = from_features(scene.features, network)
    error = np.abs(scene.error)
    right = error < LIMIT_M
    ece, gap = calibration(p, right)
    other = calibration(p, np.abs(scene.about_mean) < LIMIT_M)[0]
    brier, alone = float(((p - right) ** 2).mean()), float(right.mean() * (1 - right.mean()))
    trees = [values[scene.trees].mean() if scene.trees.any() else np.nan for values in (right, p)]
    shares = (error < std).mean(), (error < error95).mean()
    return np.array([right.mean(), p.mean(), ece, other, gap, brier, alone, *shares, *trees])


def asked(about: str) -> argparse.Namespace:
    """Scenes to fit weights on, and to test them on."""
    parser = argparse.ArgumentParser(description=about.splitlines()[0])
    parser.add_argument("--fit", nargs="+", default=[], metavar="SCENE=REFERENCE[@REGION]")
    parser.add_argument("--test", nargs="+", default=[], metavar="SCENE=REFERENCE[@REGION]")
    parser.add_argument("--times", nargs="+", type=float, default=[1.0], help="wider cells, in those of the scene")
    parser.add_argument("--cache", type=Path, help="folder that keeps what matching found")
    parser.add_argument("--out", type=Path, help="file for the network")
    return parser.parse_args()


def main() -> None:
    options = asked(__doc__)
    network = None if options.fit else the_network()
    training = [cells(text, options.cache, n) for n in options.times for text in options.fit]
    if training:
        stored = fitted(training)
        network = arrays(stored)
        if options.out:
            options.out.write_text(json.dumps(stored) + "\n", encoding="utf-8")
    names = ("right", "said", "ECE", "(mean)", "gap", "Brier", "share", "68 %", "95 %", "trees", "said")
    print(f"{'':40s}" + "".join(f" {name:>6s}" for name in names))
    for title, scenes in (
        ("fitted", training),
        *((f"test x {n:g}", [cells(text, options.cache, n) for text in options.test]) for n in options.times),
    ):
        rows = [figures(scene, network) for scene in scenes]
        for name, row in [*zip((s.name[-39:] for s in scenes), rows, strict=True)]:
            print(f"{name:40s}" + "".join(f" {value:6.3f}" for value in row), flush=True)
        if rows:
            print(f"{title:40s}" + "".join(f" {value:6.3f}" for value in np.nanmean(rows, axis=0)), flush=True)


if __name__ == "__main__":
    main()
