"""Seconds on a page: those of a prior that `fit` has made are told apart from those of the fit."""

from typing import Any

import pytest

from sattools.report import errors
from sattools.report.scene import scene_page

HISTORY: list[dict[str, Any]] = [
    {"command": "prep", "options": {}, "seconds": 4.0},
    {"command": "fit", "options": {}, "seconds": 30.0, "prior_seconds": 20.0},
    {"command": "export", "options": {}, "seconds": 1.0},
]


@pytest.mark.parametrize("made_before", [False, True])
def test_error_against_time_counts_the_prior_that_a_fit_has_made(
    make_town: Any, monkeypatch: pytest.MonkeyPatch, made_before: bool
) -> None:
    """Passes of such a fit had stood 20 seconds too early, as if it had had its prior for nothing."""
    scene = make_town()
    own = {"command": "fit", "options": {}, "seconds": 10.0}
    apart = [HISTORY[0], {"command": "prior", "options": {}, "seconds": 20.0}, own, HISTORY[2]]
    scene.history = apart if made_before else HISTORY
    scene.output("fit/trace.csv").write_text("seconds,loss,mae_m\n1.0,0.5,2.0\n2.0,0.25,1.5\n")
    scene.products["trace"] = "fit/trace.csv"
    shown: list[Any] = []
    monkeypatch.setattr(errors, "error_over_time", lambda points: shown.extend(points) or "")
    errors._over_time(scene, {"mae": 1.25})
    passes = [("passes of the fit", 25.0, 2.0), ("passes of the fit", 26.0, 1.5)]
    assert shown == [*passes, ("exported surface", 35.0, 1.25)]


def test_a_page_says_what_of_a_fit_was_for_albedo(make_town: Any) -> None:
    scene = make_town()
    scene.history = [HISTORY[0], {**HISTORY[1], "albedo_seconds": 12.34}]
    assert "fit: 12.3 s of its time solved for the albedo once the heights stood." in scene_page(scene)


def test_a_page_says_what_of_a_fit_made_its_prior(make_town: Any) -> None:
    scene = make_town()
    scene.history = HISTORY
    assert "fit: 20.0 s of its time made the prior, which no command had made." in scene_page(scene)
    scene.history = [*HISTORY, {"command": "fit", "options": {}, "seconds": 10.0}]
    assert "of its time made the prior" not in scene_page(scene)
