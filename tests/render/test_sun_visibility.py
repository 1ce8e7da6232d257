"""Cast shadows of a height map, by hand and against the ray tracer of the simulator."""

import math
from typing import Any

import numpy as np
import pytest
import torch

from sattools.camera.ground import grid_direction, project, to_geographic
from sattools.camera.rpc import RPC
from sattools.render import plate_slopes, reference, sun_visibility
from sattools.scene.raster import read_image, read_raster


def sun_at(azimuth_deg: Any, elevation_deg: Any) -> Any:
    """Unit vector (east, north, up), azimuth clockwise from north."""
    a, e = math.radians(azimuth_deg), math.radians(elevation_deg)
    return math.sin(a) * math.cos(e), math.cos(a) * math.cos(e), math.sin(e)


def block(cell: Any = 0.5, size: Any = 160, tall: Any = 12.0) -> Any:
    """A block of 10 m x 10 m in the middle of flat ground."""
    height = torch.full((size, size), -20.0)
    low, high = size // 2 - round(5 / cell), size // 2 + round(5 / cell)
    height[low:high, low:high] += tall
    return height, low, high


@pytest.mark.parametrize("sun", [sun_at(0, 10), sun_at(137, 30), sun_at(271, 80), (0.0, 0.0, 1.0)])
def test_flat_ground_is_lit(sun: Any) -> None:
    assert torch.equal(sun_visibility(torch.full((20, 30), -3.5), 0.5, sun), torch.ones(20, 30))


def test_arrays_are_shaded_as_tensors_are() -> None:
    height, _, _ = block()
    shaded = sun_visibility(height.numpy(), 0.5, sun_at(90, 30))
    assert isinstance(shaded, np.ndarray)
    np.testing.assert_array_equal(shaded, sun_visibility(height, 0.5, sun_at(90, 30)).numpy())
    with pytest.raises(ValueError, match=r"height: found \(1, 160, 160\), expected two axes"):
        sun_visibility(height[None], 0.5, sun_at(90, 30))
    with pytest.raises(TypeError, match="height: found list, expected a tensor or an array"):
        sun_visibility([[0.0]], 0.5, sun_at(90, 30))


def test_a_sun_at_the_zenith_casts_no_shadow() -> None:
    height, _, _ = block()
    assert float(sun_visibility(height, 0.5, (0.0, 0.0, 1.0)).min()) == 1


@pytest.mark.parametrize("elevation", [0.0, -5.0])
def test_nothing_is_lit_by_a_sun_below_the_horizon(elevation: Any) -> None:
    height, _, _ = block()
    assert float(sun_visibility(height, 0.5, sun_at(90, elevation)).max()) == 0


@pytest.mark.parametrize("cell", [0.5, 1.0])
@pytest.mark.parametrize("elevation", [25.0, 45.0, 60.0])
@pytest.mark.parametrize(("azimuth", "step"), [(90, (0, -1)), (270, (0, 1)), (0, (1, 0)), (180, (-1, 0))])
def test_a_shadow_is_as_long_as_the_height_over_the_tangent(cell: Any, elevation: Any, azimuth: Any, step: Any) -> None:
    """Opposite the sun; to a tenth of a cell, as the roof reaches to its edge."""
    height, low, high = block(cell)
    dark = 1 - sun_visibility(height, cell, sun_at(azimuth, elevation))
    middle = height.shape[0] // 2
    line = dark[middle] if step[0] == 0 else dark[:, middle]
    beyond = line[high:] if sum(step) > 0 else line[:low].flip(0)
    assert float(beyond.sum()) * cell == pytest.approx(12 / math.tan(math.radians(elevation)), abs=0.1 * cell)
    ahead = line[:low] if sum(step) > 0 else line[high:]
    assert float(ahead.max()) == 0
    assert float(dark[low:high, low:high].max()) == 0  # the roof is lit


def test_a_slanting_sun_casts_the_shadow_along_its_own_direction() -> None:
    height, low, high = block()
    dark = 1 - sun_visibility(height, 0.5, sun_at(135, 45))  # from the south-east: the shadow falls north-west
    rows, cols = np.nonzero(dark.numpy() > 0.5)
    assert rows.max() < high
    assert cols.max() < high
    # 12 m along the diagonal: 8.5 m north and west of the block's corner, 17 cells
    assert low - rows.min() == pytest.approx(17, abs=1)
    assert low - cols.min() == pytest.approx(17, abs=1)


def test_a_slope_away_from_a_low_sun_is_in_shadow_and_one_towards_it_is_lit() -> None:
    ramp = torch.arange(40.0).expand(30, 40) * 1.0  # rises eastwards by 45 degrees
    assert float(sun_visibility(ramp, 1.0, sun_at(270, 30)).min()) == 1
    # the first and last rows and the eastern end have sun rays that leave the map
    assert float(sun_visibility(ramp, 1.0, sun_at(90, 30))[1:-1, :30].max()) == 0


def test_plates_slope_where_both_neighbours_agree_and_are_level_beside_a_wall() -> None:
    profile = torch.tensor([0.0, 0.5, 1.0, 1.5, 9.0, 9.0, 9.0, 8.8, 8.4])
    east, south = plate_slopes(profile.expand(4, 9))
    assert east[1].tolist() == pytest.approx([0, 0.5, 0.5, 0.5, 0, 0, 0, -0.2, 0])
    assert float(south.abs().max()) == 0
    assert torch.equal(plate_slopes(profile[:, None].expand(9, 4))[1][:, 1], east[1])


def test_light_grows_with_the_receiver_and_falls_with_the_caster() -> None:
    """Where the edge of a shadow lies, gradients are finite differences and have the right signs."""
    height = torch.zeros(1, 60).repeat(3, 1)
    height[:, 40] = 9.6
    sun = sun_at(90, 40)
    h = height.clone().requires_grad_()
    light = sun_visibility(h, 1.0, sun)
    edge = [c for c, value in enumerate(light[1, :40].tolist()) if 0.02 < value < 0.98]
    assert len(edge) == 1  # the wall stands at 39.5, and 39.5 - 9.6 / tan 40 = 28.06
    assert edge[0] == 28
    (gradient,) = torch.autograd.grad(light[1, edge[0]], h)
    assert float(gradient[1, edge[0]]) > 0
    assert float(gradient[1, 40]) < 0
    assert float(gradient[0].abs().max()) == float(gradient[2].abs().max()) == 0
    for column in (edge[0], 40):
        raised, lowered = height.clone(), height.clone()
        raised[1, column] += 0.02
        lowered[1, column] -= 0.02
        change = sun_visibility(raised, 1.0, sun)[1, edge[0]] - sun_visibility(lowered, 1.0, sun)[1, edge[0]]
        assert float(gradient[1, column]) == pytest.approx(float(change) / 0.04, rel=0.02)


def test_double_precision_in_is_double_precision_out() -> None:
    assert sun_visibility(torch.zeros(4, 4, dtype=torch.float64), 1.0, sun_at(10, 20)).dtype == torch.float64


def test_shadows_of_the_true_surface_are_those_that_the_ray_tracer_saw(town_source: Any) -> None:
    """Intersection over union of cast shadow, pooled over the views, on ground that both can know of.

    Compared are cells that a view sees and whose sun ray rises above the highest roof inside the map: what stands
    around the map casts shadows into it, too. A pixel stands for some four cells, so edges are off by about one.
    """
    heights, grid = read_raster(town_source.path(town_source.products["truth_dsm"]))
    truth = heights[0]
    east, north = np.meshgrid(grid.x(), grid.y())
    lon, lat = (float(v) for v in to_geographic(grid.crs, east.mean(), north.mean()))
    west, south, right, top = grid.bounds
    both, either = 0, 0
    for item in town_source.items:
        rpc = RPC.from_file(town_source.path(item.assets["rpc"].href))
        lit, seen = (read_image(town_source.path(item.assets[n].href))[0] for n in ("truth_lit", "truth_height"))
        col, row = (np.rint(v).astype(int) for v in project(rpc, grid.crs, east, north, truth))
        sun = grid_direction(*item.sun, grid.crs, lon, lat)
        found = sun_visibility(torch.from_numpy(truth.astype(np.float32)), grid.cell_size, tuple(sun)).numpy()
        clear = (truth.max() - truth) / sun[2]  # way along the ray until it is above everything
        x, y = east + clear * sun[0], north + clear * sun[1]
        use = (x > west) & (x < right) & (y > south) & (y < top) & (np.abs(seen[row, col] - truth) < 0.1)
        mine, theirs = (found < 0.5) & use, (lit[row, col] < 0.5) & use
        both += (mine & theirs).sum()
        either += (mine | theirs).sum()
    assert either > 5000
    assert both / either >= 0.9


@pytest.mark.parametrize("azimuth", [0, 90, 137, 222.5, 300])
@pytest.mark.parametrize(("left", "above"), [(1, 0), (13, 3), (32, 1), (45, 2)])
def test_a_shadow_does_not_depend_on_where_in_the_map_it_lies(azimuth: Any, left: Any, above: Any) -> None:
    """Cells are worked on in blocks of a row; low ground beside the map moves the borders of the blocks."""
    rng = np.random.default_rng(5)
    height = np.zeros((37, 70), np.float32)
    height[3:-3, 3:-3] = rng.normal(size=(31, 64))
    height[10:20, 25:45] += 9
    height[22:30, 6:14] += 14
    weights = torch.from_numpy(rng.normal(size=height.shape)).float()

    def shadows(left: Any, above: Any) -> Any:
        wide = np.pad(height, ((above, 0), (left, 0)), constant_values=0)
        surface = torch.from_numpy(wide).requires_grad_()
        lit = sun_visibility(surface, 1.0, sun_at(azimuth, 35))[above:, left:]
        (lit * weights).sum().backward()
        return lit.detach(), surface.grad[above:, left:]

    for moved, still in zip(shadows(left, above), shadows(0, 0), strict=True):
        assert torch.equal(moved, still)


@pytest.mark.parametrize(("azimuth", "elevation"), [(40, 25), (137, 50), (251, 12), (333, 70)])
def test_shadows_are_those_of_the_plain_twin(azimuth: Any, elevation: Any) -> None:
    height = np.random.default_rng(azimuth).uniform(0, 3, (23, 37)).cumsum(axis=1) % 11
    fast = sun_visibility(torch.from_numpy(height).float(), 0.5, sun_at(azimuth, elevation)).numpy()
    slow = reference.sun_visibility(height, 0.5, sun_at(azimuth, elevation))
    assert 0.1 < (slow < 0.5).mean() < 0.9, "else this map proves nothing"
    np.testing.assert_allclose(fast, slow, atol=1e-4)


@pytest.mark.parametrize(("azimuth", "elevation"), [(75, 60), (160, 18), (200, 45), (271, 30), (359, 70)])
def test_what_is_lower_than_all_rays_beside_it_is_passed_unseen(azimuth: Any, elevation: Any) -> None:
    """A tower on one side of ruggedness: most rays have climbed above their surroundings long before they meet it."""
    random = np.random.default_rng(azimuth)
    height = np.round(random.uniform(-3, 3, (24, 90)), 3).astype(np.float32)
    height[8:14, 20:26], height[4:9, 70:75] = 45.0, 25.0
    found = sun_visibility(torch.from_numpy(height), 0.5, sun_at(azimuth, elevation)).numpy()
    expected = reference.sun_visibility(height.astype(np.float64), 0.5, sun_at(azimuth, elevation))
    assert (expected < 0.5).mean() > 0.1
    assert np.abs(found - expected).max() < 1e-3
    assert np.abs(found - expected).mean() < 1e-6


@pytest.mark.parametrize("unknown", [np.nan, np.inf])
def test_a_hole_casts_no_shadow_and_leaves_the_others_where_they_are(unknown: float) -> None:
    height, _, _ = block()
    sun = sun_at(45, 30)
    whole = sun_visibility(height, 0.5, sun)
    height[5:9, 20:40] = unknown
    assert torch.equal(sun_visibility(height, 0.5, sun), whole)
    assert torch.equal(sun_visibility(torch.full((6, 7), unknown), 0.5, sun), torch.ones(6, 7))
