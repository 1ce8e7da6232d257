"""Images of which some lie beside the others, as the tiles of a mosaic do."""

from pathlib import Path

import numpy as np
from synthetic_views import parallel_rpc, render, texture
from test_prep_stage import write

from sattools.fit.options import FitOptions
from sattools.fit.stage import fit
from sattools.prep.options import PrepOptions
from sattools.prep.stage import prepare

RUNS = [(0.3, 0.05), (-0.2, 0.2), (0.0, -0.3), (0.25, -0.2), (-0.1, 0.3)]
COLUMNS = [(0, 260), (0, 120), (0, 120), (0, 120), (170, 260)]  # one image shows all, the last nothing of the others


def test_an_image_beside_the_area_is_set_aside_and_the_fit_goes_on(tmp_path: Path) -> None:
    ground = texture()
    images = []
    for k, (run, (first, last)) in enumerate(zip(RUNS, COLUMNS, strict=True)):
        pixels = render(ground, run).clip(1, 2047).astype(np.uint16)[:, first:last]
        images.append(write(tmp_path / f"city_{k}.tif", pixels, parallel_rpc(run).cropped(first, 0)))
    scene, extra = prepare(images, PrepOptions(out=str(tmp_path / "out")))
    assert [item.role for item in scene.items] == ["train", "train", "train", "train", "unused"]
    assert "city_4: shows nothing of the area, set aside (role unused)" in extra["notes"]
    fit(scene, FitOptions(epochs=[1], resolution=2.0))
    assert scene.path("fit/model.safetensors").is_file()
