"""Whatever was run before, in whatever order: a number that is reported is that of a fresh scene."""

import json
import shutil
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import pytest
from click.testing import CliRunner
from hypothesis import HealthCheck, Phase, given, settings
from hypothesis import strategies as st

from sattools.cli import main

FIT = ("--resolution", "2", "--coarsest", "2", "--epochs", "2")
CHOICES = {
    "normalise": [(), ("--black", "40")],
    "prior": [("--resolution", "2"), ("--resolution", "2", "--window", "9")],
    "fit": [
        (*FIT, "--prior-weight", "0"),
        (*FIT, "--prior-weight", "0", "--seed", "1", "--loss", "mse"),
        FIT,
        (*FIT, "--holdout", "TINY_001"),
        (*FIT, "--views", "nearest-nadir:3"),
    ],
    "export": [(), ("--view", "TINY_001"), ("--fill",)],
    "compare": [(), ("--views",), ("--register", "none")],
}
COMMANDS = st.sampled_from([(name, options) for name, sets in CHOICES.items() for options in sets])
# two of three sequences begin with a fit, so that there is something to become stale
BEGINNINGS = st.sampled_from([[], [("fit", CHOICES["fit"][0]), ("export", ()), ("compare", ())], [("fit", FIT)]])


@dataclass(frozen=True)
class State:
    """What counts of all that was run: command -> options, in the order of the pipe."""

    runs: dict[str, tuple[str, ...]] = field(default_factory=dict)

    def after(self, name: Any, options: Any) -> Any:
        order = list(CHOICES)
        kept = {n: o for n, o in self.runs.items() if order.index(n) < order.index(name)}
        return replace(self, runs={**kept, name: options})


@pytest.fixture(scope="module")
def tiny(tmp_path_factory: pytest.TempPathFactory) -> Any:
    folder = tmp_path_factory.mktemp("tiny")
    options = ["--size", "40", "--views", "4", "--dates", "3", "--gsd", "1", "--id", "TINY", "--out", str(folder)]
    assert invoke("simulate", *options).exit_code == 0
    document = json.loads((folder / "TINY/scene.json").read_text())
    document["sattools"]["root"] = "."  # copies are scenes of their own
    (folder / "TINY/scene.json").write_text(json.dumps(document))
    return folder / "TINY"


def invoke(*arguments: Any) -> Any:
    return CliRunner().invoke(main, ["--threads", "1", "-q", *arguments])


def run(root: Any, name: Any, options: Any) -> Any:
    result = invoke(name, *options, "--overwrite", str(root / "scene.json"))
    assert result.exception is None or isinstance(result.exception, SystemExit), result.exception
    return result


def figures(result: Any) -> Any:
    found = json.loads(result.stdout)
    # the whole table but the paths that differ by their folder
    return {name: value for name, value in found.items() if name != "reference"}


def check(tiny: Any, folder: Any, sequence: Any, known: Any) -> Any:
    root = folder / "used"
    shutil.rmtree(root, ignore_errors=True)
    shutil.copytree(tiny, root)
    state = State()
    for name, options in sequence:
        result = run(root, name, options)
        if name == "compare" and "export" not in state.runs and "fit" in state.runs:
            state = state.after("export", ())  # a stage that was left out is done
        wanted = state.after(name, options)
        if name == "compare":
            expected = fresh(tiny, folder, wanted, known)
            assert (result.exit_code == 0) == (expected is not None), result.stderr
            if expected is not None:
                assert figures(result) == expected
        if result.exit_code == 0:
            state = wanted
    return state


def fresh(tiny: Any, folder: Any, state: Any, known: Any) -> Any:
    """The table of a scene on which only what counts was run; None where that fails."""
    key = json.dumps(state.runs)
    if key not in known:
        root = folder / "fresh"
        shutil.rmtree(root, ignore_errors=True)
        shutil.copytree(tiny, root)
        results = [run(root, name, options) for name, options in state.runs.items()]
        known[key] = figures(results[-1]) if all(r.exit_code == 0 for r in results) else None
    return known[key]


def sequences(examples: Any, length: Any) -> Any:
    def decorate(test: Any) -> Any:
        test = given(begin=BEGINNINGS, more=st.lists(COMMANDS, min_size=length, max_size=length))(test)
        return settings(
            max_examples=examples, deadline=None, derandomize=True, database=None,
            phases=[Phase.generate], suppress_health_check=list(HealthCheck),
        )(test)  # fmt: skip

    return decorate


@pytest.fixture(scope="module")
def known() -> Any:
    return {}


@sequences(examples=3, length=3)
def test_a_reported_number_is_that_of_a_fresh_scene(
    tiny: Any, known: Any, tmp_path_factory: pytest.TempPathFactory, begin: Any, more: Any
) -> None:
    check(tiny, tmp_path_factory.mktemp("sequence"), [*begin, *more, ("compare", ())], known)


@pytest.mark.slow
@sequences(examples=60, length=8)
def test_a_reported_number_is_that_of_a_fresh_scene_however_long_it_was_used(
    tiny: Any, known: Any, tmp_path_factory: pytest.TempPathFactory, begin: Any, more: Any
) -> None:
    check(tiny, tmp_path_factory.mktemp("sequence"), [*begin, *more, ("compare", ())], known)


def test_the_sequences_that_were_once_reported_wrongly(tiny: Any, known: Any, tmp_path: Path) -> None:
    """A new fit scored by the old surface; the roles of a held-out image in the next fit; maps of another model."""
    first, other, held = CHOICES["fit"][0], CHOICES["fit"][1], CHOICES["fit"][3]
    for sequence in (
        [("fit", first), ("export", ()), ("fit", other), ("compare", ())],
        [("fit", held), ("export", ()), ("compare", ()), ("fit", FIT), ("compare", ())],
        [("fit", FIT), ("fit", held), ("compare", ()), ("normalise", CHOICES["normalise"][1]), ("fit", FIT),
         ("compare", ())],
        [("fit", first), ("export", ("--view", "TINY_001")), ("compare", ("--views",)), ("export", ()),
         ("compare", ("--views",))],
    ):  # fmt: skip
        check(tiny, tmp_path, sequence, known)


@pytest.mark.parametrize("more", [(), ("--dry-run",)])
def test_a_prior_that_is_in_the_way_is_said_to_be_out_of_date(tiny: Any, tmp_path: Path, more: Any) -> None:
    """Who has just made it wonders why `fit` does not take it."""
    shutil.copytree(tiny, tmp_path / "TINY")
    scene = str(tmp_path / "TINY/scene.json")
    for command in (("prior", "--resolution", "2"), ("normalise",)):
        assert invoke(*command, scene).exit_code == 0
    result = invoke("fit", *FIT, *more, scene)
    assert result.exit_code == 1
    assert "prior/dsm.tif: exists already; give --overwrite" in result.stderr
    assert "this prior is from before `sattools normalise`, which has put it out of date" in result.stderr
    assert invoke("fit", *FIT, *more, "--overwrite", scene).exit_code == 0
