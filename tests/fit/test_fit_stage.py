"""The stage `fit`: what it needs, what it leaves out, what it writes."""

import csv
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from towns import Done, copied

from sattools.camera.rpc import RPC
from sattools.errors import InputError, OutputExistsError, SceneError
from sattools.fit.checkpoint import load
from sattools.fit.illumination import exposed
from sattools.fit.options import FitOptions
from sattools.fit.stage import choose_device, fit
from sattools.fit.surface.pose import remove_gauge
from sattools.prior.stage import write_maps
from sattools.scene import Grid, Scene
from sattools.scene.raster import read_raster
from sattools.scene.regrid import resize_map
from sattools.views import load_sources

QUICK = FitOptions(resolution=2.0, coarsest=2.0, epochs=[5])


def height(scene: Any) -> Any:
    return load(scene.root / "fit/model.safetensors")[0]["height"]


@pytest.fixture(scope="module")
def quick(hamlet_source: Scene, tmp_path_factory: pytest.TempPathFactory) -> Done:
    """The small scene fitted without a prior that was given."""
    scene, told = copied(hamlet_source, tmp_path_factory.mktemp("quick") / "HAMLET"), []
    found = fit(scene, QUICK, lambda share, message: told.append((round(share, 3), message)))
    return Done(scene, found, told)


def test_model_and_trace_are_written_and_named(quick: Done) -> None:
    scene = quick.scene
    assert scene.products["model"] == "fit/model.safetensors"
    tensors, meta = load(scene.path(scene.products["model"]))
    grid = Grid.from_dict(meta["grid"])
    assert grid == scene.grid.resized(2.0)
    assert tuple(tensors["height"].shape) == grid.shape == (16, 16)
    assert tensors["albedo"].shape == (16, 16, 3)
    low, high = scene.height_range_m
    assert low <= float(tensors["height"].min()) < float(tensors["height"].max()) <= high
    assert meta["items"] == [item.id for item in scene.items]
    with open(scene.path(scene.products["trace"]), newline="") as file:
        rows = list(csv.DictReader(file))
    assert [int(r["epoch"]) for r in rows] == [1, 2, 3, 4, 5]
    seconds = [float(r["seconds"]) for r in rows]
    assert seconds == sorted(seconds)
    assert float(rows[-1]["loss"]) < float(rows[0]["loss"])
    assert quick.found["fit"]["epochs"] == 5


def test_a_held_out_image_has_no_influence(make_row: Any) -> None:
    with_it, without = make_row("WITH"), make_row("WITHOUT")
    gone = with_it.items[2].id
    fit(with_it, replace(QUICK, holdout=[gone]))
    without.items = [item for item in without.items if item.id != gone]
    fit(without, QUICK)
    assert torch.equal(height(with_it), height(without))
    assert [item.id for item in with_it.items if item.held_out] == [gone]
    # and the next fit is as free as if this one had not been
    fit(with_it, replace(QUICK, epochs=[1], prior_weight=0.0))
    assert not [item.id for item in with_it.items if item.held_out]


def test_an_image_to_hold_out_must_be_there(make_hamlet: Any) -> None:
    with pytest.raises(SceneError, match="found no item 'nobody' to hold out"):
        fit(make_hamlet(), replace(QUICK, holdout=["nobody"]))


def test_one_image_is_not_enough(make_hamlet: Any) -> None:
    scene = make_hamlet()
    scene.items = scene.items[:1]
    with pytest.raises(SceneError, match="found 1 training image, expected at least 2"):
        fit(scene, QUICK)


def test_watching_the_error_does_not_change_the_fit(quick: Done, make_hamlet: Any) -> None:
    watched = make_hamlet("WATCHED")
    fit(watched, replace(QUICK, reference=str(watched.path(watched.products["truth_dsm"]))))
    assert torch.equal(height(quick.scene), height(watched))
    with open(watched.path("fit/trace.csv"), newline="") as file:
        errors = [float(row["mae_m"]) for row in csv.DictReader(file)]
    assert len(errors) == 5
    assert all(0 < e < 30 for e in errors)


def test_a_budget_stops_the_fit_and_keeps_what_it_has(make_matched_hamlet: Any) -> None:
    scene = make_matched_hamlet()
    notes = fit(scene, replace(QUICK, epochs=[100000], budget=0.5))
    assert "stopped by the budget of 0.5 s at cell 2 m" in notes["notes"]
    assert torch.isfinite(height(scene)).all()


def test_a_fit_says_how_long_its_own_prior_took(quick: Done, make_matched_hamlet: Any, tmp_path: Path) -> None:
    assert quick.found["prior_seconds"] > 0
    for other in (make_matched_hamlet("GIVEN"), copied(quick.scene, tmp_path / "OWN")):  # which has one now
        assert "prior_seconds" not in fit(other, replace(QUICK, epochs=[1]))


def test_a_fit_tells_that_it_solves_for_albedo_and_how_long_that_took(quick: Done) -> None:
    last = quick.told[-8:]
    # 0.2 of the whole made the prior, 0.8 of the rest found heights
    assert last == [
        (0.84, last[0][1]),
        *((round(0.84 + 0.08 * k / 4, 3), f"albedo: image {k + 1}/4") for k in range(4)),
        (0.92, "albedo: colours of the images"),
        (0.936, "albedo: cells"),
        (1.0, "fitted"),
    ]
    assert last[0][1].startswith("2 m, epoch 5/5, loss ")
    assert quick.found["albedo_seconds"] > 0


def test_a_reflectance_model_has_its_albedo_from_the_descent(make_matched_hamlet: Any) -> None:
    assert "albedo_seconds" not in fit(make_matched_hamlet(), replace(QUICK, brdf="rpv", epochs=[1]))


def test_an_existing_model_needs_overwrite(quick: Done) -> None:
    with pytest.raises(OutputExistsError, match="--overwrite"):
        fit(quick.scene, QUICK, overwrite=False)


def test_images_without_sun_are_fitted_without_shadows(make_hamlet: Any) -> None:
    scene = make_hamlet()
    for item in scene.items:
        del item.properties["view:sun_elevation"]
    fit(scene, QUICK)
    assert load(scene.root / "fit/model.safetensors")[1]["suns"] == [None] * 4


def test_the_unit_of_linear_radiance_does_not_matter(make_matched_hamlet: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    """Images of half the radiance: the same surface and half the albedo, to the bit, as the factor is two."""
    # on one prior: correlation in windows knows no units either, but not to the bit
    whole, dim = make_matched_hamlet("WHOLE"), make_matched_hamlet("DIM")
    fit(whole, QUICK)

    def darker(scene: Any, items: Any, *more: Any) -> Any:
        return [replace(source, radiance=source.radiance / 2) for source in load_sources(scene, items, *more)]

    monkeypatch.setattr("sattools.fit.whole.load_sources", darker)
    fit(dim, QUICK)
    bright, dark = (load(scene.path("fit/model.safetensors"))[0] for scene in (whole, dim))
    assert torch.equal(bright["height"], dark["height"])
    assert torch.allclose(bright["albedo"], 2 * dark["albedo"], rtol=1e-5)
    assert torch.allclose(bright["offset"], 2 * dark["offset"], rtol=1e-4, atol=1e-6)


def test_exposure_leaves_tone_mapped_and_bright_images_alone(make_hamlet: Any) -> None:
    scene = make_hamlet()
    sources = load_sources(scene, scene.train_items())
    dim = [replace(source, radiance=np.full((1, 9, 9), 0.1, np.float32)) for source in sources]
    found, factor = exposed(dim)
    assert factor == pytest.approx(10 / 3, rel=1e-6)
    assert float(found[0].radiance.max()) == pytest.approx(1 / 3, rel=1e-6)
    assert exposed([replace(source, linear=False) for source in dim])[1] == 1
    assert exposed([replace(source, radiance=source.radiance * 6) for source in dim])[1] == 1


def test_missing_files_and_members_are_named(make_hamlet: Any) -> None:
    scene = make_hamlet()
    scene.path("images/HAMLET_003.tif").unlink()
    with pytest.raises(InputError, match=r"HAMLET_003\.tif: no such file"):
        fit(scene, QUICK)
    del scene.items[1].assets["rpc"]
    with pytest.raises(SceneError, match="item HAMLET_002 has no asset 'rpc'"):
        fit(scene, QUICK)
    scene = make_hamlet("NOGRID")
    scene.grid = None
    with pytest.raises(SceneError, match="found no grid"):
        fit(scene, QUICK)
    assert not (scene.root / "fit/model.safetensors").exists()


def test_a_machine_without_cuda_says_so() -> None:
    assert choose_device("cpu").type == "cpu"
    if torch.cuda.is_available():
        assert choose_device("cuda").type == choose_device("auto").type == "cuda"
    else:
        assert choose_device("auto").type == "cpu"
        with pytest.raises(SceneError, match="found no CUDA device"):
            choose_device("cuda")


def test_a_view_whose_camera_is_off_by_a_pixel_is_moved_back(make_hamlet: Any) -> None:
    """A camera that points one pixel (0.5 m) too far east is answered by rays half a metre further east.

    Less the part that a shift of everything and another height would explain, which the images cannot tell.
    """
    right, wrong = make_hamlet("RIGHT"), make_hamlet("WRONG")
    # of four cameras the one whose shift is least like one of everything
    path = wrong.path(wrong.items[3].assets["rpc"].href)
    path.write_text(RPC.from_file(path).shifted(1.0, 0.0).to_rpc_txt())
    options = FitOptions(resolution=1.0, coarsest=2.0, epochs=[20, 40])  # with 16 it has gone 0.56 of the way
    poses = []
    for scene in (right, wrong):
        fit(scene, options)
        tensors, meta = load(scene.root / "fit/model.safetensors")
        poses.append(tensors["pose"].numpy())
    moved = np.zeros((4, 2))
    moved[3, 0] = 0.5
    expected = remove_gauge(moved, meta["slopes"])
    found = (poses[1] - poses[0])[3]
    assert abs(expected[3, 0]) > 0.2
    # the steps are damped and the surface adapts meanwhile: most of the way, in the right direction
    assert found[0] / expected[3, 0] == pytest.approx(1, abs=0.5)
    assert abs(found[1] - expected[3, 1]) < 0.15


@pytest.mark.parametrize(("confidence", "back"), [(0.01, True), (0.0, False)])
def test_cells_that_stray_from_the_prior_take_its_height_back_unless_it_was_a_guess(
    make_hamlet: Any, confidence: Any, back: Any
) -> None:
    scene = make_hamlet()
    truth, grid = read_raster(scene.path(scene.products["truth_dsm"]))
    # steps everywhere, which the fit smoothes by metres
    wrong = truth[0] + np.random.default_rng(0).choice([0.0, 6.0], truth[0].shape).astype(np.float32)
    write_maps(scene, wrong, np.full_like(wrong, confidence), grid)
    notes = fit(scene, replace(QUICK, epochs=[40]))["notes"]
    model, meta = load(scene.path(scene.products["model"]))
    apart = np.abs(model["height"].numpy() - resize_map(wrong, grid, Grid.from_dict(meta["grid"])))
    assert (float(apart.max()) <= 2.0) == back
    assert any("put back" in text for text in notes) == back
