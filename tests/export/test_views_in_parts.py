"""Views of large models are rendered part by part, and show no joints."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import rasterio
from towns import copied

from sattools.errors import SceneError
from sattools.export import parts
from sattools.export.options import ExportOptions
from sattools.export.stage import export
from sattools.fit.options import FitOptions
from sattools.fit.stage import fit
from sattools.scene import Scene, stored
from sattools.scene.raster import read_image, read_raster


@pytest.fixture(scope="module")
def fitted_source(town_source: Scene, tmp_path_factory: pytest.TempPathFactory) -> Scene:
    """A town of 64 m on cells of 1 m, of which one image was held out of the fit."""
    scene = copied(town_source, tmp_path_factory.mktemp("fitted") / "TOWN")
    scene.items[0].properties["sattools:role"] = "test"
    fit(scene, FitOptions(resolution=1.0, coarsest=4.0, epochs=[6]))
    return scene


@pytest.fixture
def fitted(fitted_source: Scene, tmp_path: Path) -> Scene:
    return copied(fitted_source, tmp_path / "TOWN")


@pytest.fixture
def small_parts(monkeypatch: pytest.MonkeyPatch) -> None:
    """Parts of 24 cells, and maps of 20 kB that go to files."""
    monkeypatch.setattr(stored, "AT_ONCE", 100)
    monkeypatch.setattr(parts, "EDGE", 24)
    monkeypatch.setattr(stored, "HELD", 20_000)


def shown(scene: Scene, ids: list[str]) -> dict[str, np.ndarray]:
    """What `export` renders."""
    export(scene, ExportOptions(view=ids, sun=(250.0, 35.0)))
    items = {item.id: item for item in scene.items}
    found = {
        f"{name} {kind}": read_image(scene.path(items[name].assets[kind].href))
        for name in ids
        for kind in ("rendered", "rendered_height", "relit")
    }
    return found | {"relit": read_raster(scene.path(scene.products["relit"]))[0]}


def test_parts_show_what_the_whole_shows(fitted: Any, request: pytest.FixtureRequest) -> None:
    ids = [fitted.items[0].id, fitted.items[2].id]  # held out, whose colours are fitted on its western half; trained
    whole = shown(fitted, ids)
    request.getfixturevalue("small_parts")
    in_parts = shown(fitted, ids)
    assert whole.keys() == in_parts.keys()
    with rasterio.open(fitted.path(fitted.items[0].assets["rendered_height"].href)) as data:
        assert data.tags()["VERTICAL_DATUM"] == "WGS84 ellipsoid"
    for name, expected in whole.items():
        found = in_parts[name]
        known = np.isfinite(expected) & np.isfinite(found)
        assert (np.isfinite(expected) == np.isfinite(found)).mean() > 0.995, name
        # lines of sight are those of the middle of a part, which moves edges by a hundredth of a cell
        off = np.abs(found - expected)[known]
        assert np.median(off) < 0.002 * np.ptp(expected[known]), name
        assert np.quantile(off, 0.99) < 0.05 * np.ptp(expected[known]), name


@pytest.mark.usefixtures("small_parts")
def test_an_image_of_another_place_is_told_and_nothing_is_written(fitted: Any) -> None:
    name = fitted.items[2].id
    camera = fitted.path(fitted.items[2].assets["rpc"].href)
    text = camera.read_text().splitlines()
    far = [line if not line.startswith("LAT_OFF") else "LAT_OFF: 12.5 degrees" for line in text]
    camera.write_text("\n".join(far) + "\n")
    with pytest.raises(SceneError, match=rf"{name}: found no valid pixel .* \(leave out --view {name}\)"):
        export(fitted, ExportOptions(view=[name]))
    assert list((fitted.root / "export/rendered").rglob("*")) == []
