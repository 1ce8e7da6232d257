"""Fixtures of the tests of `normalise`."""

from pathlib import Path
from typing import Any

import pytest
import rasterio
from synthetic_views import parallel_rpc
from towns import copied

from sattools.radiometry.options import NormaliseOptions
from sattools.radiometry.stage import normalise
from sattools.scene import Asset, Item, Scene
from sattools.scene.files import write_bytes

CAMERA = parallel_rpc()


@pytest.fixture
def make_scene(tmp_path: Path) -> Any:
    """Makes a scene of images given as arrays ``[C, H, W]``; they all have RPC tags."""

    def make(*arrays: Any, **properties: Any) -> Scene:
        scene = Scene("N", tmp_path / "N")
        for k, array in enumerate(arrays):
            name = f"i{k}"
            path = scene.output(f"images/{name}.tif")
            with rasterio.open(
                path, "w", driver="GTiff", dtype=array.dtype, count=array.shape[0], height=array.shape[1],
                width=array.shape[2],
            ) as data:  # fmt: skip
                data.write(array)
                data.update_tags(ns="RPC", **CAMERA.to_tags())
            known = {"sattools:bits": 11, "sattools:dtype": str(array.dtype), "sattools:bands": array.shape[0]}
            known |= {"datetime": "2015-05-02T16:19:43Z", "platform": "WorldView-3"}
            known |= {"view:sun_azimuth": 110.0, "view:sun_elevation": 30.0, **properties}
            scene.items.append(Item(name, None, None, known, {"image": Asset(f"images/{name}.tif")}))
        return scene

    return make


@pytest.fixture(scope="module")
def saturated_town(town_source: Scene, tmp_path_factory: pytest.TempPathFactory) -> Scene:
    """A town normalised with saturation at 300; tests change copies of its document, and of its folder."""
    scene = copied(town_source, tmp_path_factory.mktemp("saturated") / "TOWN")
    normalise(scene, NormaliseOptions(saturation=300))
    return scene


@pytest.fixture(autouse=True)
def _histograms_are_drawn_where_they_count(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> None:
    """Drawing one takes several times what the rest of `normalise` takes of these images of a few pixels.

    Other tests have the figure made, of their own numbers, and an empty file in place of its picture.
    """
    if request.node.get_closest_marker("drawn"):
        return

    def write(path: Path, figure: Any) -> None:
        assert len(figure.axes) == 2
        write_bytes(path, b"")

    monkeypatch.setattr("sattools.radiometry.histogram.write_figure", write)
