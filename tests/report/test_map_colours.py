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


def test_a_map_without_a_value_is_told_not_drawn(tmp_path: Path) -> None:
    """It was a grey picture beside the colours of 0 to 1, as if roughness had been measured there."""
    tags = {"DETERMINED": "0.00 of the cells, see identifiable.tif"}
    write_cog(tmp_path / "theta.tif", np.full(GRID.shape, np.nan, np.float32), GRID, tags=tags)
    section = _maps(Scene("TOWN", tmp_path, [], GRID, products={"theta": "theta.tif"}))
    assert section.parts == [
        "Macroscopic roughness theta [degrees], product theta; determined: 0.00 of the cells, see identifiable.tif. "
        "No cell has a value."
    ]


def test_ground_without_colours_is_grey_not_white() -> None:
    bands = np.linspace(0.1, 0.3, 3 * GRID.height * GRID.width, dtype=np.float32).reshape(3, *GRID.shape)
    bands[:, :10, :10] = np.nan
    shown = figures.map_figure(bands, GRID, "albedo [1]").axes[0].images[0].get_array()
    assert np.unique(shown[:10, :10]).tolist() == [0.75]
    assert 0.0 <= float(shown.min()) < float(shown.max()) <= 1.0
