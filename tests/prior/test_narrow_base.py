"""Images from nearly one direction: a surface comes out, but somebody is told what it is worth."""

import math
from pathlib import Path
from typing import Any

import pytest

from sattools.prior.gate import warn_of_base
from sattools.prior.options import PriorOptions
from sattools.prior.stage import prior
from sattools.scene import Item, Scene
from sattools.simulate import SimulateOptions, simulate


def items(*zeniths: float | None) -> Any:
    """Images with lines of sight so many degrees from the vertical, to the east."""
    made = []
    for k, zenith in enumerate(zeniths):
        item = Item(f"i{k}", None, None, {"gsd": 0.5})
        if zenith is not None:
            t = math.radians(zenith)
            item.properties["sattools:view_direction"] = [math.sin(t), 0.0, math.cos(t)]
        made.append(item)
    return made


def test_it_is_said_how_many_metres_a_pixel_is(caplog: pytest.LogCaptureFixture) -> None:
    (note,) = warn_of_base(Scene(id="A", root=Path(".")), items(10.0, 11.0, 12.0))
    # 0.5 m / 2 degrees
    assert note.startswith("lines of sight are 2.0 degrees apart at most: a pixel of displacement is 14 m of height")
    assert note in caplog.text


@pytest.mark.parametrize("zeniths", [(10.0, 15.1), (0.0, 1.0, 6.0), (10.0, None)])
def test_nothing_is_said_of_a_usual_base_or_an_unknown_one(zeniths: Any) -> None:
    assert warn_of_base(Scene(id="A", root=Path(".")), items(*zeniths)) == []


def test_the_history_of_the_prior_has_it(tmp_path: Path) -> None:
    options = SimulateOptions(id="NEAR", size=48.0, views=2, dates=1, off_nadir=1.0, trees=False)
    entry = prior(simulate(options, tmp_path / "NEAR"), PriorOptions())
    assert any("degrees apart at most" in note for note in entry["notes"])
