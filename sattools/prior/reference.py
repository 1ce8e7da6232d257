"""Matching once more, written plainly with numpy: slow, and easy to check by eye. Tests compare the kernels with it.

Shapes: V views, Hf x Wf cells of the frame, H x W cells of the grid inside its margin, D heights, P pairs.
"""

from __future__ import annotations

import numpy as np


def bilinear(image: np.ndarray, row: float, col: float) -> float:
    """Value of an image ``[Hf, Wf]`` at one fractional position [cells]."""
    r, c = int(np.floor(row)), int(np.floor(col))
    fr, fc = row - r, col - c
    top = (1 - fc) * image[r, c] + fc * image[r, c + 1]
    bottom = (1 - fc) * image[r + 1, c] + fc * image[r + 1, c + 1]
    return float((1 - fr) * top + fr * bottom)


def agreement(a: np.ndarray, b: np.ndarray, noise: float, brightness: float) -> float:
    """Structure times brightness of two windows ``[n, n]`` of radiance, not below 0 (Wang et al. 2004)."""
    covariance = (a * b).mean() - a.mean() * b.mean()
    structure = (2 * covariance + noise**2) / (a.var() + b.var() + noise**2)
    return float(max(structure, 0.0) / (1 + ((a.mean() - b.mean()) / brightness) ** 2))


def correlate(
    images, masks, parallax, heights, z_ref, first_hit_height, shadow_height, dark, tolerance, pairs,
    radius, noise, shadow_noise, brightness, margin, unseen, power=1, weak=0.0, mixed=0.0, base=None,
    view_weights=None, pair_shares=None,
):  # fmt: skip
    """Scores ``[H, W, D]`` of a frame; arguments as in `sattools.prior.matching.kernels.correlate`."""
    views, rows, cols = images.shape
    shares = np.ones(views) if view_weights is None else view_weights
    of_pairs = np.ones(len(pairs)) if pair_shares is None else pair_shares
    volume = np.empty((rows - 2 * margin, cols - 2 * margin, len(heights)))  # [H, W, D]
    near = range(-radius, radius + 1)
    for row, col, k in np.ndindex(volume.shape):
        z = {
            (i, j): heights[k] + (0 if base is None else base[row + radius + i, col + radius + j])
            for i in near
            for j in near
        }
        shift = parallax * (z[0, 0] - z_ref)  # [V, 2] cells

        def window(v, row=row, col=col, z=z):
            move = {at: parallax[v] * (z[at] - z_ref) + margin for at in z}
            return np.array(
                [[bilinear(images[v], row + i + move[i, j][0], col + j + move[i, j][1]) for j in near] for i in near]
            )

        windows = [window(v) for v in range(views)]  # V times [n, n]
        nearest = [(v, row + margin + round(shift[v, 0]), col + margin + round(shift[v, 1])) for v in range(views)]
        valid = [masks[n] > 0 for n in nearest]  # [V]
        weights = [
            share * ok * (1.0 if first_hit_height[n] <= z[0, 0] + tolerance else weak)
            for share, ok, n in zip(shares, valid, nearest, strict=True)
        ]  # [V]
        lit = [shadow_height[v, row, col] <= z[0, 0] for v in range(views)]  # [V]
        powers = weight = 0.0
        for (a, b), share in zip(pairs, of_pairs, strict=True):
            own = share * weights[a] * weights[b] * (1.0 if lit[a] == lit[b] else mixed)
            both_dark = not lit[a] and not lit[b] and all(windows[v].mean() < dark[v] + brightness for v in (a, b))
            floor, veil = (shadow_noise, dark[a] - dark[b]) if both_dark else (noise, 0.0)
            powers += own * agreement(windows[a] - veil, windows[b], floor, brightness) ** (2 * power)
            weight += own
        beyond = sum(valid) < 2 and base is None and len(pairs) > 2
        volume[row, col, k] = (powers / weight) ** (1 / (2 * power)) if weight > 0 else (-2 if beyond else -1)
    best = np.maximum(volume.max(axis=2, keepdims=True), 0)  # [H, W, 1]
    open_sky = (volume == -2) | (volume == 0)  # [H, W, D]
    above = np.logical_and.accumulate(open_sky[..., ::-1], axis=2)[..., ::-1]  # nothing is shown there or higher up
    worth = np.where(above, 0.6 * unseen, unseen)  # [H, W, D]
    return np.where(volume < 0, np.minimum(worth, 0.9 * best), volume)  # [H, W, D]


def mean_look(
    images, masks, view_weights, parallax, heights, z_ref, first_hit_height, tolerance, hidden, margin
) -> np.ndarray:
    """What the views show on average ``[H, W, D]``; arguments as in `sattools.prior.matching.look.mean_look`."""
    views, rows, cols = images.shape
    look = np.zeros((rows - 2 * margin, cols - 2 * margin, len(heights)))  # [H, W, D]
    for row, col, k in np.ndindex(look.shape):
        shift = parallax * (heights[k] - z_ref)  # [V, 2] cells
        nearest = [(v, row + margin + round(shift[v, 0]), col + margin + round(shift[v, 1])) for v in range(views)]
        seen = [
            share * (masks[n] > 0) * (1.0 if first_hit_height[n] <= heights[k] + tolerance else hidden)
            for share, n in zip(view_weights, nearest, strict=True)
        ]  # [V]
        shown = [bilinear(images[v], row + margin + shift[v, 0], col + margin + shift[v, 1]) for v in range(views)]
        if sum(seen) > 0:
            look[row, col, k] = np.average(shown, weights=seen)
    return look


def aggregate(
    score: np.ndarray, look: np.ndarray, small: float, plain: float, edge: float, contrast: float
) -> np.ndarray:
    """Sum of the eight path costs ``[H, W, D]`` by the recursion of Hirschmueller (2008), eq. 13.

    Args:
        score: ``[H, W, D]`` agreement, at most 1; the cost is 1 - score.
        look: ``[H, W, D]`` what the images show there on average.
        small: penalty P1 for a change by one plane.
        plain: penalty P2 for any larger change where the look does not change at the upper height.
        edge: the same where it changes by much more than the contrast.
        contrast: change of the look at which the penalty lies halfway between the two.
    """
    rows, cols, depth = score.shape
    total = np.zeros(score.shape)  # [H, W, D]
    cost = 1.0 - score  # [H, W, D]
    for dr, dc in [(0, 1), (0, -1), (1, 0), (-1, 0), (1, 1), (-1, -1), (1, -1), (-1, 1)]:
        path = np.zeros(score.shape)  # [H, W, D]
        for row in range(rows)[:: dr if dr else 1]:
            for col in range(cols)[:: dc if dc else 1]:
                r, c = row - dr, col - dc
                if not (0 <= r < rows and 0 <= c < cols):
                    path[row, col] = cost[row, col]
                    continue
                before = path[r, c]  # [D]
                change = look[row, col] - look[r, c]  # [D]
                large = edge + (plain - edge) / (1 + (change / contrast) ** 2)  # [D]
                for k in range(depth):
                    options = [before[n] + large[max(n, k)] for n in range(depth) if n != k] + [before[k]]
                    options += [before[n] + small for n in (k - 1, k + 1) if 0 <= n < depth]
                    path[row, col, k] = cost[row, col, k] + min(options) - before.min()
        total += path
    return total


def first_hit_heights(
    surface: np.ndarray, parallax: np.ndarray, z_ref: float, z_top: float, z_bottom: float
) -> np.ndarray:
    """Height ``[V, Hf, Wf]`` [m] at which the ray through every frame position first meets the surface, from above.

    Args:
        surface: ``[Hf, Wf]`` heights [m].
        parallax: ``[V, 2]`` (row, column) cells per metre of height.
        z_ref: reference height of the frame [m].
        z_top: height at which rays start [m].
        z_bottom: height at which they end [m].
    """
    hits = np.full((len(parallax), *surface.shape), z_bottom)  # [V, Hf, Wf]
    for v, row, col in np.ndindex(hits.shape):
        step = 1.0 / max(*np.abs(parallax[v]), 0.5)  # no step may jump over a cell
        z = z_top
        while z > z_bottom:
            r, c = row + round(-parallax[v, 0] * (z - z_ref)), col + round(-parallax[v, 1] * (z - z_ref))
            if 0 <= r < surface.shape[0] and 0 <= c < surface.shape[1] and surface[r, c] >= z:
                hits[v, row, col] = min(surface[r, c], z + step)
                break
            z -= step
    return hits


def shadow_heights(surface: np.ndarray, sun: np.ndarray, cell: float) -> np.ndarray:
    """Height ``[H, W]`` [m] below which a point over each cell lies in the shadow of the other cells.

    Args:
        surface: ``[H, W]`` heights [m]; beyond its border nothing casts a shadow.
        sun: ``[3]`` unit vector (east, north, up) to the sun.
        cell: edge of a cell [m].
    """
    east, north, up = sun
    across = np.hypot(east, north)
    shadow = np.full(surface.shape, -1e9)  # [H, W]
    for row, col in np.ndindex(surface.shape):
        for t in range(1, sum(surface.shape)):
            r, c = row + round(-t * north / across), col + round(t * east / across)  # rows run south
            if not (0 <= r < surface.shape[0] and 0 <= c < surface.shape[1]):
                break
            shadow[row, col] = max(shadow[row, col], surface[r, c] - t * cell * up / across)
    return shadow


__all__ = ["aggregate", "agreement", "bilinear", "correlate", "first_hit_heights", "mean_look", "shadow_heights"]
