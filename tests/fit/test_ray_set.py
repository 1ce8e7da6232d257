"""Rays of many views, held without what they share, and the time that reading their field off takes."""

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch

from sattools.camera.view_direction import ViewDirection
from sattools.fit.depth_prior import DepthPrior, depth_std_m
from sattools.fit.options import FitOptions
from sattools.fit.rays import job as rays_job
from sattools.fit.rays.maps import rows_at_once
from sattools.fit.rays.start import ray_set
from sattools.fit.trace import Trace
from sattools.progress import silent
from sattools.scene import Grid
from sattools.views import View

GRID = Grid("EPSG:32633", 0.0, 0.0, 1.0, 12, 10)
Z_RANGE, Z_REF = (-5.0, 25.0), 3.0
SLOPES = (ViewDirection(0.4, -0.2), ViewDirection(-0.1, 0.3), ViewDirection(0.0, 0.0))


def views() -> list[View]:
    """Three views of random pixels, a quarter of which are masked; the last has no sun."""
    rng = np.random.default_rng(0)
    shape = GRID.shape
    return [
        View(
            str(k), rng.random((*shape, 3), np.float32), (rng.random(shape) > 0.25).astype(np.uint8), slope, Z_REF,
            None if k == 2 else (0.0, 0.6, 0.8), 0.0,
        )
        for k, slope in enumerate(SLOPES)
    ]  # fmt: skip


def level_prior(height: float = 7.0) -> DepthPrior:
    return DepthPrior(torch.full(GRID.shape, height), torch.full(GRID.shape, 0.5), GRID)


def test_every_seen_pixel_is_a_ray_through_its_cell_on_the_reference_plane() -> None:
    given = views()
    rays = ray_set(given, GRID, Z_RANGE, level_prior())
    everything = torch.arange(len(rays.target))
    batch = rays.batch(everything)
    share = (Z_RANGE[1] - Z_REF) / (Z_RANGE[1] - Z_RANGE[0])
    at = batch.points(torch.full((len(everything), 1), share))[:, 0].numpy()
    first = 0
    for k, view in enumerate(given):
        row, col = np.nonzero(view.mask)
        part = slice(first, first + len(row))
        first = part.stop
        expected = np.stack([col + 0.5, -(row + 0.5), np.full(len(row), Z_REF)], axis=1)
        assert at[part] == pytest.approx(expected, abs=1e-4)
        assert np.array_equal(rays.target[part].numpy(), view.target[view.mask > 0])
        assert set(rays.view[part].tolist()) == {k}
        # along the line of sight, from the highest height to the lowest
        fall = Z_RANGE[1] - Z_RANGE[0]
        assert batch.path[part][0].tolist() == pytest.approx([-fall * view.slope.east, -fall * view.slope.north, -fall])
    assert first == len(everything)
    assert torch.isnan(rays.suns[2]).all()


def test_the_priors_surface_lies_at_its_depth_within_its_standard_deviation() -> None:
    rays = ray_set(views(), GRID, Z_RANGE, level_prior())
    inside = rays.confidence > 0
    assert rays.with_depth
    assert inside.any()
    chosen = torch.nonzero(inside)[:, 0]
    height = rays.batch(chosen).points(rays.depth[chosen][:, None])[:, 0, 2]
    assert (height - 7.0).abs().median() < 0.2
    std = rays.depth_std(chosen) * (Z_RANGE[1] - Z_RANGE[0])
    assert std == pytest.approx(depth_std_m(rays.confidence[chosen]).numpy(), rel=1e-4)


def test_a_ray_takes_few_bytes_where_no_normals_are_asked_for() -> None:
    with_normals, without = (ray_set(views(), GRID, Z_RANGE, level_prior(), normals=asked) for asked in (True, False))
    assert with_normals.normal is not None
    assert without.normal is None
    held = (without.place, without.target, without.view, without.depth, without.confidence)
    # two numbers for the place, three colours, depth, confidence, and the number of the view
    assert sum(t.numel() * t.element_size() for t in held) == len(without.target) * (2 + 3 + 1 + 1) * 4 + 2 * len(
        without.target
    )
    for one in ("place", "target", "view", "depth", "confidence", "path"):
        assert torch.equal(getattr(with_normals, one), getattr(without, one)), one


def network_on(device: str) -> Any:
    """As much of a network's trainer as reading off asks before it begins."""
    return SimpleNamespace(judged=False, field=None, device=torch.device(device))


def test_a_gpu_is_asked_for_many_columns_at_once_and_a_cpu_for_a_row() -> None:
    """8192 columns; rows of more are read one by one."""
    for cells, rows in ((12, 682), (256, 32), (8192, 1), (20000, 1)):
        grid = Grid("EPSG:32633", 0.0, 0.0, 1.0, cells, 10)
        assert rows_at_once(network_on("cuda"), grid) == rows
        assert rows_at_once(network_on("cpu"), grid) == 1


def test_what_is_compiled_once_does_not_count_as_reading_off(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """Or a field's first fit after an installation would leave its budget to a reading that takes a second."""
    clock, read = {"now": 0.0}, []

    def fake(trainer: Any, grid: Grid, z_range: Any) -> None:
        clock["now"] += 0.1 * grid.height + (0.0 if read else 100.0)
        read.append(grid.height)

    monkeypatch.setattr(rays_job, "read_maps", fake)
    monkeypatch.setattr(rays_job, "time", SimpleNamespace(perf_counter=lambda: clock["now"]))
    job = rays_job.RayJob(tmp_path / "checkpoint", "", network_on("cpu"), GRID, Z_RANGE, Trace())
    assert job._reading_s == pytest.approx(0.1 * GRID.height)
    assert max(read) <= rays_job.ROWS_TRIED


def test_reading_off_that_was_slow_once_does_not_end_a_fit(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """Rows that are read while the machine does something else say nothing of the end of a fit."""
    clock = {"now": 0.0, "row": 10.0}

    def fake(trainer: Any, grid: Grid, z_range: Any) -> None:
        clock["now"] += clock["row"] * grid.height

    monkeypatch.setattr(rays_job, "read_maps", fake)
    monkeypatch.setattr(rays_job, "time", SimpleNamespace(perf_counter=lambda: clock["now"]))
    trace = SimpleNamespace(seconds=lambda: clock["now"])
    job = rays_job.RayJob(tmp_path / "checkpoint", "", network_on("cpu"), GRID, Z_RANGE, trace)
    options = FitOptions(budget=1000.0)
    slow = 10.0 * GRID.height
    assert job._reading_s == pytest.approx(slow)
    clock["now"] = 0.93 * 1000 - slow + 1
    assert job._is_over(options, 1.0)  # it is as slow as ever
    clock["row"] = 0.1
    assert not job._is_over(options, 1.0)
    assert job._reading_s == pytest.approx(0.1 * GRID.height)


class SlowAtFirst:
    """A trainer whose first steps take a second, as they are compiled or recorded, and each later one a hundredth."""

    rest_from, judged, at_rest, unsaid = None, False, False, (0.0, 0.0)
    field, device = None, torch.device("cpu")

    def __init__(self, clock: dict[str, float]) -> None:
        self.clock, self.plans = clock, [0]

    @property
    def steps(self) -> int:
        return self.plans[-1]

    def plan(self, steps: int) -> None:
        self.plans.append(steps)

    def step(self, number: int) -> float:
        self.clock["now"] += 1.0 if number < 5 else 0.01
        return 0.0


def test_the_plan_of_a_budget_does_not_rest_on_its_first_steps(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """Of 100 s: 93 of them, less 5, have room for 8800 steps. By the first five it would be 93, and rates that die."""
    clock = {"now": 0.0}
    trainer = SlowAtFirst(clock)
    trace = SimpleNamespace(seconds=lambda: clock["now"], rows=[])
    job = rays_job.RayJob(tmp_path / "checkpoint", "", trainer, GRID, Z_RANGE, trace)
    monkeypatch.setattr(rays_job, "read_maps", lambda *_: None)
    monkeypatch.setattr(rays_job, "SAVE_EVERY_S", 1e9)
    monkeypatch.setattr(rays_job, "SAVE_EVERY", 10**9)
    notes = job.run(FitOptions(steps=10**6, budget=100.0), silent)
    done = int(notes[0].split("step ")[1].split(" ")[0])
    assert done == pytest.approx(8800, rel=0.01)
    assert trainer.plans[2:4] == [93, 8805]
    assert trainer.steps == pytest.approx(done, rel=0.01)
