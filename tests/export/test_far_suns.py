"""Networks that have learned shadows, shown under suns that none of their images had."""

import logging
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import rasterio
import torch

from sattools.camera.view_direction import ViewDirection
from sattools.export.novel import beyond_learned
from sattools.export.options import ExportOptions
from sattools.export.stage import export
from sattools.fit.described import Description
from sattools.fit.model import FittedModel
from sattools.fit.presets import resolve
from sattools.fit.stage import fit
from sattools.render import sun_visibility
from sattools.scene import Grid

GRID = Grid("EPSG:32633", 0.0, 0.0, 1.0, 8, 8)
SOUTH = (0.0, -(0.5**0.5), 0.5**0.5)
LEARNED = Description(
    grid=GRID, items=["a", "b"], suns=[SOUTH, None], slopes=[ViewDirection(0.0, 0.0)] * 2, shadow="learned",
    field="mlp", network="satnerf",
)  # fmt: skip


def higher(degrees: float) -> tuple[float, float, float]:
    angle = np.radians(45.0 + degrees)
    return 0.0, -float(np.cos(angle)), float(np.sin(angle))


def test_learned_shadows_reach_five_degrees_from_the_suns_of_the_training() -> None:
    assert beyond_learned(LEARNED, SOUTH) is None
    assert beyond_learned(LEARNED, higher(4.9)) is None
    assert beyond_learned(LEARNED, higher(5.5)) == pytest.approx(5.5)
    assert beyond_learned(replace(LEARNED, suns=[None, None]), SOUTH) == pytest.approx(180.0)
    # what casts its shadows knows every sun
    assert beyond_learned(replace(LEARNED, shadow="geometric"), higher(40.0)) is None
    assert beyond_learned(replace(LEARNED, field="surface", network=None), higher(40.0)) is None


@pytest.mark.parametrize("preset", ["satnerf", "eonerf-learned-shadow"])
def test_the_volume_casts_the_shadows_of_a_sun_that_is_far_from_all_it_has_learned(
    make_matched_town: Any, caplog: pytest.LogCaptureFixture, preset: str
) -> None:
    scene = make_matched_town()
    fit(scene, resolve(preset, {"width": 16, "rays": 64, "steps": 4, "resolution": 1.0}))
    item = scene.items[0].id
    with caplog.at_level(logging.WARNING):
        export(scene, ExportOptions(view=[item], sun=(0.0, 40.0)))  # the images' suns are in the south
    assert "--sun: shadows cast by the volume, not as learned: the nearest sun of the training is " in caplog.text
    model = FittedModel.load(scene.path(scene.products["model"]))
    north = (0.0, float(np.cos(np.radians(40.0))), float(np.sin(np.radians(40.0))))
    shaded = sun_visibility(model.height, model.grid.cell_size, north) < 0.5
    with rasterio.open(scene.path(scene.products["relit"])) as data:
        relit, about = data.read(), data.tags()
    assert about["SHADOWS"].startswith("cast by the volume")
    with rasterio.open(scene.path(scene.products["albedo"])) as data:
        dark = torch.from_numpy((relit.mean(0) < 0.6 * data.read().mean(0)) & np.isfinite(relit[0]))
    shaded &= torch.from_numpy(np.isfinite(relit[0]))
    # the rest are cells on the shadows' edges: the volume is half a metre soft
    assert float((dark & shaded).sum() / (dark | shaded).sum()) > 0.7
    with rasterio.open(scene.path(scene.items[0].assets["relit"].href)) as data:
        assert "SHADOWS" in data.tags()
    with rasterio.open(scene.path(scene.items[0].assets["rendered"].href)) as data:
        assert "SHADOWS" not in data.tags()  # its own sun has been seen
