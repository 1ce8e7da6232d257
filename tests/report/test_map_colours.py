"""Which bands of a map the report shows in red, green and blue."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from sattools.fit.materials.parameters import AMPLITUDE, SHAPE
from sattools.report import figures
from sattools.report.scene import MAPS, _maps
from sattools.scene import Grid, Scene
from sattools.scene.raster import write_cog

pytestmark = pytest.mark.drawn

GRID = Grid("EPSG:32617", 436000.0, 3358000.0, 1.0, 40, 30)


@pytest.mark.parametrize(
    ("names", "shown"),
    [
        (["albedo blue", "albedo green", "albedo red", "albedo nir08"], [3, 2, 1]),
        ([f"albedo {number}" for number in range(1, 9)], [5, 3, 2]),
        ([f"albedo {number}" for number in range(1, 5)], [1, 2, 3]),
        (["albedo 1", "albedo 2"], [1]),
    ],
)
def test_a_map_is_shown_by_its_red_green_and_blue_bands(
    names: Any, shown: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    bands = np.stack([np.full(GRID.shape, number, np.float32) for number in range(1, len(names) + 1)])
    write_cog(tmp_path / "albedo.tif", bands, GRID, descriptions=names)
    seen: list[Any] = []
    real = figures.map_figure
    monkeypatch.setattr(figures, "map_figure", lambda array, *more: (seen.append(array), real(array, *more))[1])
    _maps(Scene("TOWN", tmp_path, [], GRID, products={"albedo": "albedo.tif"}))
    assert [float(band.max()) for band in seen[0]] == shown


def test_every_parameter_of_a_reflectance_model_has_a_picture_and_so_has_where_there_is_none() -> None:
    amplitudes, shapes = {p.name for p in AMPLITUDE.values()}, {p.name for kind in SHAPE.values() for p in kind}
    assert {"w", "theta", "asymmetry"} <= amplitudes | shapes
    assert (amplitudes | shapes | {"lambert_share"}) - MAPS.keys() == set()
