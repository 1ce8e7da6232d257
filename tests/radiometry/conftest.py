"""Fixtures of the tests of `normalise`."""

from pathlib import Path
from typing import Any

import pytest
from towns import copied

from sattools.radiometry.options import NormaliseOptions
from sattools.radiometry.stage import normalise
from sattools.scene import Scene
from sattools.scene.files import write_bytes


@pytest.fixture(scope="module")
def saturated_town(town_source: Scene, tmp_path_factory: pytest.TempPathFactory) -> Scene:
    """A town normalised with saturation at 300; tests change copies of its document, and of its folder."""
    scene = copied(town_source, tmp_path_factory.mktemp("saturated") / "TOWN")
    normalise(scene, NormaliseOptions(saturation=300))
    return scene


@pytest.fixture
def drawn() -> None:
    """Asked for by tests whose histograms are to be drawn."""


@pytest.fixture(autouse=True)
def _histograms_are_drawn_where_they_count(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> None:
    """Drawing one takes several times what the rest of `normalise` takes of these images of a few pixels.

    Other tests have the figure made, of their own numbers, and an empty file in place of its picture.
    """
    if "drawn" in request.fixturenames:
        return

    def write(path: Path, figure: Any) -> None:
        assert len(figure.axes) == 2
        write_bytes(path, b"")

    monkeypatch.setattr("sattools.radiometry.histogram.write_figure", write)
