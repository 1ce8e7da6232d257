"""Error figures of parameter maps and images against a reference. Pure functions of arrays, no I/O."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from sattools.compare.perceptual import lpips
from sattools.errors import InputError


def nmad(difference: np.ndarray) -> float:
    """Normalised median absolute deviation 1.4826 median|d - median(d)| [m], the spread that outliers do not move.

    Höhle & Höhle (2009), doi:10.1016/j.isprsjprs.2009.02.003.
    """
    return float(1.4826 * np.median(np.abs(difference - np.median(difference))))


WINDOW_PX = 5  # on either side of a pixel that structural similarity looks at
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
    errors = MapErrors()
    for round_ in range(MapErrors.ROUNDS):
        errors.add(round_, predicted, reference)
    return errors.figures()


class MapErrors:
    """`map_errors` of pieces, which are shown in two rounds: means first, then what is about them."""

    ROUNDS = 2

    def __init__(self) -> None:
        self.count = 0
        self._sums = np.zeros(4)  # of p, r, p p, p r
        self._squares = np.zeros(5)  # of p - r, scaled p - r, and about the means p p, r r, p r
        self._largest = np.zeros(2)

    def add(self, round_: int, predicted: np.ndarray, reference: np.ndarray) -> None:
        """Count a piece.

        Args:
            round_: 0 or 1.
            predicted: of the parameter, of any shape.
            reference: of the parameter, of the same shape.
        """
        both = np.isfinite(predicted) & np.isfinite(reference)
        p, r = predicted[both].astype(np.float64), reference[both].astype(np.float64)
        if not p.size:
            return
        if round_ == 0:
            self.count += p.size
            self._sums += p.sum(), r.sum(), p @ p, p @ r
            self._largest = np.maximum(self._largest, [np.abs(p).max(), np.abs(r).max()])
            return
        apart, scaled = p - r, self._scale * p - r
        mean_p, mean_r = self._sums[:2] / self.count
        p, r = p - mean_p, r - mean_r
        self._squares += apart @ apart, scaled @ scaled, p @ p, r @ r, p @ r

    @property
    def _scale(self) -> float:
        _, _, square, product = self._sums.tolist()
        return product / square if square > 0 else 1.0

    def figures(self) -> dict[str, float | int | None]:
        """See `map_errors`."""
        if not self.count:
            raise InputError("parameter map: found no cell in common with its reference, expected overlap")
        mean = float(self._sums[1]) / self.count
        rmse, scaled, std_p, std_r = (math.sqrt(square / self.count) for square in self._squares[:4])
        varied = std_p > 1e-9 * self._largest[0] and std_r > 1e-9 * self._largest[1]  # rounding makes no correlation
        return {
            "rmse": rmse,
            "nrmse": rmse / mean if mean > 0 else None,
            "correlation": float(self._squares[4]) / self.count / (std_p * std_r) if varied else None,
            "nrmse_constant": std_r / mean if mean > 0 else None,
            "nrmse_scaled": scaled / mean if mean > 0 else None,
            "scale": self._scale,
            "n": self.count,
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
    similarity = _similarity_map(image, reference, peak)
    return float(similarity.mean() if valid is None else similarity[:, valid].mean())


def _similarity_map(image: np.ndarray, reference: np.ndarray, peak: float = 1.0) -> np.ndarray:
    """Structural similarity ``[B, H, W]`` of every pixel, see `ssim`; `WINDOW_PX` around it count.

    Args:
        image: ``[B, H, W]`` in [0, peak].
        reference: ``[B, H, W]`` in [0, peak].
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
    return np.asarray(likeness / ((mean_a**2 + mean_b**2 + c1) * (variance_a + variance_b + c2)))


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

    Raises:
        InputError: other shapes, or no valid pixel.
    """
    if image.shape != reference.shape:
        raise InputError(f"image: found shape {image.shape}, expected {reference.shape}")
    if image.ndim != 3:
        raise InputError(f"image: found shape {image.shape}, expected bands, rows and columns")
    if valid is not None and valid.shape != image.shape[1:]:
        raise InputError(f"valid pixels: found shape {valid.shape}, expected {image.shape[1:]}")
    ok = np.isfinite(image).all(axis=0) & np.isfinite(reference).all(axis=0)
    if valid is not None:
        ok &= valid
    if not ok.any():
        raise InputError("image: found no valid pixel, expected at least one")
    image, reference = np.where(ok, image, 0.0), np.where(ok, reference, 0.0)
    p, s = psnr(image, reference, ok, peak), ssim(image, reference, ok, peak)
    return _image_figures(p, s, lpips(image, reference, peak, weights))


def _image_figures(psnr_db: float, ssim_value: float, perceptual: float | None) -> dict[str, float | None]:
    """What `image_errors` gives, of its terms.

    Args:
        psnr_db: see `psnr` [dB].
        ssim_value: see `ssim`.
        perceptual: see `lpips`.
    """
    return {
        "psnr": psnr_db,
        "ssim": ssim_value,
        "lpips": perceptual,
        "avg": image_average(psnr_db, ssim_value, perceptual),
        "avg_geometric": image_geometric_average(psnr_db, ssim_value, perceptual),
    }


class ImageErrors:
    """`image_errors` without LPIPS, of images that are shown in strips of rows; values are in [0, 1]."""

    def __init__(self) -> None:
        self._pixels, self._square, self._similarity, self._bands = 0, 0.0, 0.0, 1

    def add(self, image: np.ndarray, reference: np.ndarray, own: slice) -> None:
        """Count some rows.

        Args:
            image: ``[B, h, W]`` of these rows and `WINDOW_PX` more on either side, where there are so many.
            reference: ``[B, h, W]`` likewise.
            own: the rows that are meant.
        """
        ok = np.isfinite(image).all(axis=0) & np.isfinite(reference).all(axis=0)
        image, reference = np.where(ok, image, 0.0), np.where(ok, reference, 0.0)
        counted = ok[own]
        self._bands = len(image)
        self._pixels += int(counted.sum())
        self._square += float(((image[:, own].astype(np.float64) - reference[:, own]) ** 2)[:, counted].sum())
        self._similarity += float(_similarity_map(image, reference)[:, own][:, counted].sum())

    def figures(self) -> dict[str, float | None]:
        """See `image_errors`."""
        if not self._pixels:
            raise InputError("image: found no valid pixel, expected at least one")
        mse = self._square / (self._bands * self._pixels)
        decibel = -10 * math.log10(mse) if mse > 0 else math.inf
        return _image_figures(decibel, self._similarity / (self._bands * self._pixels), None)
