"""Whose heights and deviations a network's export shows is said where they are not its own."""

import logging
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import laspy
import pytest
import rasterio

from sattools import api
from sattools.export.options import ExportOptions
from sattools.export.stage import export
from sattools.fit.options import FitOptions
from sattools.fit.presets import resolve
from sattools.fit.stage import fit
from sattools.scene import Scene

TINY = {"width": 16, "rays": 64, "steps": 6, "resolution": 2.0}


def tags(scene: Scene, name: str) -> dict[str, Any]:
    with rasterio.open(scene.path(scene.products[name])) as data:
        return dict(data.tags())


def points_of(scene: Scene) -> set[str]:
    """Dimensions of the points of `export`."""
    with laspy.open(scene.path(scene.products["points"])) as file:
        return set(file.header.point_format.dimension_names)


@pytest.mark.parametrize(
    ("preset", "start", "words"),
    [
        ("eonerf", "surface", "those of the surface fit that the field started from: "),
        ("spsnerf", "prior", "those of the prior that the field started from: "),
    ],
)
def test_a_network_whose_heights_were_put_back_says_so(
    make_matched_hamlet: Callable[..., Scene], caplog: pytest.LogCaptureFixture, preset: Any, start: str, words: str
) -> None:
    scene = make_matched_hamlet()
    fit(scene, resolve(preset, {**TINY, "start": start, "rate": 0.0}))
    with caplog.at_level(logging.WARNING):
        entry = export(scene, ExportOptions())
    assert tags(scene, "dsm")["HEIGHTS"].startswith(words)
    assert any(note.startswith(f"heights: {words}") for note in entry["notes"])
    assert f"heights: {words}" in caplog.text
    assert tags(scene, "dsm_std")["METHOD"] == "of the prior, see prior_dsm_std"


def test_a_field_with_heights_of_its_own_says_nothing_of_the_kind(make_hamlet: Callable[..., Scene]) -> None:
    scene = make_hamlet()
    fit(scene, FitOptions(field="voxel", prior_weight=0.0, rays=64, steps=4, samples=8, resolution=2.0))
    entry = export(scene, ExportOptions())
    assert "HEIGHTS" not in tags(scene, "dsm")
    assert not any("heights" in note for note in entry["notes"])
    assert tags(scene, "dsm_std")["METHOD"].startswith("spread of the height at which vertical rays lose their light")


def test_a_prior_that_the_fit_has_not_used_says_nothing_of_its_heights(
    make_matched_hamlet: Callable[..., Scene],
) -> None:
    """They had the prior's deviations and probabilities, which are those of other heights."""
    quick = FitOptions(resolution=2.0, coarsest=2.0, epochs=[2])
    of_prior = {"probability", "dsm_error95"}
    scene = api.export(
        api.fit(make_matched_hamlet(), replace(quick, prior_weight=0.0)), ExportOptions(products=["laz"])
    )
    assert tags(scene, "dsm_std")["METHOD"].startswith("curvature of the photometric loss")
    assert not of_prior & scene.products.keys()
    assert "confidence" not in points_of(scene)
    scene = api.export(api.fit(scene, quick, overwrite=True), ExportOptions(products=["laz"]), overwrite=True)
    assert tags(scene, "dsm_std")["METHOD"] == "of the prior, see prior_dsm_std"
    assert of_prior <= scene.products.keys()
    assert "confidence" in points_of(scene)


def test_the_deviations_of_a_surface_without_a_prior_are_those_of_its_loss(
    make_hamlet: Callable[..., Scene],
) -> None:
    scene = make_hamlet()
    fit(scene, FitOptions(prior_weight=0.0, resolution=2.0, coarsest=2.0, epochs=[2]))
    export(scene, ExportOptions())
    assert tags(scene, "dsm_std")["METHOD"].startswith("curvature of the photometric loss")
    assert "HEIGHTS" not in tags(scene, "dsm")
