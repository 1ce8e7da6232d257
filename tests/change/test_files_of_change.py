"""What `change` writes, as those find it who open it."""

from pathlib import Path
from typing import Any

import numpy as np
import pyogrio
import pytest
from click.testing import CliRunner

import sattools
from sattools.cli import main
from sattools.compare import picture
from sattools.errors import OutputExistsError
from sattools.scene.grid import Grid
from sattools.scene.raster import write_cog

GRID = Grid("EPSG:32617", 436000.0, 3355040.0, 1.0, 40, 40)


@pytest.fixture
def dates(tmp_path: Path) -> tuple[Path, Path]:
    """Two surfaces of some roughness; the later one with a heap."""
    ground = np.random.default_rng(0).normal(0.0, 0.1, GRID.shape)
    for name, heap in (("before", 0.0), ("after", 4.0)):
        ground[10:25, 10:25] += heap
        write_cog(tmp_path / f"{name}.tif", ground, GRID, units="m")
    return tmp_path / "before.tif", tmp_path / "after.tif"


def change(before: Path, after: Path, out: Path) -> None:
    done = CliRunner().invoke(main, ["change", str(before), str(after), "--register", "none", "--out", str(out)])
    assert done.exit_code == 0, done.stderr


def test_the_layer_of_regions_has_the_same_columns_where_nothing_has_changed(dates: Any, tmp_path: Path) -> None:
    """It had a label alone, a number with decimals, and what a map in QGIS is coloured by was gone."""
    before, after = dates
    change(before, after, tmp_path / "changed")
    change(before, before, tmp_path / "still")
    changed, still = (pyogrio.read_info(tmp_path / name / "changes.gpkg") for name in ("changed", "still"))
    assert (changed["features"], still["features"]) == (1, 0)
    assert [*changed["fields"]] == [
        *("area_m2", "mean_m", "std_m", "volume_m3", "volume_std_m3", "label", "p_value", "kind")
    ]
    for about in ("fields", "dtypes"):
        assert [*still[about]] == [*changed[about]]


def test_the_picture_says_what_is_subtracted_from_what(
    dates: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Nobody has predicted anything, and neither date is a reference."""
    figures: list[Any] = []
    monkeypatch.setattr(picture, "write_figure", lambda path, figure: (path.touch(), figures.append(figure)))
    change(*dates, tmp_path / "out")
    _, colours = figures[0].axes
    assert colours.get_ylabel() == "later minus earlier [m]"


def test_files_that_another_call_has_written_meanwhile_are_not_replaced_unasked(dates: Any, tmp_path: Path) -> None:
    """Two calls at once had looked before either wrote, and the later one's files replaced the others."""
    options = {"register": "none", "out": str(tmp_path / "out")}

    def another(share: float, message: str) -> None:
        if message == "regions":
            sattools.change(*dates, options)

    with pytest.raises(OutputExistsError, match=r"height_change\.tif: exists already; give overwrite=True"):
        sattools.change(*dates, options, progress=another)
    sattools.change(*dates, options, overwrite=True)
