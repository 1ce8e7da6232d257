"""A page leaves out what was made from images that have changed since, and says what that is."""

from typing import Any

import rasterio
from click.testing import CliRunner

from sattools import api
from sattools.cli import main
from sattools.report.scene import scene_page
from sattools.scene import Scene


def test_a_prior_of_images_as_they_are_no_more_is_left_out_by_its_name(make_town: Any) -> None:
    """It had stayed on the page, under a line that said "Left out: ."."""
    scene = api.match(make_town())
    assert "confidence of the prior" in scene_page(Scene.from_file(scene.root / "scene.json"))
    with rasterio.open(scene.path(scene.items[0].assets["image"].href), "r+") as data:
        data.write(data.read() // 2)
    result = CliRunner().invoke(main, ["report", str(scene.root / "scene.json")])
    assert result.exit_code == 0, result.stderr
    assert "left out of the report: prior_dsm, prior_confidence, prior_probability" in result.stderr
    page = (scene.root / "report.html").read_text(encoding="utf-8")
    assert "Left out: prior_dsm, prior_confidence" in page
    assert "confidence of the prior" not in page
