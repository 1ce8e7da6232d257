"""What a fit will take is said before it begins, and tiles are chosen by the memory that is free."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch
from click.testing import CliRunner

from sattools.cli import main
from sattools.fit import foresight
from sattools.fit.foresight import chosen_tile, foresee, side_by_side, with_tile
from sattools.fit.options import FitOptions
from sattools.fit.presets import resolve
from sattools.prior import PriorOptions
from sattools.prior.foresight import foresee_matching
from sattools.scene import Grid, Scene, memory

AUTO = FitOptions(tile="auto")
GIB = 2**30


@pytest.fixture
def town(town_source: Scene) -> Scene:
    """Six training images; the area is set by the tests, nothing is read."""
    return Scene.from_json(town_source.to_json())


def of_size(scene: Scene, edge_m: float) -> Scene:
    cells = round(edge_m / 0.5)
    scene.grid = Grid(scene.require_grid().crs, 0.0, edge_m, 0.5, cells, cells)
    return scene


@pytest.mark.parametrize(
    ("edge_m", "free", "tile"),
    [
        (256, 16 * GIB, None),  # fits
        (1000, 64 * GIB, None),
        (3000, 64 * GIB, 1024.0),  # would fit; tiles keep progress
        (3000, 8 * GIB, 512.0),
        (3000, 3 * GIB, 256.0),
        (3000, GIB, 256.0),  # the smallest, whatever it takes
        (400, GIB, 256.0),
        (200, GIB, None),  # no tile is smaller
    ],
)
def test_auto_takes_the_largest_tile_that_half_of_the_free_memory_holds(
    town: Scene, monkeypatch: pytest.MonkeyPatch, edge_m: float, free: int, tile: float | None
) -> None:
    monkeypatch.setattr(memory, "available", lambda: free)
    assert chosen_tile(of_size(town, edge_m), AUTO) == tile


def test_what_was_begun_all_at_once_goes_on_so_whatever_memory_there_is_now(
    town: Scene, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setattr(memory, "available", lambda: GIB)
    monkeypatch.setattr(foresight, "available", lambda: GIB)
    (tmp_path / "fit").mkdir()
    (tmp_path / "fit/checkpoint.safetensors").touch()
    scene = of_size(town, 3000)
    scene.root = tmp_path
    for tile in (None, "auto"):
        assert chosen_tile(scene, FitOptions(tile=tile)) == 256.0
        assert chosen_tile(scene, FitOptions(tile=tile, resume=True)) is None


def test_a_tile_that_is_given_stays(town: Scene) -> None:
    for given, tile in ((300.0, 300.0), (0.0, None), (None, None)):
        options = FitOptions(tile=given)
        assert chosen_tile(town, options) == tile
        assert with_tile(town, options) is options


@pytest.mark.parametrize(("resolution", "gib", "cpu_s"), [(0.5, 0.6, 6.7), (0.25, 0.8, 11), (0.1, 1.7, 39)])
def test_a_fit_on_finer_cells_takes_more(town: Scene, resolution: float, gib: float, cpu_s: float) -> None:
    """131 m, six images, really: 0.50, 0.62 and 1.51 GiB and, while the machine did other work, 6.7, 16 and 88 s."""
    found = foresee(of_size(town, 130), FitOptions(resolution=resolution))
    assert found.memory / GIB == pytest.approx(gib, abs=0.1)
    assert found.cpu_s == pytest.approx(cpu_s, rel=0.4)  # matching besides depends on the heights
    assert foresee(of_size(town, 130), FitOptions(resolution=1.0)) == foresee(of_size(town, 130), FitOptions())


def test_auto_takes_smaller_tiles_for_a_fit_on_finer_cells(town: Scene, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(memory, "available", lambda: 16 * GIB)
    scene = of_size(town, 1000)
    assert chosen_tile(scene, AUTO) == 512.0
    assert chosen_tile(scene, FitOptions(tile="auto", resolution=0.15)) == 256.0


def test_more_ground_and_more_images_take_more(town: Scene, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(memory, "available", lambda: 64 * GIB)
    small, large = foresee(of_size(town, 200), AUTO), foresee(of_size(town, 400), AUTO)
    assert large.area_km2 == pytest.approx(4 * small.area_km2) == pytest.approx(0.16)
    assert large.memory > small.memory
    assert large.cpu_s > 2 * small.cpu_s
    huge = foresee(of_size(town, 3000), AUTO)
    # 3 x 3 tiles, each with its overlap: memory is that of one of them
    assert huge.tiles == 9
    assert huge.memory / huge.beside < foresee(of_size(town, 1200), FitOptions(tile=None)).memory
    two = Scene.from_json(town.to_json())
    two.items = two.items[:2]
    assert foresee(two, AUTO).cpu_s < foresee(town, AUTO).cpu_s


def test_memory_of_tiles_does_not_grow_with_the_area(town: Scene) -> None:
    tiled = FitOptions(tile=512.0)
    one, four, large = (foresee(of_size(town, edge), tiled) for edge in (1040, 2080, 5200))
    assert len({found.memory / found.beside for found in (one, four, large)}) == 1
    assert (one.tiles, four.tiles, large.tiles) == (9, 25, 121)
    # 3 x 3 tiles share 2 x 64 m along an edge of 1040 m, 11 x 11 share 10 x 64 m along five times that
    assert large.cpu_s - foresight.START_S == pytest.approx(25 * (one.cpu_s - foresight.START_S))
    # halves are smaller
    halves = foresee(of_size(town, 700), tiled)
    assert halves.memory / halves.beside < one.memory / one.beside


@pytest.mark.parametrize(
    ("threads", "free", "edge_m", "beside"),
    [
        (1, 64 * GIB, 3000, 1),
        (8, 64 * GIB, 3000, 8),
        (64, 512 * GIB, 3000, 36),  # no more than there are tiles
        (8, 16 * GIB, 3000, 2),  # no more than fit into half of the free memory
        (8, GIB, 3000, 1),
        (8, 64 * GIB, 520, 4),  # of four tiles with 28 s of work
    ],
)
def test_as_many_tiles_at_a_time_as_threads_memory_and_work_allow(
    town: Scene, monkeypatch: pytest.MonkeyPatch, threads: int, free: int, edge_m: float, beside: int
) -> None:
    monkeypatch.setattr(memory, "available", lambda: free)
    monkeypatch.setattr(foresight, "threads", lambda: threads)
    tiled = FitOptions(tile=512.0, device="cpu")
    found = foresee(of_size(town, edge_m), tiled)
    assert found.beside == beside
    assert (f"{beside} at a time" in str(found)) == (beside > 1)


def test_what_is_not_worth_a_start_is_fitted_in_one_process(town: Scene, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(foresight, "threads", lambda: 8)
    assert side_by_side(town, FitOptions(tile=32.0, overlap=8.0, device="cpu"), 4) == 1
    large, tiled = of_size(town, 520), FitOptions(tile=512.0, device="cpu")
    large.products["prior_dsm"] = "prior/dsm.tif"  # what takes longest is done
    assert side_by_side(large, tiled, 4) == 1


def test_what_does_not_fit_at_once_is_cut_without_a_word_of_the_user(
    town: Scene, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr(memory, "available", lambda: 16 * GIB)
    monkeypatch.setattr(foresight, "available", lambda: 16 * GIB)
    plain = FitOptions()
    assert with_tile(of_size(town, 1000), plain) is plain  # 9.7 GiB
    assert caplog.text == ""
    assert with_tile(of_size(town, 3000), plain).tile == 512.0
    assert "needs more memory than is free all at once: fitted in tiles of 512 m" in caplog.text
    for options in (FitOptions(tile=0.0), FitOptions(brdf="hapke"), FitOptions(field="neural"), FitOptions(budget=9.0)):
        assert with_tile(of_size(town, 3000), options) is options


def test_a_gpu_changes_nothing_as_surfaces_are_fitted_on_the_cpu(town: Scene, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(memory, "available", lambda: 64 * GIB)
    monkeypatch.setattr(foresight, "threads", lambda: 8)
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    large = of_size(town, 3000)
    for device in ("cpu", "auto", "cuda"):
        assert side_by_side(large, FitOptions(tile=512.0, device=device), 36) == 8


def test_a_prior_that_is_there_takes_no_time(town: Scene) -> None:
    there = Scene.from_json(town.to_json())
    there.products["prior_dsm"] = "prior/dsm.tif"
    start = foresight.START_S
    assert foresee(there, AUTO).cpu_s - start < 0.7 * (foresee(town, AUTO).cpu_s - start)


def test_wide_cells_take_as_long_to_match_as_the_finer_ones_they_are_means_of(town: Scene) -> None:
    made = foresee_matching(of_size(town, 200), PriorOptions())
    town.grid = town.require_grid().resized(2.0)
    assert foresee_matching(town, PriorOptions()) == made
    fitted = foresee(town, AUTO)
    assert fitted.memory == pytest.approx(made.memory, rel=0.01)  # of the matching, which is more than the fit's
    town.products["prior_dsm"] = "prior/dsm.tif"
    assert foresee(town, AUTO).memory < fitted.memory


def test_what_is_matched_beyond_an_area_is_counted(town: Scene) -> None:
    """16 m around 16 m of ground in the middle of what the images show: nine times the cells."""
    west, _, _, north = town.require_grid().bounds
    town.grid = Grid(town.require_grid().crs, west + 24.0, north - 24.0, 0.5, 32, 32)
    matched, fitted = foresee_matching(town, PriorOptions()), foresee(town, AUTO)
    for item in town.items:  # of which nothing is known yet
        del item.properties["proj:shape"]
    alone, fitted_alone = foresee_matching(town, PriorOptions()), foresee(town, AUTO)
    assert matched.cpu_s - foresight.START_S == pytest.approx(9 * (alone.cpu_s - foresight.START_S))
    assert matched.memory > alone.memory
    assert fitted.cpu_s > fitted_alone.cpu_s


def test_what_the_user_grants_is_what_tiles_go_by(town: Scene, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(memory, "available", lambda: 64 * GIB)
    assert chosen_tile(of_size(town, 3000), AUTO) == 1024.0
    monkeypatch.undo()
    with memory.limited(1000):
        assert chosen_tile(of_size(town, 3000), AUTO) == 256.0


def test_a_dry_run_says_it_and_fits_nothing(make_town: Callable[[], Scene]) -> None:
    scene = make_town()
    result = CliRunner().invoke(main, ["fit", "--dry-run", "--tile", "auto", str(scene.root / "scene.json")])
    assert result.exit_code == 0
    assert "would fit the surface for scene TOWN" in result.stderr
    assert "km2" in result.stderr
    assert "6 images, all at once: about" in result.stderr
    assert not (scene.root / "fit").exists()


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["--tile", "often"], "often"),
        (["--tile", "auto", "--part", "split"], "found auto with --part split, expected metres"),
    ],
)
def test_what_cannot_be_meant_is_wrong_usage(make_town: Callable[[], Scene], arguments: list[str], words: str) -> None:
    result = CliRunner().invoke(main, ["fit", *arguments, str(make_town().root / "scene.json")])
    assert result.exit_code == 2
    assert words in result.stderr


def test_auto_in_a_configuration_file(make_town: Callable[[], Scene]) -> None:
    scene = make_town()
    config = scene.root / "c.toml"
    config.write_text('[fit]\ntile = "auto"\n')
    arguments = ["fit", "--config", str(config), "--print-config", str(scene.root / "scene.json")]
    result = CliRunner().invoke(main, arguments)
    assert result.exit_code == 0
    assert 'tile = "auto"' in result.stdout
    config.write_text('[fit]\ntile = "often"\n')
    assert CliRunner().invoke(main, arguments).exit_code == 2


@pytest.mark.parametrize(
    ("flags", "plan", "training"),
    [
        (["--preset", "satnerf"], "train the network satnerf", "at most 2000 steps of 256 rays, whose seconds are not"),
        (["--field", "neural"], "train a neural field", "at most 1500 steps of 2048 rays"),
        (["--field", "voxel", "--budget", "9"], "train a voxel field", "rays, ended by --budget 9 s after the match"),
    ],
)
def test_the_seconds_of_a_field_of_rays_are_not_those_of_a_surface(
    town_source: Scene, flags: list[str], plan: str, training: str
) -> None:
    said = (
        CliRunner()
        .invoke(main, ["fit", *flags, "--overwrite", "--dry-run", str(town_source.root / "scene.json")])
        .stderr
    )
    assert f"would {plan} for scene TOWN" in said
    assert training in said
    assert "CPU seconds" not in said


def test_a_wide_network_takes_the_memory_of_its_step(town: Scene) -> None:
    """Eight layers of 512 numbers, four bytes each, for 256 rays of 24 samples: 101 MB."""
    narrow, wide = (foresee(town, resolve("satnerf", {"width": width})).memory for width in (8, 512))
    assert wide - narrow == 4 * 8 * (512 - 8) * 256 * 24


@pytest.mark.parametrize(
    ("given", "times"),
    [
        ({}, 1.0),
        ({"epochs": [25]}, 3.0),
        ({"transient": "on"}, 2.1),
        ({"shadow": "learned"}, 3.7),
        ({"brdf": "hapke"}, 2.1),
        ({"prior_weight": 0.0}, 2.6),
    ],
)
def test_more_passes_and_harder_ones_take_more(town: Scene, given: Any, times: float) -> None:
    """256 m, eight images, beyond 2.5 CPU seconds for the imports, really: 2.9, 2.2, 4.3, 2.0 and 2.2 times as many."""
    scene = of_size(town, 256)
    scene.products["prior_dsm"] = "prior/dsm.tif"

    def fitting_s(options: FitOptions) -> float:
        found = foresee(scene, options).cpu_s
        assert found is not None
        return found - foresight.START_S

    assert fitting_s(FitOptions(**given)) / fitting_s(FitOptions()) == pytest.approx(times, abs=0.05)
