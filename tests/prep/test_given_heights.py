"""Heights that the user gives: a range that leaves out ground is told, and one that is wide does no harm."""

from typing import Any

import numpy as np
import pytest
from spoilt import Town, prep

from sattools.prep.gate import check_heights
from sattools.scene import Scene

TIES = np.linspace(0.0, 100.0, 1001)


def test_a_range_that_leaves_out_tie_points_on_one_side_is_told() -> None:
    (told,) = check_heights(-5.0, 80.0, TIES, True)
    assert told.startswith("heights -5 to 80 m leave out 20 % of the tie points, which lie above them (all")
    below, above = check_heights(10.0, 90.0, TIES, True)
    assert "which lie below them" in below
    assert "which lie above them" in above


@pytest.mark.parametrize(("low", "high", "given"), [(-5.0, 96.0, True), (4.0, 96.0, True), (10.0, 80.0, False)])
def test_a_few_tie_points_may_be_false(low: float, high: float, given: bool) -> None:
    assert check_heights(low, high, TIES, given) == []


def test_a_wide_range_changes_the_area_by_little(town_source: Any, tmp_path: Any) -> None:
    town = Town(tmp_path, town_source, 4)
    found = Scene.from_json(prep(town).stdout)
    result = prep(town, "--min-height", "-500", "--max-height", "1500", "--overwrite")
    assert result.exit_code == 0, result.output
    given = Scene.from_json(result.stdout)
    assert given.height_range_m == (-500.0, 1500.0)
    np.testing.assert_allclose(given.grid.bounds, found.grid.bounds, atol=0.1 * found.grid.width * found.grid.cell_size)
