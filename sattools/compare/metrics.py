"""Error figures of height maps, parameter maps and images against a reference. Pure functions of arrays, no I/O."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from sattools.compare.perceptual import lpips
from sattools.errors import InputError
from sattools.scene.jsonio import JsonObject

WATER = 9
CLASSES: dict[str, tuple[int, ...]] = {"ground": (2,), "trees": (5,), "buildings": (6,)}
"""Names of the classes scored on their own, and their codes in the class map (ASPRS LAS codes)."""

CLIP_M = 10.0
FILL_METHOD = "nearest"
PIECE = 1 << 20  # cells


def clip_to_reference(predicted: np.ndarray, reference: np.ndarray) -> np.ndarray:
    """`predicted` in metres limited to [lowest - 10 m, highest + 10 m] of the finite reference; NaN stays NaN."""
    return np.clip(predicted, np.nanmin(reference) - CLIP_M, np.nanmax(reference) + CLIP_M)


def fill_holes(predicted: np.ndarray) -> np.ndarray:
    """`predicted` [H, W] [m] with each NaN replaced by the nearest finite height; InputError if there is none."""
    holes = ~np.isfinite(predicted)
    if not holes.any():
        return predicted
    if holes.all():
        raise InputError("prediction: found no height at all, expected at least one")
    from scipy.ndimage import distance_transform_edt

    rows, columns = distance_transform_edt(holes, return_distances=False, return_indices=True)
    filled = predicted.copy()
    filled[holes] = predicted[rows[holes], columns[holes]]
    return filled


def nmad(difference: np.ndarray) -> float:
    """Normalised median absolute deviation 1.4826 median|d - median(d)| [m], the spread that outliers do not move.

    Höhle & Höhle (2009), doi:10.1016/j.isprsjprs.2009.02.003.
    """
    return float(1.4826 * np.median(np.abs(difference - np.median(difference))))


def height_errors(
    predicted: np.ndarray,
    reference: np.ndarray,
    classes: np.ndarray | None = None,
    filled: np.ndarray | None = None,
    measured: np.ndarray | None = None,
) -> JsonObject:
    """Error table of a registered prediction; all arrays [H, W] in metres, NaN = no height.

    Reference cells that are NaN or of class 9 (water) do not count. Errors are over cells with a prediction;
    `completeness`, `within_1m` and `within_2_5m` are shares of *all* counted reference cells, so a hole is never
    within. `completeness` counts cells that were `measured` (bool; default: that have a prediction), whose errors are
    in `measured`; `filled` has those of all counted cells with holes filled from `filled` (default: the nearest
    predicted cell), `mae_filled` their mean. Raises InputError where nothing can be compared.

    Args:
        predicted: ``[H, W]`` heights [m]; NaN = none.
        reference: ``[H, W]`` heights [m]; NaN = none.
        classes: ``[H, W]`` class codes, or None.
        filled: ``[H, W]`` the prediction without holes [m], or None.
        measured: ``[H, W]`` bool, cells that images show; None = all.
    """
    counted = np.isfinite(reference)
    if classes is not None:
        if classes.shape != reference.shape:
            raise InputError(f"class map: found shape {classes.shape}, expected {reference.shape}")
        counted &= classes != WATER
    if not counted.any():
        raise InputError("reference: found no height outside water, expected at least one")
    scored = np.where(counted, reference, np.nan)
    difference = clip_to_reference(predicted, scored) - reference
    seen = counted & np.isfinite(difference)
    if not seen.any():
        raise InputError("prediction: found no height on a cell of the reference, expected at least one")
    total = int(counted.sum())
    known = seen if measured is None else seen & measured
    complete = clip_to_reference(fill_holes(predicted if filled is None else filled), scored)
    everywhere = _errors((complete - reference)[counted])
    del complete, scored
    absolute = np.abs(difference[seen])
    result: dict[str, Any] = _errors(difference[seen])
    result |= {
        "completeness": float(known.sum() / total),
        "within_1m": float((absolute <= 1.0).sum() / total),
        "within_2_5m": float((absolute <= 2.5).sum() / total),
        "mae_filled": everywhere["mae"],
        "filled_by": FILL_METHOD,
        "cells": total,
        "cells_predicted": int(seen.sum()),
        "measured": {**(_errors(difference[known]) if known.any() else _NO_ERRORS), "n": int(known.sum())},
        "filled": {**everywhere, "n": total},
    }
    if classes is not None:
        result["classes"] = {
            name: _class_errors(difference, seen, counted & np.isin(classes, codes)) for name, codes in CLASSES.items()
        }
    return result


_NO_ERRORS: dict[str, Any] = dict.fromkeys(("mae", "rmse", "median", "nmad", "bias"))


def _errors(difference: np.ndarray) -> JsonObject:
    absolute = np.abs(difference)
    # in double precision by pieces, as maps may have a hundred million cells
    pieces = (absolute[k : k + PIECE].astype(np.float64) for k in range(0, absolute.size, PIECE))
    return {
        "mae": float(absolute.mean(dtype=np.float64)),
        "rmse": math.sqrt(sum(float(piece @ piece) for piece in pieces) / absolute.size),
        "median": float(np.median(absolute)),
        "nmad": nmad(difference),
        "bias": float(difference.mean(dtype=np.float64)),
    }


def _class_errors(difference: np.ndarray, seen: np.ndarray, member: np.ndarray) -> JsonObject:
    total, n = int(member.sum()), int((seen & member).sum())
    errors: Mapping[str, Any] = _errors(difference[seen & member]) if n else _NO_ERRORS
    return {**errors, "n": n, "completeness": n / total if total else None}


MAP_FIGURES = ("rmse", "nrmse", "correlation", "nrmse_constant", "nrmse_scaled", "scale", "n")  # of `map_errors`


def map_errors(predicted: np.ndarray, reference: np.ndarray) -> dict[str, float | int | None]:
    """Errors of a parameter map (albedo, w, b, c, theta, ...) over cells finite in both; arrays of one shape.

    `nrmse` = RMSE / mean of the reference; `correlation` Pearson's; `nrmse_constant`: what a constant map at the
    reference's mean would score, so a map above it has found nothing; `nrmse_scaled`: after the one common factor
    `scale` that fits best (least squares), since absolute radiance is often known up to a factor only.
    Raises InputError where shapes differ or nothing is common.
    """
    if predicted.shape != reference.shape:
        raise InputError(f"parameter map: found shape {predicted.shape}, expected {reference.shape}")
    both = np.isfinite(predicted) & np.isfinite(reference)
    if not both.any():
        raise InputError("parameter map: found no cell in common with its reference, expected overlap")
    p, r = predicted[both].astype(np.float64), reference[both].astype(np.float64)
    mean = float(r.mean())
    rmse = float(np.sqrt(((p - r) ** 2).mean()))
    scale = float((p * r).sum() / (p * p).sum()) if (p * p).sum() > 0 else 1.0
    scaled = float(np.sqrt(((scale * p - r) ** 2).mean()))
    varied = all(v.std() > 1e-9 * np.abs(v).max() for v in (p, r))  # rounding alone makes no correlation
    return {
        "rmse": rmse,
        "nrmse": rmse / mean if mean else None,
        "correlation": float(np.corrcoef(p, r)[0, 1]) if varied else None,
        "nrmse_constant": float(r.std() / mean) if mean else None,
        "nrmse_scaled": scaled / mean if mean else None,
        "scale": scale,
        "n": int(both.sum()),
    }


def psnr(image: np.ndarray, reference: np.ndarray, valid: np.ndarray | None = None, peak: float = 1.0) -> float:
    """Peak signal-to-noise ratio in dB of images [B, H, W]; `valid` [H, W] restricts it; inf for equal images.

    Args:
        image: ``[B, H, W]`` in [0, peak].
        reference: ``[B, H, W]`` in [0, peak].
        valid: ``[H, W]`` bool, pixels that count; None = all.
        peak: largest value.
    """
    square = (image.astype(np.float64) - reference) ** 2
    mse = float(square.mean() if valid is None else square[:, valid].mean())
    return 10 * math.log10(peak**2 / mse) if mse > 0 else math.inf


def ssim(image: np.ndarray, reference: np.ndarray, valid: np.ndarray | None = None, peak: float = 1.0) -> float:
    """Structural similarity of images [B, H, W], mean over bands and valid pixels.

    Gaussian window of σ = 1.5 as in Wang et al. (2004), doi:10.1109/TIP.2003.819861.

    Args:
        image: ``[B, H, W]`` in [0, peak].
        reference: ``[B, H, W]`` in [0, peak].
        valid: ``[H, W]`` bool, pixels that count; None = all.
        peak: largest value.
    """
    from scipy.ndimage import gaussian_filter

    def mean(values: np.ndarray) -> np.ndarray:
        # 11 pixels wide, over the pixels of a band
        return np.asarray(gaussian_filter(values, (0.0, 1.5, 1.5), truncate=3.5, mode="reflect"))

    a, b = image.astype(np.float64), reference.astype(np.float64)
    mean_a, mean_b = mean(a), mean(b)
    variance_a, variance_b = mean(a * a) - mean_a**2, mean(b * b) - mean_b**2
    covariance = mean(a * b) - mean_a * mean_b
    c1, c2 = (0.01 * peak) ** 2, (0.03 * peak) ** 2
    likeness = (2 * mean_a * mean_b + c1) * (2 * covariance + c2)
    similarity = likeness / ((mean_a**2 + mean_b**2 + c1) * (variance_a + variance_b + c2))
    return float(similarity.mean() if valid is None else similarity[:, valid].mean())


def image_average(psnr_db: float, ssim_value: float, lpips_value: float | None) -> float | None:
    """AVG = (10^(-PSNR/10) + sqrt(1 - SSIM) + LPIPS) / 3; None without LPIPS, as two terms compare with nothing.

    Args:
        psnr_db: see `psnr` [dB].
        ssim_value: see `ssim`.
        lpips_value: see `lpips`.
    """
    if lpips_value is None:
        return None
    return (10 ** (-psnr_db / 10) + math.sqrt(max(1 - ssim_value, 0.0)) + lpips_value) / 3


def image_geometric_average(psnr_db: float, ssim_value: float, lpips_value: float | None) -> float | None:
    """Geometric mean of the terms of `image_average`, as Barron et al. (2021, arXiv:2103.13415) define it.

    Papers that call their AVG a geometric mean may print, and use, the arithmetic one of `image_average`.

    Args:
        psnr_db: see `psnr` [dB].
        ssim_value: see `ssim`.
        lpips_value: see `lpips`.
    """
    if lpips_value is None:
        return None
    product = 10 ** (-psnr_db / 10) * math.sqrt(max(1 - ssim_value, 0.0)) * max(lpips_value, 0.0)
    return product ** (1 / 3)


def image_errors(
    image: np.ndarray,
    reference: np.ndarray,
    valid: np.ndarray | None = None,
    peak: float = 1.0,
    weights: Sequence[str] = (),
) -> dict[str, float | None]:
    """`psnr`, `ssim`, `lpips`, `avg` of two images [B, H, W] in [0, peak]; `lpips` is None where it is unavailable.

    Pixels outside `valid` [H, W] are set equal before windows are formed, and are not counted.

    Args:
        image: ``[B, H, W]`` in [0, peak].
        reference: ``[B, H, W]`` in [0, peak].
        valid: ``[H, W]`` bool, pixels that count; None = all.
        peak: largest value.
        weights: files with those of LPIPS, see `sattools.compare.perceptual.lpips`.
    """
    if image.shape != reference.shape:
        raise InputError(f"image: found shape {image.shape}, expected {reference.shape}")
    ok = np.isfinite(image).all(axis=0) & np.isfinite(reference).all(axis=0)
    if valid is not None:
        ok &= valid
    if not ok.any():
        raise InputError("image: found no valid pixel, expected at least one")
    image, reference = np.where(ok, image, 0.0), np.where(ok, reference, 0.0)
    p, s = psnr(image, reference, ok, peak), ssim(image, reference, ok, peak)
    perceptual = lpips(image, reference, peak, weights)
    return {
        "psnr": p,
        "ssim": s,
        "lpips": perceptual,
        "avg": image_average(p, s, perceptual),
        "avg_geometric": image_geometric_average(p, s, perceptual),
    }
