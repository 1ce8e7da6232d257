"""Scores and tables whose numbers are none are refused, with the name of what is wrong."""

import json
from pathlib import Path
from typing import Any

import pytest

from sattools.errors import InputError


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda d: d["near_steps"].update(signed="x"), "signed"),
        (lambda d: d.update(mae_centred=[1]), "mae_centred"),
        (lambda d: d["classes"]["ground"].update(near_steps=3), "near_steps"),
    ],
)
def test_a_score_that_is_no_number_is_named(tmp_path: Path, change: Any, words: Any) -> None:
    from sattools.report.errors import _ERRORS

    place = {"signed": 0.1, "absolute": 0.2, "share": 0.3}
    figures = {"near_steps": place, "away_from_steps": place, "mae_centred": 0.3, "mae_capped_5m": 0.2}
    found = {**figures, "classes": {"ground": dict(figures)}, "shift_m": [0, 0, 0], "protocol": "dsm", "reference": "R",
             "mask": "", "completeness": 1.0, "within_1m": 1.0}  # fmt: skip
    _ERRORS.check(found, "errors.json")
    found = json.loads(json.dumps(found))
    change(found)
    with pytest.raises(InputError, match=words):
        _ERRORS.check(found, "errors.json")


@pytest.mark.parametrize("value", ["nan", "inf", "-inf"])
def test_a_batch_table_of_no_numbers_is_refused(tmp_path: Path, value: Any) -> None:
    from sattools.report.batch import read_rows

    (tmp_path / "table.csv").write_text(f"scene,configuration,status,seconds,mae_m\nA,b,done,{value},1.0\n")
    with pytest.raises(InputError, match=r"table\.csv: found seconds -?(nan|inf) of A, expected a finite number"):
        read_rows(tmp_path / "table.csv")
