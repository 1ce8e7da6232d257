"""Fixtures of fits: towns that are matched already, one so small that a fit costs a second, and half of that one."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest
from in_tiles import TILED, tile
from towns import copied, matched, northern_half

from sattools.scene import Scene


@pytest.fixture(scope="session")
def matched_town_source(town_source: Scene, tmp_path_factory: pytest.TempPathFactory) -> Scene:
    """The simulated scene of 64 m and six views with its prior; tests must leave its files alone."""
    return matched(town_source, tmp_path_factory.mktemp("matched") / "TOWN")


@pytest.fixture(scope="session")
def hamlet_source(tmp_path_factory: pytest.TempPathFactory) -> Scene:
    """A simulated scene of 32 m seen by four exact cameras, for what does not depend on size."""
    from sattools.simulate import SimulateOptions, simulate

    return simulate(
        SimulateOptions(id="HAMLET", size=32.0, views=4, dates=3), tmp_path_factory.mktemp("hamlet") / "HAMLET"
    )


@pytest.fixture(scope="session")
def matched_hamlet_source(hamlet_source: Scene, tmp_path_factory: pytest.TempPathFactory) -> Scene:
    """The small scene with its prior; tests must leave its files alone."""
    return matched(hamlet_source, tmp_path_factory.mktemp("matched") / "HAMLET")


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
def make_matched_town(matched_town_source: Scene, tmp_path: Path) -> Callable[..., Scene]:
    """Makes copies of the matched scene of 64 m below `tmp_path`, each with its own root of the given name."""
    return lambda name="TOWN": copied(matched_town_source, tmp_path / name)


@pytest.fixture
def make_hamlet(hamlet_source: Scene, tmp_path: Path) -> Callable[..., Scene]:
    """Makes copies of the small scene below `tmp_path`, as `make_town` does."""
    return lambda name="HAMLET": copied(hamlet_source, tmp_path / name)


@pytest.fixture
def make_matched_hamlet(matched_hamlet_source: Scene, tmp_path: Path) -> Callable[..., Scene]:
    """Makes copies of the small scene with its prior below `tmp_path`."""
    return lambda name="HAMLET": copied(matched_hamlet_source, tmp_path / name)


@pytest.fixture
def make_row(hamlet_source: Scene, tmp_path: Path) -> Callable[..., Scene]:
    """Makes copies of the small scene's northern half below `tmp_path`."""
    return lambda name="ROW": copied(northern_half(hamlet_source), tmp_path / name)


@pytest.fixture
def make_matched_row(matched_row_source: Scene, tmp_path: Path) -> Callable[..., Scene]:
    """Makes copies of the small scene's northern half with its prior below `tmp_path`."""
    return lambda name="ROW": copied(matched_row_source, tmp_path / name)
