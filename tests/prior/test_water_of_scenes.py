"""Where water was laid level is known of the scene's own cells, whatever those of the matching were."""

from typing import Any

import numpy as np
import pytest

from sattools.prior import PriorOptions, stage
from sattools.prior.stage import prior
from sattools.scene.raster import read_raster


@pytest.fixture
def western_water(monkeypatch: pytest.MonkeyPatch) -> None:
    """What lies in the western half of what is matched is taken for water at 1 m."""

    def level(height: Any, confidence: Any, *_: Any) -> Any:
        water = np.zeros(height.shape, np.uint8)
        middle = height.shape[1] // 2
        height[:, :middle], confidence[:, :middle], water[:, :middle] = 1.0, 0.0, 1
        return water

    monkeypatch.setattr(stage, "level_water", level)


def maps_of(scene: Any) -> Any:
    return [read_raster(scene.path(scene.products[f"prior_{name}"]))[0][0] for name in ("dsm", "confidence", "water")]


def test_water_is_marked_where_it_was_laid_level(make_town: Any, western_water: None) -> None:
    scene = make_town()
    made = prior(scene, PriorOptions(rough_passes=0))
    height, confidence, water = maps_of(scene)
    assert (height[water == 1] == 1.0).all()
    assert not confidence[water == 1].any()
    assert not (height[water == 0] == 1.0).all()
    assert water.mean() == pytest.approx(0.5, abs=0.05)
    assert any("50 % of the area looks like water" in note for note in made["notes"])


def test_cells_wider_than_those_of_the_matching_are_water_where_half_of_them_is(
    make_town: Any, western_water: None
) -> None:
    scene = make_town()
    scene.grid = scene.require_grid().resized(2.0)
    prior(scene, PriorOptions(rough_passes=0))
    height, _, water = maps_of(scene)
    assert water.shape == scene.grid.shape
    assert water.mean() == pytest.approx(0.5, abs=0.05)
    np.testing.assert_allclose(height[:, :10], 1.0, atol=1e-5)
    assert (water[:, :10] == 1).all()
    assert not water[:, -10:].any()


def test_what_is_kept_as_it_was_matched_is_not_marked(make_town: Any, western_water: None) -> None:
    scene = make_town()
    prior(scene, PriorOptions(rough_passes=0, water="keep"))
    assert not maps_of(scene)[2].any()
