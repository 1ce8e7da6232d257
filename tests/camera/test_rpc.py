"""An RPC maps ground to pixels as its formula says, back again, and as GDAL does."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rasterio.rpc import RPC as GdalRPC
from rasterio.transform import RPCTransformer
from synthetic_views import ALT0, EAST_M, LAT0, LON0, NORTH_M, cubic_rpc, parallel_rpc

from sattools.camera import RPC
from sattools.errors import InputError


def gdal_pixels(rpc: Any, lon: Any, lat: Any, h: Any) -> Any:
    """GDAL's transformer, moved by the half pixel between its corner and our centre."""
    tags = rpc.to_tags()
    scalars = {k.lower(): float(v) for k, v in tags.items() if k.endswith(("_OFF", "_SCALE"))}
    vectors = {k.lower(): [float(c) for c in v.split()] for k, v in tags.items() if k.endswith("COEFF")}
    with RPCTransformer(GdalRPC(**scalars, **vectors)) as transformer:
        rows, cols = transformer.rowcol(lon, lat, zs=h, op=lambda v: v)
    return np.array(cols) - 0.5, np.array(rows) - 0.5


def scatter(rpc: Any, n: Any = 500, seed: Any = 0) -> Any:
    x, y, z = np.random.default_rng(seed).uniform(-0.8, 0.8, (3, n))
    return (
        rpc.lon_offset + x * rpc.lon_scale,
        rpc.lat_offset + y * rpc.lat_scale,
        rpc.alt_offset + z * rpc.alt_scale,
    )


def test_projection_is_the_formula_of_a_parallel_camera() -> None:
    rpc = parallel_rpc(run=(0.3, -0.2), gsd=0.5, size=(241, 261))
    col, row = rpc.projection(LON0 + 10.0 / EAST_M, LAT0 + 20.0 / NORTH_M, ALT0 + 5.0)
    assert col == pytest.approx(130 + (10.0 - 0.3 * 5.0) / 0.5, abs=1e-9)
    assert row == pytest.approx(120 - (20.0 + 0.2 * 5.0) / 0.5, abs=1e-9)


def test_scalars_give_scalars_and_arrays_broadcast() -> None:
    rpc = cubic_rpc()
    assert isinstance(rpc.projection(15.0, 46.0, 400.0)[0], float)
    col, row = rpc.projection(np.full((3, 1), 15.0), np.full((1, 4), 46.0), 400.0)
    assert col.shape == row.shape == (3, 4)
    assert rpc.localization(np.zeros((2, 1)), np.zeros(3), 0.0)[0].shape == (2, 3)
    assert rpc.projection([], [], [])[0].shape == (0,)


def test_projection_agrees_with_gdal_after_the_half_pixel() -> None:
    rpc = cubic_rpc()
    ground = scatter(rpc)
    for ours, theirs in zip(rpc.projection(*ground), gdal_pixels(rpc, *ground), strict=True):
        assert np.abs(ours - theirs).max() <= 1e-6


def test_localisation_inverts_projection() -> None:
    rpc = cubic_rpc()
    lon, lat, h = scatter(rpc)
    back = rpc.localization(*rpc.projection(lon, lat, h), h)
    assert max(np.abs(back[0] - lon).max(), np.abs(back[1] - lat).max()) <= 1e-9


def test_jacobian_is_the_derivative_of_projection() -> None:
    rpc = cubic_rpc()
    at = np.array([15.02, 46.01, 380.0])
    analytic = rpc.jacobian(*at)
    for axis, step in enumerate((1e-6, 1e-6, 1e-2)):
        ahead, behind = at.copy(), at.copy()
        ahead[axis] += step
        behind[axis] -= step
        numeric = (np.array(rpc.projection(*ahead)) - np.array(rpc.projection(*behind))) / (2 * step)
        # central differences keep about 8 digits here
        assert analytic[:, axis] == pytest.approx(numeric, rel=1e-6, abs=1e-6)
    pixel, same = rpc.projection_and_jacobian(*at)
    assert pixel == pytest.approx(rpc.projection(*at), abs=1e-9)
    assert np.array_equal(same, analytic)


def test_unreachable_and_nan_pixels_localise_to_nan() -> None:
    rpc = cubic_rpc()
    lon, lat = rpc.localization([1e9, np.nan, 10000.0], [0.0, 0.0, 9000.0], 400.0)
    assert np.isnan(lon[:2]).all()
    assert np.isnan(lat[:2]).all()
    assert np.isfinite(lon[2])


def test_a_camera_at_the_date_line_takes_either_sign() -> None:
    tags = cubic_rpc().to_tags() | {"LONG_OFF": "179.99"}
    rpc = RPC.from_tags(tags)
    assert rpc.projection(-179.98, 46.0, 400.0) == pytest.approx(rpc.projection(180.02, 46.0, 400.0), abs=1e-6)


def test_a_crop_sees_the_same_ground_at_moved_pixels() -> None:
    rpc = cubic_rpc()
    col, row = rpc.projection(15.01, 46.01, 300.0)
    assert rpc.cropped(1200, 340).projection(15.01, 46.01, 300.0) == pytest.approx((col - 1200, row - 340), abs=1e-9)
    assert rpc.shifted(1.5, -37.0).projection(15.01, 46.01, 300.0) == pytest.approx((col + 1.5, row - 37.0), abs=1e-9)


def test_an_affine_correction_is_met_by_the_refitted_camera() -> None:
    rpc = cubic_rpc()
    matrix = np.array([[1.0 + 2e-5, -1e-5, 0.7], [3e-5, 1.0 - 1e-5, -2.0]])
    corrected, residual = rpc.with_affine(matrix)
    ground = scatter(rpc, seed=3)
    col, row = rpc.projection(*ground)
    want = matrix @ np.stack([col, row, np.ones_like(col)])
    error = np.abs(np.array(corrected.projection(*ground)) - want).max()
    assert error < 1e-3  # pixels; the correction itself is up to 3 px
    assert error <= 2 * residual + 1e-9
    assert residual < 1e-3  # what is said of the fit is of its size
    same, nothing = rpc.with_affine([[1, 0, 2.0], [0, 1, 3.0]])
    assert nothing == 0.0
    assert (same.col_offset, same.row_offset) == (rpc.col_offset + 2.0, rpc.row_offset + 3.0)


def test_writing_keeps_every_digit_and_gdal_reads_it(tmp_path: Path) -> None:
    import rasterio

    rpc = cubic_rpc().shifted(0.1, 1 / 3)
    path = tmp_path / "image_RPC.TXT"
    rpc.write(path)
    assert RPC.from_file(path).to_tags() == rpc.to_tags()
    with rasterio.open(tmp_path / "image.tif", "w", driver="GTiff", width=8, height=8, count=1, dtype="uint8") as image:
        image.write(np.ones((1, 8, 8), np.uint8))
    with rasterio.open(tmp_path / "image.tif") as image:
        assert RPC.from_tags(image.tags(ns="RPC")).to_tags() == rpc.to_tags()


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"LINE_OFF": None}, "without LINE_OFF"),
        ({"LAT_SCALE": "0"}, "LAT_SCALE = 0"),
        ({"SAMP_OFF": "nan"}, "SAMP_OFF"),
        ({"LINE_DEN_COEFF": "1 2 3"}, "3 usable LINE_DEN_COEFF"),
        ({"LINE_DEN_COEFF": " ".join(["0"] * 20)}, "LINE_DEN_COEFF that are all 0, expected a denominator"),
        (
            {"SAMP_NUM_COEFF": " ".join(["1", "-2e9"] + ["0"] * 18)},
            r"SAMP_NUM_COEFF of up to 2e\+09, expected at most 1e\+09",
        ),
        ({"LAT_OFF": "100.5"}, r"LAT_OFF = 100\.5, expected at most 90 \(latitude and longitude swapped\?\)"),
        ({"LAT_OFF": "-181"}, "LAT_OFF = -181, expected at most 90$"),
        ({"HEIGHT_SCALE": "1e7"}, r"HEIGHT_SCALE = 1e\+07, expected at most 1e\+06$"),
    ],
)
def test_incomplete_tags_are_refused_by_name(change: Any, words: Any) -> None:
    tags = {k: v for k, v in (cubic_rpc().to_tags() | change).items() if v is not None}
    with pytest.raises(InputError, match=words):
        RPC.from_tags(tags, "x.tif")
