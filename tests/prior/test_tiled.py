"""The prior of a large area is matched in tiles that belong together."""

from typing import Any, NamedTuple

import numpy as np
import pytest
from towns import copied

from sattools.compare import compare_dsm, read_reference
from sattools.prior import PriorOptions, matched, tiled
from sattools.prior import stage as priors
from sattools.prior.stage import prior
from sattools.scene import Grid, Scene, stored
from sattools.scene.raster import read_raster
from sattools.scene.tiles import make_tiles


def cut_small(monkeypatch: pytest.MonkeyPatch) -> None:
    """Tiles of 48 cells that reach 12 into their neighbours, and maps of 4 kB that go to files."""
    monkeypatch.setattr(tiled, "AT_ONCE", 1000)
    for name, value in {"TILE_CELLS": 48, "OVERLAP_M": 6.0, "OVERLAP_CELLS": 12}.items():
        monkeypatch.setattr(tiled, name, value)
    for name, value in {"HELD": 4_000, "PIECE_CELLS": 2_000}.items():
        monkeypatch.setattr(stored, name, value)


@pytest.fixture
def small_tiles(monkeypatch: pytest.MonkeyPatch) -> None:
    cut_small(monkeypatch)


class Tiled(NamedTuple):
    """A town that was matched in tiles, what was told of that, and the tone curves of the tiles."""

    scene: Scene
    found: dict[str, Any]
    said: list[str]
    tones: list[float]


@pytest.fixture(scope="module")
def in_tiles(town_source: Scene, tmp_path_factory: pytest.TempPathFactory) -> Tiled:
    scene = copied(town_source, tmp_path_factory.mktemp("tiles") / "TOWN")
    said: list[str] = []
    tones: list[float] = []
    tone_curve = matched.toned_views

    def noted(sources: Any, views: Any, tone: Any) -> Any:
        if sources[0].balance is not None:
            tones.append(tone)
        return tone_curve(sources, views, tone)

    with pytest.MonkeyPatch.context() as change:
        cut_small(change)
        change.setattr(matched, "toned_views", noted)
        found = prior(scene, PriorOptions(), lambda _, text: said.append(text))["prior"]
    return Tiled(scene, found, said, tones)


def mae(scene: Any) -> float:
    height, grid = read_raster(scene.path(scene.products["prior_dsm"]))
    truth = read_reference(scene.path(scene.products["truth_dsm"]))
    return float(compare_dsm(height[0], truth, grid, method="none").figures["mae"])


def test_tiles_find_the_surface_that_the_whole_has(in_tiles: Tiled, matched_town_source: Scene) -> None:
    scene, found, said, _ = in_tiles
    expected = matched_town_source.history[-1]["prior"]
    whole = mae(matched_town_source)
    assert any(text.startswith("tile 2 of ") for text in said)
    # tiles of 24 m see less around them than an area has that is cut for its size
    assert mae(scene) < whole + 0.15
    assert found["seen_by_two"] == pytest.approx(expected["seen_by_two"], abs=0.05)
    assert {frozenset(pair) for pair in found["pairs"]} >= {frozenset(pair) for pair in expected["pairs"]}
    assert found["left_out_agreement"].keys() == expected["left_out_agreement"].keys()
    for name in ("prior_dsm", "prior_confidence", "prior_normals", "prior_probability", "prior_dsm_std"):
        array, grid = read_raster(scene.path(scene.products[name]))
        assert grid == scene.require_grid()
        assert np.isfinite(array).all()


def test_tiles_agree_on_the_tone_curve(in_tiles: Tiled) -> None:
    assert len(in_tiles.tones) > 1
    assert set(in_tiles.tones) == {1 / 2.2}


@pytest.mark.usefixtures("small_tiles")
def test_cells_so_fine_that_tiles_are_small_beside_their_overlap(
    make_hamlet: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    scene = make_hamlet()
    monkeypatch.setattr(tiled, "OVERLAP_M", 48.0)  # beside tiles of 48 cells: as 32 m beside 512 cells of a decimetre
    prior(scene, PriorOptions())
    assert mae(scene) < 2.0


def test_normals_are_those_of_the_joined_heights_also_where_pieces_of_it_meet(in_tiles: Tiled) -> None:
    from sattools.prior.normals import normals

    scene = in_tiles.scene
    height, grid = read_raster(scene.path(scene.products["prior_dsm"]))
    slant, _ = read_raster(scene.path(scene.products["prior_normals"]))
    np.testing.assert_allclose(slant, normals(height[0], grid.cell_size), atol=1e-6)


@pytest.mark.usefixtures("small_tiles")
def test_where_too_few_images_show_a_tile_heights_are_coarse_and_not_trusted(
    make_town: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    scene = make_town()
    monkeypatch.setattr(priors, "with_surroundings", lambda grid, *_: grid)  # the corner is one of the area
    ids = [item.id for item in scene.train_items()]
    seen = tiled._unseen
    monkeypatch.setattr(
        tiled,
        "_unseen",
        lambda *args: {**seen(*args), "r0c0": set(ids[1:])},  # one image alone shows this corner
    )
    found = prior(scene, PriorOptions())["prior"]
    confidence, _ = read_raster(scene.path(scene.products["prior_confidence"]))
    height, _ = read_raster(scene.path(scene.products["prior_dsm"]))
    assert confidence[0, :30, :30].max() == 0
    assert confidence[0, 60:, 60:].mean() > 0.3
    assert np.isfinite(height).all()
    assert found["seen_by_two"] < 0.95


@pytest.mark.parametrize(
    ("cells", "edges"),
    [(1042, [521, 521]), (1400, [466, 467, 467]), (770, [385, 385]), (767, [767]), (20, [20]), (5208, [520, 521])],
)
def test_tiles_along_an_axis_are_of_one_length(cells: int, edges: list[int]) -> None:
    edge = tiled._edge(cells, 512)
    grid = Grid("EPSG:32633", 0.0, 0.0, 1.0, cells, 1500)
    tiles = make_tiles(grid, (500.0, float(edge)), 0.0, 1.0)
    assert sorted({tile.grid.width for tile in tiles if tile.name.startswith("r0")}) == sorted(set(edges))
