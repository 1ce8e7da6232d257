"""Does a choice of the prior predict an image that took no part? Variants judged without any reference.

    python benchmarks/left_out.py SCENE/scene.json ... [--variant 'NAME: OPTION=VALUE ...'] ... [--views N]

Scenes come from `sattools prep` or `simulate`; variants are those of `benchmarks/steps.py`. Of N views (default: 3,
spread over the list) each is left out in turn: the surface is matched from the others alone, and the view is drawn from
them, with what hides what, pixel by pixel where any of them sees the place. Columns: correlation with the view itself;
1 minus that, relative to the defaults; mean absolute difference after the best gain and offset, relative to the
defaults; share of the view that could be drawn.
"""

from __future__ import annotations

import argparse
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from scipy.ndimage import map_coordinates
from steps import switched, variant

from sattools.prior.frame import Frame
from sattools.prior.matched import crop, make_frame
from sattools.prior.matching.match import match
from sattools.prior.matching.pairs import choose_pairs
from sattools.prior.visibility.kernels import first_hit_heights
from sattools.scene import Scene
from sattools.scene.regrid import resize_map
from sattools.views import load_sources

HIDDEN_M = 1.0  # below the surface that a view sees first from which it does not show a place


def drawn(frame: Frame, surface: np.ndarray, left: int) -> np.ndarray:
    """The view `left` as the others show what its lines of sight meet ``[Hf, Wf]``; NaN where none of them sees it."""
    wide = np.pad(surface, frame.margin, mode="edge")
    first = np.empty(frame.images.shape, np.float32)
    first_hit_heights(wide, frame.parallax, frame.z_ref, surface.max() + 1.0, surface.min() - 1.0, first)
    height = first[left]
    dz = height - frame.z_ref
    rows, cols = np.indices(height.shape)
    at = [rows - frame.parallax[left, 0] * dz, cols - frame.parallax[left, 1] * dz]
    total, count = np.zeros(height.shape), np.zeros(height.shape)
    for v, per_metre in enumerate(frame.parallax):
        if v == left:
            continue
        there = [at[k] + per_metre[k] * dz for k in (0, 1)]
        seen = map_coordinates(frame.masks[v], there, order=0, cval=0) > 0
        seen &= map_coordinates(first[v], there, order=0, cval=np.inf) <= height + HIDDEN_M
        total += np.where(seen, map_coordinates(frame.images[v], there, order=1), 0.0)
        count += seen
    return np.where(count > 0, total / np.maximum(count, 1), np.nan)


def without(frame: Frame, left: int) -> Frame:
    """All views but one."""
    keep = [v for v in range(len(frame.images)) if v != left]
    images, masks, parallax = frame.images[keep], frame.masks[keep], frame.parallax[keep]
    suns, pixels = (tuple(own[v] for v in keep) for own in (frame.suns, frame.pixels))
    return replace(frame, images=images, masks=masks, parallax=parallax, suns=suns, pixels=pixels)


def scores(scene: Scene, changed: dict[str, Any], lefts: list[int]) -> np.ndarray:
    """Correlation, mean absolute difference, share drawn: means over the views left out."""
    found = []
    z_range = scene.require_height_range()
    with switched(changed) as options:
        grid = scene.require_grid().resized(options.resolution or scene.require_grid().cell_size)
        sources = load_sources(scene, scene.train_items())
        frame, views = make_frame(sources, grid, z_range, options.window)
        fine = grid.resized(grid.cell_size * options.detail)
        looked = make_frame(sources, fine, z_range, options.window)[0]
        limits = (options.min_angle, options.max_angle)
        for left in lefts:
            rest = [view for v, view in enumerate(views) if v != left]
            slopes, suns = [v.slope for v in rest], [v.sun for v in rest]
            pairs = choose_pairs(slopes, suns, options.pairs, limits, options.ideal_angle)
            height = match(without(looked, left), pairs, z_range, options, finer=1 / options.detail).height
            surface = resize_map(crop(height, fine.shape), fine, grid)
            surface = np.pad(surface, [(0, n - m) for n, m in zip(frame.shape, grid.shape, strict=True)], mode="edge")
            picture = drawn(frame, surface, left)
            inside = slice(frame.margin, -frame.margin or None)
            own = np.where(frame.masks[left] > 0, frame.images[left], np.nan)[inside, inside]
            picture = picture[inside, inside]
            both = np.isfinite(own) & np.isfinite(picture)
            gain, offset = np.polyfit(picture[both], own[both], 1)
            residual = np.abs(own[both] - gain * picture[both] - offset).mean()
            share = both.sum() / np.isfinite(own).sum()
            found.append([np.corrcoef(own[both], picture[both])[0, 1], residual, share])
    return np.mean(found, axis=0)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("scenes", nargs="+", type=Path, metavar="SCENE")
    parser.add_argument("--variant", action="append", default=[], metavar="'NAME: OPTION=VALUE ...'")
    parser.add_argument("--views", type=int, default=3, help="number of views that are left out in turn")
    options = parser.parse_args()
    variants = [variant("as it is"), *map(variant, options.variant)]
    print(f"{'':34s} {'corr.':>6s} {'1-corr':>7s} {'resid.':>7s} {'drawn':>6s}")
    for path in options.scenes:
        scene = Scene.from_file(path)
        count = len(scene.train_items())
        lefts = sorted({round(v) for v in np.linspace(0, count - 1, min(options.views, count))})
        print(scene.id)
        first = None
        for name, changed in variants:
            now = scores(scene, changed, lefts)
            first = now if first is None else first
            relative = (1 - now[0]) / (1 - first[0]), now[1] / first[1]
            print(f"  {name:32s} {now[0]:6.4f} {relative[0]:7.3f} {relative[1]:7.3f} {now[2]:6.3f}", flush=True)


if __name__ == "__main__":
    main()
