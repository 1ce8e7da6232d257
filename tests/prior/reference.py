"""The matching kernels once more, written plainly with numpy: slow, and easy to check by eye."""

from __future__ import annotations

import numpy as np


def bilinear(image, row, col):
    """Value of an image at one fractional position."""
    r, c = int(np.floor(row)), int(np.floor(col))
    fr, fc = row - r, col - c
    top = (1 - fc) * image[r, c] + fc * image[r, c + 1]
    bottom = (1 - fc) * image[r + 1, c] + fc * image[r + 1, c + 1]
    return (1 - fr) * top + fr * bottom


def agreement(a, b, noise, brightness):
    """Structure times brightness of two windows, not below 0."""
    covariance = (a * b).mean() - a.mean() * b.mean()
    structure = (2 * covariance + noise**2) / (a.var() + b.var() + noise**2)
    return max(structure, 0.0) / (1 + ((a.mean() - b.mean()) / brightness) ** 2)


def correlate(
    images, masks, slopes, heights, z_ref, first_hit_height, shadow_height, dark, tolerance, pairs,
    radius, noise, shadow_noise, brightness, margin, unseen, power=1, weak=0.0, mixed=0.0, base=None,
):  # fmt: skip
    """Scores ``[H, W, D]`` of a frame; arguments as in `sattools.prior.kernels.correlate`."""
    views, rows, cols = images.shape
    volume = np.empty((rows - 2 * margin, cols - 2 * margin, len(heights)))
    near = range(-radius, radius + 1)
    for row, col, k in np.ndindex(volume.shape):
        z = {
            (i, j): heights[k] + (0 if base is None else base[row + radius + i, col + radius + j])
            for i in near
            for j in near
        }
        shift = slopes * (z[0, 0] - z_ref)

        def window(v, row=row, col=col, z=z):
            move = {at: slopes[v] * (z[at] - z_ref) + margin for at in z}
            return np.array(
                [[bilinear(images[v], row + i + move[i, j][0], col + j + move[i, j][1]) for j in near] for i in near]
            )

        windows = [window(v) for v in range(views)]
        nearest = [(v, row + margin + round(shift[v, 0]), col + margin + round(shift[v, 1])) for v in range(views)]
        valid = [masks[n] > 0 for n in nearest]
        weights = [
            ok * (1.0 if first_hit_height[n] <= z[0, 0] + tolerance else weak)
            for ok, n in zip(valid, nearest, strict=True)
        ]
        lit = [shadow_height[v, row, col] <= z[0, 0] for v in range(views)]
        powers = weight = 0.0
        for a, b in pairs:
            own = weights[a] * weights[b] * (1.0 if lit[a] == lit[b] else mixed)
            both_dark = not lit[a] and not lit[b] and all(windows[v].mean() < dark[v] + brightness for v in (a, b))
            floor, veil = (shadow_noise, dark[a] - dark[b]) if both_dark else (noise, 0.0)
            powers += own * agreement(windows[a] - veil, windows[b], floor, brightness) ** (2 * power)
            weight += own
        volume[row, col, k] = (powers / weight) ** (1 / (2 * power)) if weight > 0 else -1
    best = np.maximum(volume.max(axis=2, keepdims=True), 0)
    return np.where(volume < 0, np.minimum(unseen, 0.9 * best), volume)


def aggregate(score, small, large):
    """Sum of the eight path costs ``[H, W, D]`` by the recursion of Hirschmueller (2008), eq. 13."""
    rows, cols, depth = score.shape
    total = np.zeros(score.shape)
    cost = 1.0 - score
    for dr, dc in [(0, 1), (0, -1), (1, 0), (-1, 0), (1, 1), (-1, -1), (1, -1), (-1, 1)]:
        path = np.zeros(score.shape)
        for row in range(rows)[:: dr if dr else 1]:
            for col in range(cols)[:: dc if dc else 1]:
                r, c = row - dr, col - dc
                if not (0 <= r < rows and 0 <= c < cols):
                    path[row, col] = cost[row, col]
                    continue
                before = path[r, c]
                for k in range(depth):
                    options = [before[k], before.min() + large]
                    options += [before[n] + small for n in (k - 1, k + 1) if 0 <= n < depth]
                    path[row, col, k] = cost[row, col, k] + min(options) - before.min()
        total += path
    return total
