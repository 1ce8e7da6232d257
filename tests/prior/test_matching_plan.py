"""What a matching will take is foretold from what others took, and an area is cut into tiles that fit into memory."""

from collections.abc import Callable

import pytest
from click.testing import CliRunner

from sattools import system
from sattools.cli import main
from sattools.errors import SattoolsError
from sattools.prior import PriorOptions, foresight, tiled
from sattools.prior.cells import grids
from sattools.prior.foresight import MatchingPlan, check_fits, foresee_matching, plan_matching, warn_of_tiles
from sattools.scene import Grid, Scene, memory

GIB = 2**30
DEFAULT = PriorOptions()


@pytest.fixture
def city(town_source: Scene, monkeypatch: pytest.MonkeyPatch) -> Scene:
    """A square of 0.5 m cells under images of one band, 13 to 20 degrees off nadir; nothing is read."""
    monkeypatch.setattr(system, "memory_taken", lambda: 150_000_000)
    scene = Scene.from_json(town_source.to_json())
    scene.height_range_m = (277.0, 358.0)
    scene.items = scene.train_items() * 6
    for item in scene.items:
        item.properties |= {"sattools:bands": 1, "view:incidence_angle": 22.0, "gsd": 0.5}
        item.properties.pop("proj:shape", None)  # what stands around it is part of the square
    return scene


def planned(scene: Scene, options: PriorOptions = DEFAULT) -> MatchingPlan:
    """Of a square that is 16 m less wide on every side."""
    items = scene.train_items()
    _, wide = grids(scene, items, options)
    return plan_matching(scene, items, wide.widened(-round(16 / wide.cell_size)), wide, options)


def of_size(scene: Scene, edge_m: float, images: int) -> Scene:
    cells = round(edge_m / 0.5)
    scene.grid = Grid("EPSG:32633", 0.0, 0.0, 0.5, cells, cells)
    scene.items = scene.items[:images]
    return scene


@pytest.mark.parametrize(
    ("edge_m", "images", "given", "gib", "cpu_s"),
    # `sattools --threads 1 prior` of simulated images, 16 m around 125, 250 and 500 m: peak of the process and its CPU
    # seconds, on a machine that did other work beside it
    [
        (157, 12, {}, 0.49, 7.0),
        (157, 24, {}, 0.65, 9.8),
        (157, 36, {}, 0.82, 15.3),
        (282, 3, {}, 0.73, 8.1),
        (282, 6, {}, 0.83, 13.4),
        (282, 12, {}, 1.11, 18.9),
        (282, 36, {}, 1.80, 40.2),
        (532, 12, {}, 1.92, 89.0),
        (532, 36, {}, 4.81, 199.6),
        (282, 12, {"detail": 1.0}, 0.60, 10.4),
        (282, 12, {"resolution": 1.0}, 0.42, 5.9),
    ],
)
def test_memory_and_seconds_are_those_of_matchings_before(
    city: Scene, edge_m: float, images: int, given: dict[str, float], gib: float, cpu_s: float
) -> None:
    plan = planned(of_size(city, edge_m, images), PriorOptions(**given))
    assert plan.tiles == 1
    assert 0.9 < plan.memory / GIB / gib < 1.3
    assert 0.9 < plan.cpu_s / cpu_s < 1.5


@pytest.mark.parametrize(
    ("free", "edge", "tiles"),
    [
        (64.0, None, 1),
        (5.0, None, 1),
        (4.9, 512, 4),  # 2.3 GiB, and an estimate may be some more
        (2.5, 256, 16),
        (1.0, 128, 64),
        (0.5, 128, 64),  # the smallest
    ],
)
def test_an_area_is_cut_into_the_largest_tiles_that_the_granted_memory_holds(
    city: Scene, monkeypatch: pytest.MonkeyPatch, free: float, edge: int | None, tiles: int
) -> None:
    monkeypatch.setenv(memory.LIMIT, "64000")
    for module in (foresight, memory):
        monkeypatch.setattr(module, "available", lambda: free * GIB)
    found = planned(of_size(city, 532, 36))
    assert (found.edge, found.tiles) == (edge, tiles)


def test_what_is_cut_anyway_is_cut_smaller(city: Scene, monkeypatch: pytest.MonkeyPatch) -> None:
    scene = of_size(city, 2000, 36)
    assert planned(scene).edge == 512
    monkeypatch.setattr(memory, "available", lambda: 3 * GIB)
    monkeypatch.setattr(foresight, "available", lambda: 2 * GIB)
    assert planned(scene).edge == 256


def test_tiles_for_want_of_memory_are_told(
    city: Scene, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    scene = of_size(city, 532, 36)
    assert warn_of_tiles(scene, planned(scene)) == []
    monkeypatch.setattr(foresight, "available", lambda: GIB)
    (said,) = warn_of_tiles(scene, planned(scene))
    assert "needs more memory than is free all at once: matched in" in said
    assert said in caplog.text


def test_a_tile_of_a_fit_is_matched_as_it_is_whatever_is_free(city: Scene, monkeypatch: pytest.MonkeyPatch) -> None:
    """How many are fitted at a time must not change what is found."""
    scene = of_size(city, 532, 36)
    monkeypatch.setattr(foresight, "available", lambda: GIB)
    scene.root = scene.root / "fit/tiles/r0c0"
    assert scene.is_part
    assert planned(scene).edge is None


def test_what_fits_not_even_in_small_tiles_is_refused(city: Scene) -> None:
    scene = of_size(city, 532, 36)
    with memory.limited(100):
        plan = planned(scene)
        with pytest.raises(SattoolsError) as refused:
            check_fits(scene, plan, 36)
    assert "TOWN: matching 36 images in 64 tiles: found a need of 652.2 MiB of memory" in str(refused.value)


def test_a_command_goes_by_the_memory_that_it_is_granted(
    make_town: Callable[[], Scene], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(tiled, "OVERLAP_M", 6.0)
    monkeypatch.setattr(tiled, "OVERLAP_CELLS", 12)
    monkeypatch.setattr(tiled, "SMALLER_CELLS", (64,))
    document = make_town().root / "scene.json"
    whole = foresee_matching(Scene.from_file(document), PriorOptions(rough_passes=0))
    for module in (foresight, memory):
        monkeypatch.setattr(
            module, "available", lambda: whole.memory - min(foresight.BASE_BYTES, system.memory_taken()) - 1e6
        )
    result = CliRunner().invoke(main, ["prior", "--rough-passes", "0", str(document)])
    assert result.exit_code == 0, result.stderr
    assert "needs more memory than is free all at once: matched in 9 tiles of 64 cells" in result.stderr
    assert "needs more memory than is free" in Scene.from_file(document).history[-1]["notes"][0]
