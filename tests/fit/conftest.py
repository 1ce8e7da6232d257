"""Fixtures of fits: half of the small scene, and tiles of it."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest
from in_tiles import TILED, tile
from towns import copied, matched, northern_half

from sattools.scene import Scene


@pytest.fixture(scope="session")
def matched_row_source(hamlet_source: Scene, tmp_path_factory: pytest.TempPathFactory) -> Scene:
    """The northern half of the small scene with its prior, two tiles of 16 m; tests must leave its files alone."""
    return matched(northern_half(hamlet_source), tmp_path_factory.mktemp("matched") / "ROW")


@pytest.fixture(scope="session")
def begun_tiles(hamlet_source: Scene, tmp_path_factory: pytest.TempPathFactory) -> Scene:
    """The small scene with two of its four tiles fitted by commands of their own; tests must leave its files alone."""
    from sattools.fit.stage import fit

    scene = copied(hamlet_source, tmp_path_factory.mktemp("begun") / "HAMLET")
    assert fit(scene, replace(TILED, part="split"))["tiles"] == ["r0c0", "r0c1", "r1c0", "r1c1"]
    for name in ("r0c0", "r0c1"):
        fit(tile(scene, name), TILED)
    return scene


@pytest.fixture(scope="session")
def finished_tiles(begun_tiles: Scene, tmp_path_factory: pytest.TempPathFactory) -> Scene:
    """The same with all four, the last before the third, not joined; tests must leave its files alone."""
    from sattools.fit.stage import fit

    scene = copied(begun_tiles, tmp_path_factory.mktemp("finished") / "HAMLET")
    for name in ("r1c1", "r1c0"):
        fit(tile(scene, name), TILED)
    return scene


@pytest.fixture
def make_row(hamlet_source: Scene, tmp_path: Path) -> Callable[..., Scene]:
    """Makes copies of the small scene's northern half below `tmp_path`."""
    return lambda name="ROW": copied(northern_half(hamlet_source), tmp_path / name)


@pytest.fixture
def make_matched_row(matched_row_source: Scene, tmp_path: Path) -> Callable[..., Scene]:
    """Makes copies of the small scene's northern half with its prior below `tmp_path`."""
    return lambda name="ROW": copied(matched_row_source, tmp_path / name)
