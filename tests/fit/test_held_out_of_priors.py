"""The prior of a fit in tiles has seen no image that the fit holds out, unless the user has matched it."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest
from towns import copied, northern_half

from sattools import api
from sattools.align.options import AlignOptions
from sattools.fit.options import FitOptions
from sattools.fit.stage import check_start, fit
from sattools.scene import Scene

WHOLE = FitOptions(resolution=1.0, epochs=[1])
TILED = replace(WHOLE, tile=16.0, overlap=4.0)  # of half of the small scene, two tiles


def items_of_the_prior(scene: Scene) -> list[str]:
    made = [entry["made"]["prior"] for entry in scene.history if "prior" in entry.get("made", {})]
    return list(made[-1]["items"])


@pytest.fixture(scope="module")
def fitted(hamlet_source: Scene, tmp_path_factory: pytest.TempPathFactory) -> Scene:
    """Half of the small scene, fitted at once with a prior of its own; tests must leave its files alone."""
    return api.fit(copied(northern_half(hamlet_source), tmp_path_factory.mktemp("fitted") / "ROW"), WHOLE)


@pytest.fixture(scope="module")
def aligned(fitted: Scene, tmp_path_factory: pytest.TempPathFactory) -> Scene:
    """The same moved by its height; tests must leave its files alone."""
    scene = api.export(copied(fitted, tmp_path_factory.mktemp("aligned") / "ROW"))
    return api.align(scene, AlignOptions(to=str(scene.path(scene.products["truth_dsm"])), method="z"))


def test_a_fit_in_tiles_makes_the_prior_of_an_earlier_fit_anew_without_the_image_held_out(
    fitted: Scene, tmp_path: Path
) -> None:
    """As a fit all at once does: held-out views would be scored on heights that were matched with them."""
    scene = copied(fitted, tmp_path / "ROW")
    ids = [item.id for item in scene.train_items()]
    assert items_of_the_prior(scene) == ids
    scene = api.fit(scene, replace(TILED, holdout=[ids[1]]), overwrite=True)
    assert items_of_the_prior(scene) == [ids[0], *ids[2:]]
    assert "prior_dsm" in scene.products


@pytest.mark.parametrize("options", [WHOLE, TILED])
def test_a_scene_that_is_aligned_still_knows_that_the_fit_made_its_prior(
    aligned: Scene, tmp_path: Path, options: FitOptions
) -> None:
    scene = copied(aligned, tmp_path / "ROW")
    ids = [item.id for item in scene.train_items()]
    scene = api.fit(scene, replace(options, holdout=[ids[1]]), overwrite=True)
    assert items_of_the_prior(scene) == [ids[0], *ids[2:]]


def test_the_tiles_of_a_split_are_not_given_the_prior_of_an_earlier_fit(fitted: Scene, tmp_path: Path) -> None:
    scene = copied(fitted, tmp_path / "ROW")
    held = scene.train_items()[1].id
    first, *_ = fit(scene, replace(TILED, part="split", holdout=[held]))["tiles"]
    assert list(Scene.from_file(scene.root / f"fit/tiles/{first}/scene.json").products) == ["coarse"]


@pytest.mark.parametrize("options", [WHOLE, TILED])
def test_a_prior_that_the_user_has_matched_with_an_image_held_out_is_told(
    make_matched_row: Callable[..., Scene], caplog: pytest.LogCaptureFixture, options: FitOptions
) -> None:
    scene = make_matched_row()
    held = scene.train_items()[1].id
    line = f"scene ROW: the prior was matched with {held}, which this fit holds out"
    for begin in (check_start, fit):
        caplog.clear()
        begin(Scene.from_file(scene.root / "scene.json"), replace(options, holdout=[held]))
        assert caplog.messages.count(line) == 1
        caplog.clear()
        begin(Scene.from_file(scene.root / "scene.json"), options)
        assert line not in caplog.messages
