"""Rational polynomial cameras: from ground to pixel and back, in float64.

Conventions: longitude, latitude in degrees (WGS84), heights in metres above the ellipsoid, pixels as (col, row) with
(0, 0) at the centre of the first pixel (GDAL's RPC transformer counts from the corner: it differs by +0.5 in both).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from sattools.camera.rpc_formats import read_rpc_fields
from sattools.camera.rpc_names import SCALARS, VECTORS
from sattools.camera.rpc_polynomials import derivative_coefficients, monomials, with_sloped_height
from sattools.camera.rpc_values import read_members
from sattools.errors import InputError
from sattools.scene.files import write_text
from sattools.scene.location import location

Array = NDArray[np.float64]

_CHUNK = 1 << 14  # points evaluated at once: 20 monomials of a chunk stay in the second-level cache
_MAX_ITERATIONS = 40
_STEP_DEG = 1e-11  # Newton converges quadratically, so the error left after such a step is at rounding level


@dataclass(frozen=True, eq=False)
class RPC:
    """A rational polynomial camera (RPC00B). Offsets and scales in pixels, degrees and metres; coefficients `[20]`."""

    row_offset: float
    col_offset: float
    lat_offset: float
    lon_offset: float
    alt_offset: float
    row_scale: float
    col_scale: float
    lat_scale: float
    lon_scale: float
    alt_scale: float
    row_num: Array
    row_den: Array
    col_num: Array
    col_den: Array

    @classmethod
    def from_file(cls, path: str | Path) -> RPC:
        """Read the camera of an image or of a metadata file.

        GeoTIFF and NITF (anything whose RPC GDAL finds), DIMAP 2 and 3 XML (Pléiades, SPOT, Pléiades Neo),
        DigitalGlobe XML and `.RPB`, `_RPC.TXT` (IKONOS, Planet, SkySat, GDAL) and Sat-NeRF JSON are told apart by
        content, not by name. An image that says which part of a whole it is (NITF's ICHIPB) has the camera of that
        part.
        Raises InputError when the file is missing, unreadable, holds no RPC or an incomplete one.
        """
        return cls.from_tags(read_rpc_fields(location(path)), source=str(path))

    @classmethod
    def from_tags(cls, tags: Mapping[str, Any], source: str = "RPC tags") -> RPC:
        """Build from GDAL's RPC metadata (`LINE_OFF`, ..., `LINE_NUM_COEFF` = 20 numbers as text or sequence).

        Raises InputError (naming `source` as the file) when a member is missing, not finite or of wrong length.
        """
        return cls(**read_members(tags, source))

    # -- ground to pixel ------------------------------------------------------------------------------------------

    def projection(self, lon: ArrayLike, lat: ArrayLike, h: ArrayLike) -> tuple[Any, Any]:
        """Pixel (col, row) of ground points; the arguments broadcast. Scalars in, scalars out.

        Args:
            lon: longitude [degrees].
            lat: latitude [degrees].
            h: height above the ellipsoid [m].
        """
        (x, y, z), shape = self._normalised(lon, lat, h)
        col, row = np.empty(x.size), np.empty(x.size)
        coefficients = self._coefficients
        for start in range(0, x.size, _CHUNK):
            part = slice(start, start + _CHUNK)
            cn, cd, rn, rd = coefficients @ monomials(x[part], y[part], z[part])
            col[part] = cn / cd
            row[part] = rn / rd
        col *= self.col_scale
        col += self.col_offset
        row *= self.row_scale
        row += self.row_offset
        return _shaped(col, shape), _shaped(row, shape)

    def jacobian(self, lon: ArrayLike, lat: ArrayLike, h: ArrayLike) -> Array:
        """Derivatives of (col, row) by (lon, lat, h), `[..., 2, 3]`, in pixels per degree and pixels per metre.

        Args:
            lon: longitude [degrees].
            lat: latitude [degrees].
            h: height above the ellipsoid [m].
        """
        return self.projection_and_jacobian(lon, lat, h)[1]

    def projection_and_jacobian(self, lon: ArrayLike, lat: ArrayLike, h: ArrayLike) -> tuple[Array, Array]:
        """Pixels `[..., 2]` (col, row) and their derivatives `[..., 2, 3]` by (lon, lat, h) in one evaluation.

        Args:
            lon: longitude [degrees].
            lat: latitude [degrees].
            h: height above the ellipsoid [m].
        """
        (x, y, z), shape = self._normalised(lon, lat, h)
        pixel, slopes = self._projected(x, y, z)
        return np.moveaxis(pixel, -1, 0).reshape(*shape, 2), np.moveaxis(slopes, -1, 0).reshape(*shape, 2, 3)

    def projection_and_slopes(self, lon: Array, lat: Array, h: Array) -> tuple[Array, Array]:
        """The same for ``[n]`` points as rows of numbers side by side, `[2, n]` and `[2, 3, n]`, in half the time.

        Args:
            lon: ``[n]`` longitudes [degrees].
            lat: ``[n]`` latitudes [degrees].
            h: ``[n]`` heights above the ellipsoid [m].
        """
        return self._projected(*self._normalised(lon, lat, h)[0])

    # -- pixel to ground ------------------------------------------------------------------------------------------

    def localization(self, col: ArrayLike, row: ArrayLike, h: ArrayLike) -> tuple[Any, Any]:
        """Longitude and latitude (degrees) where the pixel's line of sight meets height `h`; the arguments broadcast.

        Newton's method on the projection itself, so `localization` inverts `projection` to rounding (<= 1e-9 degrees).
        Points where it finds no solution (far outside the camera's validity) become NaN.

        Args:
            col: columns [px].
            row: rows [px].
            h: height above the ellipsoid [m].
        """
        cols, rows, heights = np.broadcast_arrays(*(np.asarray(v, np.float64) for v in (col, row, h)))
        shape = cols.shape
        u = ((cols - self.col_offset) / self.col_scale).ravel()
        v = ((rows - self.row_offset) / self.row_scale).ravel()
        z = ((heights - self.alt_offset) / self.alt_scale).ravel()
        x, y = np.empty(u.size), np.empty(u.size)
        for start in range(0, u.size, _CHUNK):
            part = slice(start, start + _CHUNK)
            x[part], y[part] = self._invert(u[part], v[part], z[part])
        return (
            _shaped(x * self.lon_scale + self.lon_offset, shape),
            _shaped(y * self.lat_scale + self.lat_offset, shape),
        )

    def _invert(self, u: Array, v: Array, z: Array) -> tuple[Array, Array]:
        x, y = np.zeros_like(u), np.zeros_like(u)
        tolerance = _STEP_DEG / max(abs(self.lon_scale), abs(self.lat_scale))
        tolerance = max(tolerance, 4 * np.finfo(np.float64).eps)
        open_ = np.flatnonzero(np.isfinite(u) & np.isfinite(v) & np.isfinite(z))
        done = np.zeros(u.size, bool)
        for _ in range(_MAX_ITERATIONS):
            if open_.size == 0:
                break
            (c, r), ((a, b, _), (d, e, _)) = self._normalised_slopes(x[open_], y[open_], z[open_])
            du, dv = u[open_] - c, v[open_] - r
            with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
                det = a * e - b * d
                step_x, step_y = (e * du - b * dv) / det, (a * dv - d * du) / det
                length = np.hypot(step_x, step_y)
                # A longer step than half the validity cube is not to be trusted: cubic terms would throw it far away.
                damping = np.minimum(1.0, 0.5 / np.maximum(length, 1e-300))
            good = np.isfinite(length)
            x[open_] += np.where(good, step_x * damping, 0.0)
            y[open_] += np.where(good, step_y * damping, 0.0)
            converged = good & (length <= tolerance)
            done[open_[converged]] = True
            open_ = open_[good & ~converged]
        # What rounding keeps from the tolerance is still a solution if the last step was tiny.
        if open_.size:
            (c, r), _ = self._normalised_slopes(x[open_], y[open_], z[open_])
            done[open_] = np.hypot(u[open_] - c, v[open_] - r) < 1e-12
        x[~done] = np.nan
        y[~done] = np.nan
        return x, y

    # -- changed cameras ------------------------------------------------------------------------------------------

    def shifted(self, dcol: float, drow: float) -> RPC:
        """The camera whose projections lie (dcol, drow) pixels further right and down: an image-space bias."""
        return replace(self, col_offset=self.col_offset + float(dcol), row_offset=self.row_offset + float(drow))

    def moved(self, dlon: float, dlat: float, dh: float) -> RPC:
        """The camera that sees at (lon + dlon, lat + dlat, h + dh) what this one sees at (lon, lat, h).

        Args:
            dlon: eastwards [degrees].
            dlat: northwards [degrees].
            dh: upwards [m].
        """
        return replace(
            self,
            lon_offset=self.lon_offset + float(dlon),
            lat_offset=self.lat_offset + float(dlat),
            alt_offset=self.alt_offset + float(dh),
        )

    def tilted(self, lon: float, lat: float, slope: tuple[float, float]) -> RPC:
        """The camera that sees at (p, h + slope · (p - (lon, lat))) what this one sees at (p, h); exact.

        Args:
            lon: of the point whose height stays [degrees].
            lat: of the same [degrees].
            slope: rise along longitude and latitude [m/degree].
        """
        along = slope[0] * self.lon_scale / self.alt_scale, slope[1] * self.lat_scale / self.alt_scale
        (x,), (y,), _ = self._normalised(lon, lat, 0.0)[0]
        down = (-along[0], -along[1])  # what is seen there lay lower before
        terms = with_sloped_height(self._coefficients, down, float(along[0] * x + along[1] * y))
        return replace(self, col_num=terms[0], col_den=terms[1], row_num=terms[2], row_den=terms[3])

    def cropped(self, col0: float, row0: float) -> RPC:
        """The camera of a crop whose first pixel is pixel (col0, row0) of the full image."""
        return self.shifted(-col0, -row0)

    def reduced(self, factor: int) -> RPC:
        """The camera of the image whose pixels are the means of factor x factor pixels of this one."""
        middle = (factor - 1) / 2
        return replace(
            self,
            col_offset=(self.col_offset - middle) / factor,
            row_offset=(self.row_offset - middle) / factor,
            col_scale=self.col_scale / factor,
            row_scale=self.row_scale / factor,
        )

    def with_affine(
        self, matrix: ArrayLike, domain: tuple[float, float, float, float, float, float] | None = None, n: int = 12
    ) -> tuple[RPC, float]:
        """The camera after an affine change of the image, and how well it could be expressed.

        `matrix` `[2, 3]` maps the old (col, row, 1) to the new (col, row). Numerators are refitted by least squares on
        an n³ grid over `domain` (west, south, east, north, lowest, highest; default: the whole validity cube) with
        denominators kept, which is exact for a shift and well conditioned otherwise. Returns (camera, largest
        residual in pixels on a grid between the fitted points).

        Args:
            matrix: ``[2, 3]`` affine map of (col, row) [px].
            domain: (lon, lat, h) from and to in which it is fitted [degrees, m]; None = the camera's own.
            n: number of points along an axis.
        """
        m = np.asarray(matrix, np.float64)
        if m.shape != (2, 3) or not np.isfinite(m).all():
            raise InputError(f"affine image correction: found an array of shape {m.shape}, expected a finite [2, 3]")
        if np.array_equal(m[:, :2], np.eye(2)):
            return self.shifted(m[0, 2], m[1, 2]), 0.0

        def cube(count: int) -> tuple[Array, Array, Array]:
            nodes = np.cos(np.pi * (np.arange(count) + 0.5) / count)  # Chebyshev: even error up to the faces
            if domain is None:
                low, high = -np.ones(3), np.ones(3)
            else:
                w, s, e, t, z0, z1 = domain
                (p, q, k), _ = self._normalised([w, e], [s, t], [z0, z1])
                low, high = np.array([p[0], q[0], k[0]]), np.array([p[1], q[1], k[1]])
            axes = [(lo + hi) / 2 + (hi - lo) / 2 * nodes for lo, hi in zip(low, high, strict=True)]
            x, y, z = (g.ravel() for g in np.meshgrid(*axes, indexing="ij"))
            return x, y, z

        def targets(x: Array, y: Array, z: Array) -> tuple[Array, Array]:
            lon, lat = x * self.lon_scale + self.lon_offset, y * self.lat_scale + self.lat_offset
            col, row = self.projection(lon, lat, z * self.alt_scale + self.alt_offset)
            return m[0, 0] * col + m[0, 1] * row + m[0, 2], m[1, 0] * col + m[1, 1] * row + m[1, 2]

        x, y, z = cube(n)
        basis = monomials(x, y, z)
        new_col, new_row = targets(x, y, z)
        u, v = (new_col - self.col_offset) / self.col_scale, (new_row - self.row_offset) / self.row_scale
        col_num: Array = np.linalg.lstsq(basis.T, u * (self.col_den @ basis), rcond=None)[0].astype(np.float64)
        row_num: Array = np.linalg.lstsq(basis.T, v * (self.row_den @ basis), rcond=None)[0].astype(np.float64)
        fitted = replace(self, col_num=col_num, row_num=row_num)
        x, y, z = cube(n - 1)
        want = targets(x, y, z)
        lon, lat = x * self.lon_scale + self.lon_offset, y * self.lat_scale + self.lat_offset
        got = fitted.projection(lon, lat, z * self.alt_scale + self.alt_offset)
        return fitted, float(np.hypot(got[0] - want[0], got[1] - want[1]).max())

    # -- writing --------------------------------------------------------------------------------------------------

    def to_tags(self) -> dict[str, str]:
        """GDAL's RPC metadata, every number with all its digits."""
        tags = {key: repr(float(getattr(self, name))) for key, name in SCALARS.items()}
        for key, name in VECTORS.items():
            tags[key] = " ".join(repr(float(c)) for c in getattr(self, name))
        return tags

    def to_rpc_txt(self) -> str:
        """The text of a `_RPC.TXT` file as GDAL and other software read it, every number with all its digits."""
        units = {"LINE": "pixels", "SAMP": "pixels", "LAT": "degrees", "LONG": "degrees", "HEIGHT": "meters"}
        lines = [f"{key}: {float(getattr(self, name))!r} {units[key.split('_')[0]]}" for key, name in SCALARS.items()]
        for key, name in VECTORS.items():
            lines += [f"{key}_{i + 1}: {float(c)!r}" for i, c in enumerate(getattr(self, name))]
        return "\n".join(lines) + "\n"

    def write(self, path: str | Path) -> None:
        """Write `to_rpc_txt` to a file (name it `<image>_RPC.TXT` so that GDAL finds it beside the image)."""
        write_text(Path(path), self.to_rpc_txt())

    # -- inner parts ----------------------------------------------------------------------------------------------

    @property
    def altitude_range(self) -> tuple[float, float]:
        """Heights (m) over which the vendor fitted the camera."""
        half = abs(self.alt_scale)
        return self.alt_offset - half, self.alt_offset + half

    @cached_property
    def _coefficients(self) -> Array:
        """`[4, 20]`: numerator and denominator of col, then of row."""
        return np.stack([self.col_num, self.col_den, self.row_num, self.row_den])

    def _normalised(
        self, lon: ArrayLike, lat: ArrayLike, h: ArrayLike
    ) -> tuple[tuple[Array, Array, Array], tuple[int, ...]]:
        lons, lats, heights = np.broadcast_arrays(*(np.asarray(v, np.float64) for v in (lon, lat, h)))
        dlon = lons - self.lon_offset
        if (np.abs(dlon) > 180.0).any():  # a camera near the date line asked with the other sign
            dlon = dlon - 360.0 * np.round(dlon / 360.0)
        x = (dlon / self.lon_scale).ravel()
        y = ((lats - self.lat_offset) / self.lat_scale).ravel()
        z = ((heights - self.alt_offset) / self.alt_scale).ravel()
        return (x, y, z), lons.shape

    def _normalised_slopes(self, x: Array, y: Array, z: Array) -> tuple[Array, Array]:
        """Normalised (col, row) `[2, n]` and their derivatives `[2, 3, n]` by normalised coordinates."""
        terms = monomials(x, y, z)
        values = (self._coefficients @ terms).reshape(2, 2, -1)  # numerator and denominator of col and row
        quotient = values[:, 0] / values[:, 1]
        slopes = (self._derivatives @ terms[:10]).reshape(2, 2, 3, -1)
        slopes[:, 1] *= quotient[:, None]
        slopes[:, 0] -= slopes[:, 1]
        slopes[:, 0] /= values[:, 1, None]
        return quotient, slopes[:, 0]

    def _projected(self, x: Array, y: Array, z: Array) -> tuple[Array, Array]:
        """The same in pixels, and pixels per degree and metre."""
        pixel, slopes = self._normalised_slopes(x, y, z)
        scale = np.array([self.col_scale, self.row_scale])
        pixel *= scale[:, None]
        pixel += np.array([self.col_offset, self.row_offset])[:, None]
        slopes *= (scale[:, None] / np.array([self.lon_scale, self.lat_scale, self.alt_scale]))[:, :, None]
        return pixel, slopes

    @cached_property
    def _derivatives(self) -> Array:
        """Coefficients `[12, 10]` of the derivatives, by polynomial and by coordinate."""
        return np.moveaxis(derivative_coefficients(self._coefficients), 0, 1).reshape(12, 10)


def _shaped(values: Array, shape: tuple[int, ...]) -> Any:
    return float(values[0]) if shape == () else values.reshape(shape)
