"""Bundle adjustment finds each view's error, holds the block still against outliers, and says what it did."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from synthetic_views import ALT0, EAST_M, LAT0, LON0, NORTH_M, hills, parallel_rpc, render, texture

from sattools.camera import RPC
from sattools.camera.adjust import adjust
from sattools.camera.bundle import Block, _step, robust_gauge, triangulate
from sattools.camera.tiepoints import TiePointImage, TiePointOptions, find_tie_points
from sattools.camera.tracks import Tracks
from sattools.errors import InputError

RUNS = [(0.3, 0.05), (-0.2, 0.2), (0.0, -0.3), (0.15, 0.3), (-0.3, -0.1), (0.05, 0.02)]
SIZE = (800, 820)


def converging(camera: RPC, distance_m: float) -> RPC:
    """The camera with lines of sight that meet so far above the ground."""
    col, row = camera.col_num.copy(), camera.row_num.copy()
    height = camera.alt_scale / 0.5 / camera.col_scale
    col[5], row[6] = 0.01 * EAST_M / distance_m * height, -0.01 * NORTH_M / distance_m * height
    return replace(camera, col_num=col, row_num=row)


def block(biases: Any, n: Any = 400, noise: Any = 0.2, false: Any = 0.1, matrix: Any = None, seed: Any = 0) -> Any:
    """Cameras with errors, and tracks of true pixels with noise and false matches."""
    rng = np.random.default_rng(seed)
    true = [converging(parallel_rpc(r, size=SIZE), 5e5 + 1e5 * k) for k, r in enumerate(RUNS)]
    raw = [c.shifted(-b[0], -b[1]) for c, b in zip(true, biases, strict=True)]
    east, north, height = rng.uniform(-180, 180, n), rng.uniform(-180, 180, n), rng.uniform(-20, 30, n)
    point, view, pixel = [], [], []
    for k, camera in enumerate(true):
        seen = np.flatnonzero(rng.random(n) < 0.7)
        uv = np.stack(camera.projection(LON0 + east / EAST_M, LAT0 + north / NORTH_M, ALT0 + height), 1)[seen]
        if matrix is not None and k == 2:
            uv = uv @ matrix[:, :2].T + matrix[:, 2]
        uv += rng.normal(0, noise, uv.shape)
        wrong = rng.random(len(uv)) < false
        uv[wrong] += rng.uniform(-15, 15, (wrong.sum(), 2))
        point.append(seen)
        view.append(np.full(len(seen), k))
        pixel.append(uv)
    order = np.lexsort((np.concatenate(view), np.concatenate(point)))
    tracks = Tracks(*(np.concatenate(a)[order] for a in (point, view, pixel)))
    return raw, tracks.kept(np.ones(len(order), bool))[0], np.stack([east, north, height + ALT0], 1)


def run(raw: Any, tracks: Any, model: str = "auto") -> Any:
    names = [f"v{k}" for k in range(len(raw))]
    return adjust(raw, names, [SIZE] * len(raw), tracks, model)


def test_a_correction_is_the_affine_map_of_pixels_that_the_adjustment_has_used() -> None:
    raw, tracks, ground = block(np.zeros((6, 2)), n=50, noise=0.0, false=0.0)
    adjusted = Block(raw, [SIZE] * 6, tracks)
    parameters = np.random.default_rng(1).normal(0, 3, (6, 6))
    points = (ground[: tracks.n_points] - [0, 0, ALT0]) + [1.0, 2.0, 3.0]
    without, corrected = (adjusted.residuals(points, p) for p in (np.zeros((6, 6)), parameters))
    for view in range(6):
        own = tracks.view == view
        seen = tracks.pixel[own] - without[own]  # where the raw camera has the points
        matrix = adjusted.matrix(view, parameters[view][None].repeat(6, axis=0))
        assert tracks.pixel[own] - corrected[own] == pytest.approx(seen @ matrix[:, :2].T + matrix[:, 2], abs=1e-9)
    # the first two numbers move the middle of the image, the others its border by as much more or less
    matrix = adjusted.matrix(0, np.array([[2.0, -1.0, 0.5, 0.0, 0.0, 0.25]]))
    assert matrix @ [(SIZE[1] - 1) / 2, (SIZE[0] - 1) / 2, 1] == pytest.approx([409.5 + 2.0, 399.5 - 1.0])
    assert matrix @ [SIZE[1] - 0.5, SIZE[0] - 0.5, 1] == pytest.approx([819.5 + 2.5, 799.5 - 0.75])


def test_derivatives_are_those_of_the_residuals() -> None:
    raw, tracks, _ = block(np.zeros((6, 2)), n=40)
    adjusted = Block(raw, [SIZE] * 6, tracks)
    rng = np.random.default_rng(2)
    points, parameters = adjusted.start() + rng.normal(0, 3, (tracks.n_points, 3)), rng.normal(0, 3, (6, 6))
    residual, slopes, basis = adjusted.linearised(points, parameters)
    whole = adjusted.residuals(points, parameters)
    assert whole == pytest.approx(residual.T, abs=1e-9)
    for axis in range(3):  # without corrections: a step leaves out that they change with the pixel
        moved = points + 0.01 * np.eye(3)[axis]
        change = adjusted.residuals(moved, np.zeros((6, 6))) - adjusted.residuals(points, np.zeros((6, 6)))
        assert change == pytest.approx(-0.01 * slopes[:, axis].T, abs=1e-4)
    for number in range(6):
        moved = parameters + np.eye(6)[number]
        change = (adjusted.residuals(points, moved) - whole)[:, number % 2]
        assert change == pytest.approx(-basis[number // 2], abs=1e-9)


@pytest.mark.parametrize("affine", [False, True])
def test_a_step_is_that_of_least_squares_with_all_unknowns_at_once(affine: bool) -> None:
    raw, tracks, _ = block(np.random.default_rng(1).normal(0, 2, (6, 2)), n=40)
    adjusted, views, size = Block(raw, [SIZE] * 6, tracks), len(raw), 6 if affine else 2
    points, parameters = triangulate(adjusted, np.zeros((6, 6))), np.zeros((6, 6))
    residual, slopes, basis = adjusted.linearised(points, parameters)
    weight = 1 / (1 + (residual**2).sum(0) / 0.7**2)
    count, rows = len(tracks.point), np.arange(len(tracks.point))
    design = np.zeros((2, count, 3 * tracks.n_points + size * views))
    for axis in (0, 1):
        for k in range(3):
            design[axis, rows, 3 * tracks.point + k] = slopes[axis, k]
        for k in range(size // 2):
            design[axis, rows, 3 * tracks.n_points + size * tracks.view + 2 * k + axis] = basis[k]
    dense = (np.sqrt(weight)[:, None] * design).reshape(2 * count, -1)
    held = np.diag(np.r_[np.tile([1e-6, 1e-6, 1e-3], tracks.n_points), np.tile([0.1, 0.1, *[0.5] * 4][:size], views)])
    both = np.vstack([dense, held]), np.r_[(np.sqrt(weight) * residual).ravel(), np.zeros(len(held))]
    expected = np.linalg.lstsq(*both, rcond=None)[0]
    moved, corrected, _ = _step(adjusted, points, parameters, 0.7, affine)
    found = np.r_[moved.ravel(), corrected[:, :size].ravel()]
    # in pixels: what moves all views and points together moves none of these
    assert design @ found == pytest.approx(design @ expected, abs=1e-4)
    assert np.abs(design @ found).max() > 0.5


def test_a_view_that_is_far_off_is_found_and_does_not_drag_the_others() -> None:
    biases = np.zeros((6, 2))
    biases[3] = (2.0, 36.0)
    raw, tracks, _ = block(biases)
    result = run(raw, tracks)
    shifts = np.array([v.shift_px for v in result.views])
    # The mean of the errors is 6 px; a plain mean of zero would spread that over all views.
    assert np.abs(shifts - biases).max() < 0.1
    assert [v.name for v in result.views if v.outlier] == ["v3"]
    assert any("v3" in r and "36" in r for r in result.notes)
    assert result.views[3].median_before_px > 10
    # 0.2 px noise per axis: median length 0.235 px, less what the points absorb
    assert all(0.1 < v.median_after_px < 0.26 for v in result.views)


def test_corrected_cameras_and_points_agree_with_the_truth() -> None:
    rng = np.random.default_rng(3)
    biases = rng.uniform(-2, 2, (6, 2))
    raw, tracks, truth = block(biases, noise=0.05)
    result = run(raw, tracks)
    east, north = (result.points[:, 0] - LON0) * EAST_M, (result.points[:, 1] - LAT0) * NORTH_M
    # The block as a whole may be moved: only differences between points are observable.
    kept = np.array([np.argmin(np.hypot(truth[:, 0] - e, truth[:, 1] - n)) for e, n in zip(east, north, strict=True)])
    error = result.points[:, 2] - truth[kept, 2]
    assert np.median(np.abs(error - np.median(error))) < 0.15
    col, row = result.rpcs[0].projection(*result.points.T)
    mine = result.tracks.view == 0
    seen = result.tracks.point[mine]
    left = np.hypot(*(np.stack([col, row], 1)[seen] - result.tracks.pixel[mine]).T)
    assert np.median(left) < 0.1


def test_false_matches_are_rejected() -> None:
    raw, tracks, _ = block(np.zeros((6, 2)), false=0.25)
    result = run(raw, tracks)
    share = result.rejected / len(tracks.point)
    assert 0.2 < share < 0.3
    assert result.rms_after_px < 0.4


def test_affine_corrections_are_used_only_where_they_help() -> None:
    stretched = np.array([[1.004, 0.0, -1.6], [0.0, 0.997, 1.2]])  # about 1.6 px at the edges of view 2
    raw, tracks, _ = block(np.zeros((6, 2)), matrix=stretched, false=0.02)
    plain_raw, plain_tracks, _ = block(np.zeros((6, 2)), false=0.02)
    bent, plain = run(raw, tracks), run(plain_raw, plain_tracks)
    assert (bent.model, plain.model) == ("affine", "shift")
    assert bent.rms_after_px < 0.35
    assert run(raw, tracks, model="shift").rms_after_px > 1.2 * bent.rms_after_px


def test_a_view_without_enough_tie_points_keeps_its_camera_and_is_reported() -> None:
    raw, tracks, _ = block(np.zeros((6, 2)))
    few = np.ones(len(tracks.point), bool)
    few[np.flatnonzero(tracks.view == 5)[5:]] = False
    result = run(raw, tracks.kept(few)[0])
    assert result.views[5].shift_px == (0.0, 0.0)
    assert "too few tie points" in result.views[5].note
    assert result.rpcs[5].to_tags() == raw[5].to_tags()


def test_pairs_that_share_one_view_only_keep_the_heights_that_their_cameras_say() -> None:
    raw, tracks, ground = block(np.random.default_rng(1).normal(0, 1, (6, 2)), n=1000, false=0.0)
    # view 0 shows everything, each other one a strip of its own: tie points are blind along the pair's lines of sight
    strip = 1 + np.clip((ground[tracks.point, 0] + 180) // 72, 0, 4)
    kept = tracks.kept((tracks.view == 0) | (tracks.view == strip))[0]
    result = run(raw, kept.kept(kept.sizes()[kept.point] == 2)[0])
    assert max(np.hypot(*v.shift_px) for v in result.views) < 4.0
    assert result.points[:, 2] == pytest.approx(np.full(len(result.points), ALT0 + 5.0), abs=35.0)  # true: -20 to 30 m


def test_two_groups_of_views_without_common_points_are_reported() -> None:
    raw, tracks, _ = block(np.zeros((6, 2)))
    apart = np.where(tracks.view < 3, tracks.point, tracks.point + tracks.n_points)
    order = np.lexsort((tracks.view, apart))
    split = Tracks(apart[order], tracks.view[order], tracks.pixel[order])
    _, numbers = np.unique(split.point, return_inverse=True)
    split = Tracks(numbers, split.view, split.pixel).kept(np.ones(len(order), bool))[0]
    assert any("2 groups" in r for r in run(raw, split).notes)


def test_too_few_tie_points_are_an_error_that_says_what_to_check() -> None:
    raw, tracks, _ = block(np.zeros((6, 2)))
    with pytest.raises(InputError, match="do the images overlap"):
        run(raw, tracks.kept(tracks.point < 5)[0])


def test_unknown_model_is_refused() -> None:
    raw, tracks, _ = block(np.zeros((6, 2)))
    with pytest.raises(InputError, match="expected auto, shift or affine"):
        run(raw, tracks, model="cubic")


def test_the_gauge_takes_out_a_common_movement_of_most_views() -> None:
    design = np.array([[[2, 0, -2 * x], [0, -2, 2 * y]] for x, y in RUNS], float)
    move = np.array([3.0, -1.0, 40.0])
    shift = design @ move
    shift[0] += (30.0, 0.0)
    assert robust_gauge(shift, design) == pytest.approx(move, abs=0.5)


def test_the_report_names_views_and_the_figures_are_plain_json() -> None:
    import json

    raw, tracks, _ = block(np.zeros((6, 2)))
    result = run(raw, tracks)
    text = result.to_text()
    assert "median residual" in text
    assert all(f"v{k} " in text for k in range(6))
    assert json.loads(json.dumps(result.to_dict()))["views"][2]["id"] == "v2"


def test_images_to_corrected_cameras() -> None:
    ground = texture()
    bias = [(0.0, 0.0), (1.0, -0.5), (0.0, 0.0), (-12.0, 20.0)]
    views = []
    for k, (r, b) in enumerate(zip(RUNS[:4], bias, strict=True)):
        image = render(ground, r) * (1.0 + 0.3 * k) + 10.0 * k
        views.append(TiePointImage(f"v{k}", image, parallel_rpc(r).shifted(*b)))
    tracks = find_tie_points(views, "EPSG:32633", TiePointOptions(max_height_m=60, max_bias_px=40))
    result = adjust([v.rpc for v in views], [v.name for v in views], [(240, 260)] * 4, tracks)
    # Corrections undo the errors up to one common movement of the ground.
    undone = np.array([v.shift_px for v in result.views]) + np.array(bias)
    design = np.array([[[2, 0, -2 * x], [0, -2, 2 * y]] for x, y in RUNS[:4]], float)
    common = np.linalg.lstsq(design.reshape(-1, 3), undone.ravel(), rcond=None)[0]
    assert np.abs(undone - design @ common).max() < 0.1
    assert result.median_after_px < 0.2
    east, north = (result.points[:, 0] - LON0) * EAST_M, (result.points[:, 1] - LAT0) * NORTH_M
    away = result.points[:, 2] - ALT0 - hills(east - common[0], north - common[1])
    assert np.median(np.abs(away - np.median(away))) < 0.5


@pytest.fixture(scope="module")
def jax_068(data_dir: Any) -> Any:
    import rasterio

    views = []
    for path in sorted((data_dir / "dfc2019/Track3-RGB-crops/JAX_068").glob("*.tif")):
        with rasterio.open(path) as image:
            views.append(TiePointImage(path.stem, image.read().mean(0).astype(np.float32), RPC.from_file(path)))
    return views


@pytest.mark.slow
def test_jax_068_raw_cameras(jax_068: Any) -> None:
    from sattools.camera.heights import estimate_height_range

    tracks = find_tie_points(jax_068, "EPSG:32617")
    cameras, names = [v.rpc for v in jax_068], [v.name for v in jax_068]
    result = adjust(cameras, names, [v.gray.shape for v in jax_068], tracks)
    assert result.median_after_px <= 0.4
    assert [v.name for v in result.views if v.outlier] == ["JAX_068_016_RGB"]
    outlier = next(v for v in result.views if v.outlier)
    assert np.hypot(*outlier.shift_px) == pytest.approx(37.5, abs=2.0)
    assert outlier.median_after_px <= 0.4
    assert min(v.tie_points for v in result.views) > 500
    low, high = estimate_height_range(
        result.heights(),
        [v.gray for v in jax_068],
        result.rpcs,
        "EPSG:32617",
        (436079.0, 3357496.0, 436335.0, 3357752.0),
    )
    assert low < -26.0  # lidar: -26 ... 29 m
    assert high > 29.0
    assert high - low <= 110.0
