"""Fixtures shared by all tests."""

import logging
import os
from collections.abc import Callable, Generator, Iterator
from contextlib import nullcontext
from pathlib import Path

import pytest
from forked import program, server
from pictures import undrawn
from towns import copied, matched

from sattools.cli import set_threads
from sattools.scene import Scene

# Many small calls: threads that wait for each other cost more than they bring, above all on a busy machine.
# Set before torch and numba are imported, and inherited by the commands that tests start.
set_threads(1)


# Files that take half a minute or more, the longest first: begun last, they would leave all cores but one idle.
LONG = (
    "test_accuracy.py", "test_networks_from_the_prior.py", "test_in_qgis.py", "test_nothing_lost.py",
    "test_stale_results.py", "test_tiled_fit.py", "test_batch_run.py", "test_tutorials.py", "test_report.py",
    "test_shift_to_dem.py", "test_tiles_side_by_side.py", "test_stage.py", "test_models_by_material.py", "test_api.py",
    "test_neural_fit.py", "test_launch.py", "test_evaluation.py", "test_resume.py", "test_kernel_blocks.py",
    "test_surroundings.py", "test_align.py", "test_signals.py", "test_prep_stage.py", "test_start.py",
)  # fmt: skip


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Put the tests of long files first, which `make test` hands out in this order."""
    items.sort(key=lambda item: LONG.index(item.path.name) if item.path.name in LONG else len(LONG))


@pytest.hookimpl(wrapper=True)
def pytest_runtest_protocol(item: pytest.Item) -> Generator[None, object, object]:
    """Fixtures, of a module and of the session too, draw only for tests that are marked `drawn`."""
    with nullcontext() if item.get_closest_marker("drawn") else undrawn():
        return (yield)


@pytest.fixture(scope="session")
def data_dir() -> Path:
    """Folder of real images, RPCs and lidar (`SATTOOLS_DATA`); tests that need it are skipped without it."""
    value = os.environ.get("SATTOOLS_DATA")
    if not value:
        pytest.skip("SATTOOLS_DATA is not set")
    folder = Path(value)
    if not folder.is_dir():
        pytest.fail(f"SATTOOLS_DATA={value} is not a folder")
    return folder


@pytest.fixture(scope="session")
def town_source(tmp_path_factory: pytest.TempPathFactory) -> Scene:
    """A simulated scene of 64 m seen by six exact cameras; tests must leave its files alone."""
    from sattools.scene.files import write_text
    from sattools.simulate import SimulateOptions, simulate

    options = SimulateOptions(id="TOWN", size=64.0, views=6, dates=3)
    scene = simulate(options, tmp_path_factory.mktemp("town") / "TOWN")
    write_text(scene.output("scene.json"), scene.to_json() + "\n")
    return scene


@pytest.fixture(scope="session")
def python_m() -> Iterator[list[str]]:
    """What stands for `python -m` where the start of a process is not what is tested; see `forked`."""
    with server() as command:
        yield command


@pytest.fixture(scope="session")
def quick_program(python_m: list[str], tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder for `PATH` with a program `sattools` that begins without importing."""
    return program(python_m, tmp_path_factory.mktemp("bin"))


@pytest.fixture
def make_town(town_source: Scene, tmp_path: Path) -> Callable[[str], Scene]:
    """Makes copies of the simulated scene below `tmp_path`, each with its own root of the given name."""

    def make(name: str = "TOWN") -> Scene:
        return copied(town_source, tmp_path / name)

    return make


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


@pytest.fixture(autouse=True)
def _own_loudness() -> None:
    """How much a command is asked to tell (`--quiet`) by another test, or by a fixture of many, is not asked of a test.

    Undone before a test, not after: fixtures of a module run between the tests.
    """
    logging.getLogger("sattools").setLevel(logging.NOTSET)
