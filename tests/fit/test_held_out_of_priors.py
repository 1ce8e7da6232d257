"""The prior of a fit in tiles has seen no image that the fit holds out, unless the user has matched it."""

from dataclasses import replace
from typing import Any

import pytest

from sattools import api
from sattools.align.options import AlignOptions
from sattools.fit.options import FitOptions
from sattools.fit.stage import check_start, fit
from sattools.scene import Scene

WHOLE = FitOptions(resolution=1.0, epochs=[1])
TILED = replace(WHOLE, tile=32.0, overlap=8.0)


def items_of_the_prior(scene: Scene) -> list[str]:
    made = [entry["made"]["prior"] for entry in scene.history if "prior" in entry.get("made", {})]
    return list(made[-1]["items"])


def test_a_fit_in_tiles_makes_the_prior_of_an_earlier_fit_anew_without_the_image_held_out(make_town: Any) -> None:
    """As a fit all at once does: held-out views would be scored on heights that were matched with them."""
    scene = api.fit(make_town(), WHOLE)
    ids = [item.id for item in scene.train_items()]
    assert items_of_the_prior(scene) == ids
    api.fit(scene, replace(TILED, holdout=[ids[1]]), overwrite=True)
    assert items_of_the_prior(scene) == [ids[0], *ids[2:]]
    assert "prior_dsm" in scene.products


@pytest.mark.parametrize("options", [WHOLE, TILED])
def test_a_scene_that_is_aligned_still_knows_that_the_fit_made_its_prior(make_town: Any, options: FitOptions) -> None:
    scene = api.export(api.fit(make_town(), WHOLE))
    ids = [item.id for item in scene.train_items()]
    scene = api.align(scene, AlignOptions(to=str(scene.path(scene.products["truth_dsm"])), method="z"))
    api.fit(scene, replace(options, holdout=[ids[1]]), overwrite=True)
    assert items_of_the_prior(scene) == [ids[0], *ids[2:]]


def test_the_tiles_of_a_split_are_not_given_the_prior_of_an_earlier_fit(make_town: Any) -> None:
    scene = api.fit(make_town(), WHOLE)
    held = scene.train_items()[1].id
    first, *_ = fit(scene, replace(TILED, part="split", holdout=[held]))["tiles"]
    assert list(Scene.from_file(scene.root / f"fit/tiles/{first}/scene.json").products) == ["coarse"]


@pytest.mark.parametrize("options", [WHOLE, TILED])
def test_a_prior_that_the_user_has_matched_with_an_image_held_out_is_told(
    make_town: Any, caplog: pytest.LogCaptureFixture, options: FitOptions
) -> None:
    scene = api.match(make_town())
    held = scene.train_items()[1].id
    line = f"scene TOWN: the prior was matched with {held}, which this fit holds out"
    for begin in (check_start, fit):
        caplog.clear()
        begin(Scene.from_file(scene.root / "scene.json"), replace(options, holdout=[held]))
        assert caplog.messages.count(line) == 1
        caplog.clear()
        begin(Scene.from_file(scene.root / "scene.json"), options)
        assert line not in caplog.messages
