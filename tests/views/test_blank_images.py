"""Images whose files became white after `prep`, which refuses such images, are told by name."""

from pathlib import Path
from typing import Any

import numpy as np
import rasterio

from sattools.fit.options import FitOptions
from sattools.fit.stage import fit
from sattools.prior import PriorOptions
from sattools.prior.stage import prior

QUICK = FitOptions(resolution=2.0, coarsest=2.0, epochs=[1])
TOLD = "TOWN_002: shows one number all over the area, in which nothing is seen: leave it out"


def whiten(path: Path, but_for: int = 0) -> None:
    """All pixels of an image have the largest number of its type, but for some rows."""
    with rasterio.open(path, "r+") as data:
        pixels = data.read()
        pixels[:, but_for:] = np.iinfo(pixels.dtype).max
        data.write(pixels)


def white(make_town: Any, **more: int) -> Any:
    scene = make_town("TOWN")
    whiten(scene.path(scene.items[1].assets["image"].href), **more)
    return scene


def test_matching_and_fit_tell_of_an_image_that_has_become_white(make_town: Any, caplog: Any) -> None:
    scene = white(make_town)
    assert TOLD in prior(scene, PriorOptions(detail=1.0))["notes"]
    assert caplog.messages.count(TOLD) == 1
    assert TOLD in fit(scene, QUICK)["notes"]
    assert caplog.messages.count(TOLD) == 2


def test_a_fit_that_makes_its_own_prior_tells_it_once(make_town: Any, caplog: Any) -> None:
    assert TOLD in fit(white(make_town), QUICK)["notes"]
    assert caplog.messages.count(TOLD) == 1


def test_an_image_that_shows_a_part_of_the_area_is_not_told(make_town: Any, caplog: Any) -> None:
    fit(white(make_town, but_for=40), QUICK)
    assert TOLD not in caplog.messages
