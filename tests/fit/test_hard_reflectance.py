"""Light and ground at their worst: the fit ends with finite maps within their ranges, or says what it lacks."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import rasterio
import torch

from sattools.camera.view_direction import ViewDirection
from sattools.export.options import ExportOptions
from sattools.export.stage import export
from sattools.fit.checkpoint import load
from sattools.fit.materials.scene import ReflectiveScene
from sattools.fit.options import FitOptions
from sattools.fit.stage import fit
from sattools.fit.surface.scene import start_scene
from sattools.scene import Scene
from sattools.scene.raster import read_raster
from sattools.simulate import SimulateOptions, simulate
from sattools.views import View

FIT = FitOptions(brdf="hapke", resolution=4.0, epochs=[8])


def scene_of(tmp_path: Path, **changed: Any) -> Scene:
    options = {"terrain": "natural", "id": "HARD", "size": 64.0, "views": 7, "units": 2, "seed": 2, "off_nadir": 16.0}
    return simulate(SimulateOptions(**{**options, **changed}), tmp_path / "HARD")


def change_images(scene: Scene, function: Any) -> None:
    for item in scene.items:
        path = scene.path(item.assets["image"].href)
        with rasterio.open(path, "r+") as data:
            data.write(function(data.read()).astype(np.uint16))


def check(scene: Scene, options: FitOptions = FIT) -> tuple[dict[str, np.ndarray], list[str]]:
    """Fit and export; every number finite, every parameter within its range. The maps and the notes."""
    notes = fit(scene, options)["notes"]
    tensors, _ = load(scene.path(scene.products["model"]))
    for name, tensor in tensors.items():
        assert torch.isfinite(tensor).all(), name
    export(scene, ExportOptions(view=[scene.items[0].id], undetermined="prior"))
    maps = {k: read_raster(scene.path(scene.products[k]))[0] for k in ("w", "b", "c", "theta", "normal", "reflectance")}
    maps |= {f"{k}_std": read_raster(scene.path(scene.products[f"{k}_std"]))[0] for k in ("w", "b", "c", "theta")}
    for name, array in maps.items():
        assert np.isfinite(array).all(), name
    for name, high in (("w", 0.98), ("b", 0.9), ("c", 1.0), ("theta", 50.0)):
        assert 0 <= maps[name].min() <= maps[name].max() <= high
    return maps, notes


def test_flat_ground_without_texture_has_no_structure_to_hold_on_to(tmp_path: Path) -> None:
    scene = scene_of(tmp_path, slope=0.0, units=1)
    change_images(scene, lambda a: np.full_like(a, 400))
    maps, _ = check(scene)
    assert maps["w"].std() < 0.05


def test_a_saturated_band_counts_as_unseen(tmp_path: Path) -> None:
    scene = scene_of(tmp_path)

    def saturate(a: Any) -> Any:
        a[0] = 4095
        return a

    change_images(scene, saturate)
    check(scene)


@pytest.mark.parametrize(("largest", "counted"), [(1.0, [1.0, 0.0, 1.0]), (1.6, [1.0, 1.0, 1.0])])
def test_one_is_full_scale_only_in_images_that_end_there(largest: float, counted: list[float]) -> None:
    """Reflectances at the top of the atmosphere are above 1 on bright slopes that face a low sun."""
    picture = np.full((1, 3, 2), 0.3, np.float32)
    picture[0, 1] = largest
    view = View("0", picture, np.ones((1, 3), np.uint8), ViewDirection(0.0, 0.0), 0.0, (0.0, 0.8, 0.6), 0.0)
    plain = start_scene(torch.zeros(1, 3), torch.full((1, 3, 2), 0.3), torch.ones(1, 2), torch.zeros(1, 2), 0.4, True)
    maps = {"amplitude": torch.zeros(1, 3, 2), "abundances": torch.ones(1, 3, 1), "scale": torch.ones(1)}
    scene = ReflectiveScene(**plain.tensors(), absolute=True, **maps)
    assert scene.samples([view], [None]).weight[0].tolist() == counted


@pytest.mark.slow
def test_a_low_sun(tmp_path: Path) -> None:
    _, notes = check(scene_of(tmp_path, sun_elevation=12.0))
    assert any("12 degrees high" in text for text in notes)


@pytest.mark.slow
def test_near_opposition(tmp_path: Path) -> None:
    """The sun behind the sensor: phase angles of a few degrees, and one view that looks along the sunlight."""
    check(scene_of(tmp_path, sun_azimuth=10.0, sun_elevation=80.0))


@pytest.mark.slow
def test_a_narrow_span_of_phase_angles_is_said(tmp_path: Path) -> None:
    _, notes = check(scene_of(tmp_path, off_nadir=10.0, sun_azimuth=100.0, sun_elevation=60.0))
    assert any("does not show a phase function" in text for text in notes)


@pytest.mark.slow
def test_steep_slopes_that_face_away(tmp_path: Path) -> None:
    scene = scene_of(tmp_path, slope=50.0, sun_elevation=35.0)
    truth = read_raster(scene.path(scene.products["truth_normal"]))[0]
    assert (np.degrees(np.arccos(truth[2])) > 60).mean() > 0.1
    check(scene)


@pytest.mark.slow
@pytest.mark.parametrize("factor", [0.0, 0.02])
def test_ground_that_is_almost_black(tmp_path: Path, factor: Any) -> None:
    scene = scene_of(tmp_path)
    change_images(scene, lambda a: np.maximum(a * factor, 1))  # 0 all over would be no image at all
    maps, _ = check(scene)
    assert maps["w"].mean() < 0.06


@pytest.mark.slow
def test_bright_salt(tmp_path: Path) -> None:
    scene = scene_of(tmp_path, units=6)
    change_images(scene, lambda a: np.minimum(a.astype(np.float64) * 1.5, 4095))
    check(scene)


@pytest.mark.slow
def test_rpv_holds_out_there_too(tmp_path: Path) -> None:
    scene = scene_of(tmp_path, slope=50.0, sun_elevation=20.0, reflectance="rpv")
    fit(scene, FitOptions(brdf="rpv", resolution=4.0, epochs=[8]))
    tensors, _ = load(scene.path(scene.products["model"]))
    assert all(torch.isfinite(t).all() for t in tensors.values())
