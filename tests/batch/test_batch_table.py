"""What a batch writes of its runs: tables, and the figure of speed against error."""

from pathlib import Path

import pytest

from sattools.batch.figure import means, pareto_front, speed_error_figure
from sattools.batch.table import failed_row, to_csv, to_markdown, write_tables


def test_the_front_holds_what_nothing_beats_in_both_time_and_error() -> None:
    points = [("a", 10.0, 2.0), ("b", 20.0, 1.0), ("c", 25.0, 1.5), ("d", 5.0, 3.0), ("e", 12.0, 2.0)]
    assert [name for name, _, _ in pareto_front(points)] == ["d", "a", "b"]


def test_means_are_over_the_scenes_that_all_configurations_have() -> None:
    rows = [
        {"scene": scene, "configuration": name, "seconds": seconds, "mae_m": error}
        for scene, name, seconds, error in (("A", "x", 1.0, 1.0), ("B", "x", 3.0, 9.0), ("A", "y", 5.0, 0.5))
    ]
    assert means(rows) == [("x", 1.0, 1.0), ("y", 5.0, 0.5)]


def test_a_table_names_what_failed_and_why() -> None:
    row = failed_row("JAX_999", "fast", "missing", "found no | images")
    assert to_markdown([row]).splitlines()[2] == "| JAX_999 | fast | missing | found no \\| images |"
    assert to_csv([row]).splitlines()[1].startswith("JAX_999,fast,missing,,")


def test_the_parquet_table_is_the_csv_table_with_types(tmp_path: Path) -> None:
    """In one with failed rows only, too, numbers are numbers."""
    pytest.importorskip("pyarrow", reason="needs pyarrow")
    import pandas

    done = {"scene": "A", "configuration": "fast", "status": "done", "mae_m": 1.25, "seconds": 10.5, "cells": 262144}
    lost = failed_row("B", "fast", "missing", "found no <images>")
    for name, rows in (("both", [done, lost]), ("lost", [lost])):
        (tmp_path / name).mkdir()
        written = write_tables(rows, tmp_path / name)
        assert [path.name for path in written] == ["table.csv", "table.md", "table.parquet"]
        found = pandas.read_parquet(written[2])
        plain = pandas.read_csv(written[0])
        assert list(found.columns) == list(plain.columns)
        assert found["scene"].tolist() == plain["scene"].tolist()
        assert found["error"].tolist()[-1] == "found no <images>"
        assert all(found[column].dtype == "float64" for column in ("mae_m", "cells", "seconds", "prep_s"))
        assert found["mae_m"].dropna().tolist() == ([1.25] if name == "both" else [])
    assert not list(tmp_path.rglob("*.tmp*"))


def test_all_points_lie_within_the_figure_and_its_title_counts_what_was_scored() -> None:
    rows = [
        {"scene": "A", "configuration": "fast", "seconds": 100.0, "mae_m": 1.2},
        {"scene": "A", "configuration": "slow", "seconds": 200.0, "mae_m": 1.0},
        failed_row("B", "fast", "missing", "found no images"),
    ]
    [axes] = speed_error_figure(rows).axes
    assert axes.get_title() == "1 of 2 scenes scored"
    assert (axes.get_xlim(), axes.get_ylim()) == (pytest.approx((0, 230)), pytest.approx((0, 1.38)))
