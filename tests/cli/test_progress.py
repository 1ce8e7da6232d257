"""Progress on stderr: lines for programs, a bar for people, nothing when asked for nothing."""

import json
from typing import Any

import pytest

from sattools.progress import duration, make_progress, subprogress


def test_json_lines_are_records_with_the_share_held_in_0_to_1(capsys: pytest.CaptureFixture[str]) -> None:
    progress = make_progress("json", "fit TOWN")
    for fraction in (-0.1, 0.42, 1.5):
        progress(fraction, "epoch")
    out, err = capsys.readouterr()
    assert out == ""
    assert [json.loads(line) for line in err.splitlines()] == [
        {"progress": 0.0, "message": "fit TOWN: epoch"},
        {"progress": 0.42, "message": "fit TOWN: epoch"},
        {"progress": 1.0, "message": "fit TOWN: epoch"},
    ]


def test_a_bar_stays_on_its_line_until_it_is_full(capsys: pytest.CaptureFixture[str]) -> None:
    progress = make_progress("bar", "fit TOWN")
    progress(0.5, "half")
    progress(1.0, "fitted")
    out, err = capsys.readouterr()
    assert out == ""
    assert "[############............]  50%" in err
    assert err.count("\n") == 1
    assert err.endswith("fitted\x1b[K\n")


@pytest.mark.parametrize("mode", ["none", "auto"])
def test_nothing_is_said_when_stderr_is_no_terminal(capsys: pytest.CaptureFixture[str], mode: Any) -> None:
    make_progress(mode, "fit TOWN")(0.5, "half")
    assert capsys.readouterr() == ("", "")


def test_a_step_reports_its_part_of_the_whole() -> None:
    heard = []
    step = subprogress(lambda fraction, message: heard.append((fraction, message)), 0.2, 0.6)
    step(0.0, "a")
    step(0.5, "b")
    step(1.0, "c")
    assert heard == [(0.2, "a"), (pytest.approx(0.4), "b"), (pytest.approx(0.6), "c")]


@pytest.mark.parametrize(("seconds", "text"), [(50, "50 s"), (600, "10 min"), (10800, "3 h"), (2.2e6, "25 days")])
def test_durations_are_said_in_units_that_people_use(seconds: Any, text: Any) -> None:
    assert duration(seconds) == text
