"""Smoothness of the height map, refinement of poses, the schedule, and the surface on finer grids."""

from typing import Any

import numpy as np
import pytest
import torch
from scipy.ndimage import gaussian_filter, map_coordinates

from sattools.errors import SceneError
from sattools.fit.options import FitOptions
from sattools.fit.surface.pose import image_shift, remove_gauge
from sattools.fit.surface.scene import SurfaceScene, start_scene
from sattools.fit.surface.schedule import schedule
from sattools.fit.surface.smoothness import edge_weights, smoothness_penalty


def plane(rows: Any = 20, cols: Any = 24, east: Any = 0.7, south: Any = -0.3) -> Any:
    row, col = torch.meshgrid(torch.arange(rows) + 0.5, torch.arange(cols) + 0.5, indexing="ij")
    return (5 + east * col + south * row).double()


def test_second_differences_leave_a_tilted_plane_alone() -> None:
    # sqrt(scale^2 + 0) - scale and the plane's own rounding
    assert float(smoothness_penalty(plane(), 1.0, first=0.0)) == pytest.approx(0, abs=1e-9)
    assert float(smoothness_penalty(plane(), 1.0)) > 0.01


def test_flat_ground_is_perfectly_smooth() -> None:
    assert float(smoothness_penalty(torch.full((9, 9), -21.0), 0.5)) == 0


def test_noise_is_rougher_than_the_plane_it_lies_on() -> None:
    noisy = plane() + 0.5 * torch.randn(20, 24, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    assert float(smoothness_penalty(noisy, 1.0)) > float(smoothness_penalty(plane(), 1.0)) + 0.1


def test_ties_are_weak_where_the_albedo_steps_and_strong_within_a_surface() -> None:
    albedo = torch.full((10, 12, 3), 0.1)
    albedo[:, 6:] = 0.5
    edge_aware = edge_weights(albedo)
    assert edge_aware.along.shape == (10, 11)
    assert edge_aware.down.shape == (9, 12)
    assert float(edge_aware.down.min()) == 1
    assert float(edge_aware.along[:, 5].max()) < 0.06
    assert float(edge_aware.along[:, :5].min()) == float(edge_aware.along[:, 6:].min()) == 1


def test_a_wall_where_the_albedo_steps_costs_less_than_one_on_plain_ground() -> None:
    albedo = torch.full((10, 12, 3), 0.1)
    albedo[:, 6:] = 0.5
    edge_aware = edge_weights(albedo)
    costs = []
    for column in (6, 3):
        height = torch.zeros(10, 12)
        height[:, column:] = 8.0
        costs.append(float(smoothness_penalty(height, 1.0, edge_aware)))
    assert costs[0] < 0.2 * costs[1]


@pytest.mark.parametrize("shift", [(0.3, -0.45), (-0.6, 0.2), (0.0, 0.0)])
def test_a_shift_of_a_part_of_a_cell_is_found(shift: Any) -> None:
    """rendered(x + d) = target(x), to 5 %: the linear step leaves out the image's curvature."""
    image = gaussian_filter(np.random.default_rng(0).normal(size=(80, 90)), 3) * 3
    rows, cols = np.mgrid[:80, :90].astype(float)
    target = map_coordinates(image, [rows + shift[1], cols + shift[0]], order=3, mode="nearest")
    weight = np.zeros((80, 90))
    weight[5:-5, 5:-5] = 1
    found = image_shift(image[..., None], target[..., None], weight)
    assert found == pytest.approx(shift, abs=0.03)


def test_an_image_without_structure_is_not_moved() -> None:
    flat = np.full((20, 20, 3), 0.4)
    assert image_shift(flat, flat + 0.1, np.ones((20, 20))).tolist() == [0, 0]
    stripes = np.tile(np.sin(np.arange(20.0)), (20, 1))[..., None]  # nothing tells rows apart
    assert image_shift(stripes, stripes + 0.1, np.ones((20, 20))).tolist() == [0, 0]


def test_pixels_without_weight_have_no_say() -> None:
    image = gaussian_filter(np.random.default_rng(0).normal(size=(60, 60)), 3)[..., None]
    target = image.copy()
    target[:, 30:] = 7.0
    weight = np.ones((60, 60))
    weight[:, 29:] = 0
    assert image_shift(image, target, weight) == pytest.approx([0, 0], abs=1e-12)


def test_a_common_shift_and_a_common_height_are_left_to_the_surface() -> None:
    slopes = [(0.1, 0.2), (-0.3, 0.05), (0.4, -0.2), (0.0, -0.35)]
    common = np.array([[1.2, -0.7]] * 4) - 2.5 * np.array(slopes)
    assert remove_gauge(common, slopes) == pytest.approx(np.zeros((4, 2)), abs=1e-12)


def test_what_the_images_do_tell_is_kept() -> None:
    slopes = [(0.1, 0.2), (-0.3, 0.05), (0.4, -0.2), (0.0, -0.35)]
    own = remove_gauge(np.random.default_rng(0).normal(size=(4, 2)), slopes)
    assert np.abs(own).max() > 0.1
    common = np.array([[1.2, -0.7]] * 4) - 2.5 * np.array(slopes)
    assert remove_gauge(own + common, slopes) == pytest.approx(own, abs=1e-12)


def test_stages_halve_the_cell_down_to_the_finest() -> None:
    options = FitOptions(coarsest=4.0, resolution=0.5, epochs=[9, 5], softness=[1.5, 0.5])
    stages = schedule(options, 0.25, (-30.0, 20.0), with_prior=False)
    assert [s.cell_size for s in stages] == [4, 2, 1, 0.5]
    assert [s.epochs for s in stages] == [9, 5, 5, 5]
    assert [s.softness for s in stages] == [(6.0, 2.0), (3.0, 1.0), (1.5, 0.5), (0.75, 0.25)]
    assert {s.z_range for s in stages} == {(-30.0, 20.0)}


def test_the_surface_has_twice_the_cell_of_the_scene_and_a_prior_spares_the_coarse_stages() -> None:
    assert [s.cell_size for s in schedule(FitOptions(), 0.5, (0.0, 1.0), with_prior=True)] == [1.0]
    assert [s.cell_size for s in schedule(FitOptions(), 0.5, (0.0, 1.0), with_prior=False)] == [4.0, 2.0, 1.0]


def test_a_matched_surface_needs_fewer_passes_unless_more_is_sought() -> None:
    def passes(with_prior: bool = True, relative: bool = False, **given: Any) -> list[int]:
        return [s.epochs for s in schedule(FitOptions(**given), 0.5, (0.0, 1.0), with_prior, relative=relative)]

    assert passes() == [8]
    assert passes(relative=True) == [5]
    assert passes(relative=True, brdf="rpv") == [2, 6]
    assert passes(with_prior=False) == passes(with_prior=False, relative=True) == [16, 16, 16]
    assert passes(shadow="learned") == passes(shadow="auto") == passes(transient="on") == [16]
    assert passes(brdf="auto") == [8]
    assert passes(brdf="hapke") == [2, 6]  # a quarter of them without the model
    assert passes(epochs=[3]) == [3]


def test_the_coarsest_stage_is_no_coarser_than_asked_for() -> None:
    options = FitOptions(coarsest=4.0, resolution=0.3)
    assert [s.cell_size for s in schedule(options, 0.3, (0.0, 1.0), False)] == [2.4, 1.2, 0.6, 0.3]
    options = FitOptions(coarsest=1.0, resolution=2.0)
    assert [s.cell_size for s in schedule(options, 2.0, (0.0, 1.0), False)] == [2.0]


def test_a_small_area_has_no_stages_of_next_to_no_cells() -> None:
    """16 m: cells of 4 m are four along a side, cells of 8 m would be two."""
    stages = schedule(FitOptions(), 0.5, (0.0, 1.0), False, shortest_m=16.0)
    assert [s.cell_size for s in stages] == [4.0, 2.0, 1.0]
    stages = schedule(FitOptions(resolution=4.0), 0.5, (0.0, 1.0), False, shortest_m=16.0)
    assert [s.cell_size for s in stages] == [4.0]


@pytest.mark.parametrize("wrong", [{"softness": [1.0, -1.0]}, {"epochs": [0]}])
def test_a_schedule_that_cannot_be_is_refused(wrong: Any) -> None:
    with pytest.raises(SceneError, match="expected"):
        schedule(FitOptions(**wrong), 0.5, (0.0, 1.0), False)


def surface(height: Any) -> Any:
    shape = tuple(height.shape)
    colour = torch.tensor([[1.0, 1.0, 1.0], [0.9, 1.1, 1.0]])
    return start_scene(height, torch.full((*shape, 3), 0.2), colour, torch.tensor([[0.0] * 3, [0.01] * 3]), 0.4)


def test_a_plane_stays_a_plane_on_a_finer_grid() -> None:
    coarse = surface(plane(10, 12).float())
    fine = coarse.resized((20, 24), (0.5, 0.5))
    row, col = torch.meshgrid((torch.arange(20) + 0.5) / 2, (torch.arange(24) + 0.5) / 2, indexing="ij")
    expected = 5 + 0.7 * col - 0.3 * row
    # the outermost fine cells lie outside the coarse centres, where the surface is continued flat
    assert fine.height[1:-1, 1:-1].numpy() == pytest.approx(expected[1:-1, 1:-1].numpy(), abs=1e-4)
    assert torch.isfinite(fine.height).all()
    assert fine.albedo.shape == (20, 24, 3)
    assert fine.albedo.numpy() == pytest.approx(0.2, abs=1e-6)
    assert torch.equal(fine.gain, coarse.gain)


def test_a_finer_grid_that_does_not_divide_keeps_the_upper_left_corner() -> None:
    coarse = surface(plane(10, 12).float())
    fine = coarse.resized((19, 23), (0.5, 0.5))
    assert float(fine.height[8, 8]) == pytest.approx(5 + 0.7 * 4.25 - 0.3 * 4.25, abs=1e-4)


def test_colour_is_gain_times_light_times_albedo_plus_offset() -> None:
    scene: SurfaceScene = surface(torch.zeros(2, 2))
    scene.ambient[1] = torch.tensor([0.3, 0.4, 0.5])
    lit = scene.colour(1, torch.tensor([[1.0, 0.0], [0.5, 1.0]]))
    assert lit[0, 0].tolist() == pytest.approx([0.9 * 0.2 + 0.01, 1.1 * 0.2 + 0.01, 0.2 + 0.01])
    assert lit[0, 1].tolist() == pytest.approx([0.9 * 0.06 + 0.01, 1.1 * 0.08 + 0.01, 0.1 + 0.01])
    assert lit[1, 0].tolist() == pytest.approx([0.9 * 0.13 + 0.01, 1.1 * 0.14 + 0.01, 0.15 + 0.01])
    assert torch.equal(scene.colour(0, None), scene.albedo)
