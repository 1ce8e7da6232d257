"""Materials of a scene from its colours: endmembers, and the abundances of a cell in them."""

from __future__ import annotations

import numpy as np

CHROMA_NOISE = 0.025  # log colour ratios of one material differ at least by this
LIGHT_NOISE = 0.2  # log brightness: shading that is not yet known, and texture
SAMPLE = 6000
ROUNDS = 40
DARKEST = 1e-3


def features(colour: np.ndarray) -> np.ndarray:
    """Log brightness and log colour ratios ``[N, C]`` of colours ``[N, C]``, in units of what one material scatters."""
    log = np.log(np.maximum(colour.astype(np.float64), DARKEST))
    light = log.mean(axis=1, keepdims=True)
    return np.concatenate([light / LIGHT_NOISE, (log - light)[:, :-1] / CHROMA_NOISE], axis=1)


def cluster_endmembers(
    colour: np.ndarray, known: np.ndarray, most: int = 8, seed: int = 0, blur: float = 1.5
) -> np.ndarray:
    """Abundances ``[H, W, K]`` (sum 1) of K <= ``most`` materials: a Gaussian mixture of colours, K by BIC.

    Args:
        colour: ``[H, W, C]`` albedo without shading, as far as that is known.
        known: ``[H, W]`` bool, cells whose colour is known; the others, in shade, belong to what lies nearest.
        most: largest K.
        seed: of the random start.
        blur: standard deviation of the smoothing of the abundances [cells]: materials form patches.
    """
    from scipy.ndimage import distance_transform_edt, gaussian_filter

    rows, cols, bands = colour.shape
    # logs of noise scatter: average them over some cells, but not over those of unknown colour
    mass = known.astype(np.float64)
    share = np.maximum(gaussian_filter(mass, 1.0), 1e-6)
    smooth = np.stack([gaussian_filter(mass * colour[..., b], 1.0) / share for b in range(bands)], axis=-1)
    x = features(smooth.reshape(-1, bands))
    rng = np.random.default_rng(seed)
    chosen = np.flatnonzero(known.ravel() & np.isfinite(x).all(axis=1))
    if len(chosen) < 10 * bands:
        return np.ones((rows, cols, 1), np.float32)
    sample = x[rng.permutation(chosen)[:SAMPLE]]
    fits = [_mixture(sample, k, rng) for k in range(1, most + 1)]
    centre, spread, weight, _ = min(fits, key=lambda fit: fit[3])
    abundances = np.exp(_log_posterior(x, centre, spread, weight)).reshape(rows, cols, -1)
    if not known.all():
        nearest = distance_transform_edt(~known, return_distances=False, return_indices=True)
        abundances = abundances[tuple(nearest)]
    abundances = np.stack([gaussian_filter(abundances[..., k], blur) for k in range(abundances.shape[-1])], axis=-1)
    return np.asarray((abundances / abundances.sum(axis=-1, keepdims=True)).astype(np.float32))


def _log_density(x: np.ndarray, centre: np.ndarray, spread: np.ndarray, weight: np.ndarray) -> np.ndarray:
    """Log of weight times normal density ``[N, K]``, diagonal covariances ``spread**2``."""
    # the square written out: two products of matrices instead of an array of all differences
    precision = 1 / spread**2
    d2 = x**2 @ precision.T - 2 * (x @ (centre * precision).T) + (centre**2 * precision).sum(-1)
    return np.asarray(np.log(weight) - 0.5 * d2 - np.log(spread).sum(-1) - 0.5 * x.shape[1] * np.log(2 * np.pi))


def _log_posterior(x: np.ndarray, centre: np.ndarray, spread: np.ndarray, weight: np.ndarray) -> np.ndarray:
    joint = _log_density(x, centre, spread, weight)
    top = joint.max(axis=1, keepdims=True)
    return np.asarray(joint - top - np.log(np.exp(joint - top).sum(axis=1, keepdims=True)))


def _mixture(x: np.ndarray, k: int, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray, np.ndarray, float]:
    """Centres, spreads, weights of a mixture by expectation maximisation, and its BIC."""
    centre = x[rng.integers(len(x))][None]
    for _ in range(1, k):  # k-means++ (Arthur & Vassilvitskii 2007)
        d2 = ((x[:, None] - centre) ** 2).sum(-1).min(axis=1)
        share = d2 / d2.sum() if d2.sum() > 0 else np.full(len(x), 1 / len(x))
        centre = np.vstack([centre, x[rng.choice(len(x), p=share)]])
    spread, weight = np.ones((k, x.shape[1])), np.full(k, 1 / k)
    for _ in range(ROUNDS):
        share = np.exp(_log_posterior(x, centre, spread, weight))
        mass = share.sum(axis=0) + 1e-9
        weight = mass / mass.sum()
        centre = share.T @ x / mass[:, None]
        variance = share.T @ x**2 / mass[:, None] - centre**2
        # no narrower than what one material scatters
        spread = np.sqrt(np.maximum(variance, 1.0))
    joint = _log_density(x, centre, spread, weight)
    top = joint.max(axis=1)
    likelihood = float((top + np.log(np.exp(joint - top[:, None]).sum(axis=1))).sum())
    # neighbouring cells repeat each other: a quarter of them counts
    return centre, spread, weight, -2 * likelihood / 4 + (2 * x.shape[1] + 1) * k * np.log(len(x) / 4)


__all__ = ["cluster_endmembers", "features"]
