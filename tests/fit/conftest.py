"""Fixtures of fits: towns that are matched already, and one so small that a fit costs a second."""

from collections.abc import Callable
from pathlib import Path

import pytest
from towns import copied, matched

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
