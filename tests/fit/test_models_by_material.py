"""`--brdf auto` by material: ground that Lambert's law explains has no other model, whatever the rest of it needs."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from made_up_cells import made_up, unit
from towns import copied

from sattools.compare.brdf import Place, place_in
from sattools.export.options import ExportOptions
from sattools.export.stage import export
from sattools.fit.checkpoint import load
from sattools.fit.materials.inversion import (
    Samples,
    invert,
    predict,
    shape_of,
    shape_shares,
    start_endmembers,
)
from sattools.fit.materials.parameters import AMPLITUDE, SHAPE, Kind, radiance_factor
from sattools.fit.materials.selection import Need, choose_model, plain_materials
from sattools.fit.materials.sky import sky_gain
from sattools.fit.materials.uncertainty import known_share, shape_correlation
from sattools.fit.options import FitOptions
from sattools.fit.stage import fit
from sattools.prior import PriorOptions
from sattools.prior.stage import prior
from sattools.scene import Scene
from sattools.scene.raster import read_raster
from sattools.simulate import SimulateOptions, simulate

CELLS = 1800
BLOCK = torch.arange(CELLS) // 6
ROUGH = (0.3, 0.5, 25.0)  # b, c, theta


def raw_shapes(kind: Kind, *shapes: tuple[float, float, float]) -> torch.Tensor:
    parts = [[p.raw(torch.tensor(v, dtype=torch.float64)) for p, v in zip(SHAPE[kind], s, strict=True)] for s in shapes]
    return torch.tensor(parts, dtype=torch.float64)


def mixed_ground(plain: list[float]) -> Samples:
    """Materials of Hapke's model, but for the plain ones, which are Lambert's; noise of 1 %."""
    s, _ = made_up("hapke", raw_shapes("hapke", *[ROUGH] * len(plain)), CELLS, torch.tensor(plain, dtype=torch.float64))
    noise = torch.randn(s.seen.shape, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    return replace(s, seen=s.seen * (1 + 0.01 * noise))


def test_plain_ground_sends_to_all_sides_what_its_model_reflects_of_light_from_all_sides() -> None:
    up, w = unit((0.0, 0.0, 1.0)), torch.tensor([[0.64]], dtype=torch.float64)
    sun = unit((3**0.5, 0.0, 1.0))  # 60 degrees from the vertical: cos i = 0.5
    shape = tuple(torch.tensor([v], dtype=torch.float64) for v in ROUGH)
    for view in (up, unit((0.5, 0.2, 1.0))):
        # sqrt(1 - 0.64) = 0.6, so that r0 = 0.4 / 1.6
        plain = radiance_factor("hapke", up[None], sun, view, w, shape, plain=torch.ones(1, dtype=torch.float64))
        assert float(plain) == pytest.approx(0.25 * 0.5, rel=1e-12)
        rpv = radiance_factor("rpv", up[None], sun, view, w, shape, plain=torch.ones(1, dtype=torch.float64))
        assert float(rpv) == pytest.approx(0.64 * 0.5, rel=1e-12)
    away = radiance_factor("hapke", -up[None], sun, up, w, shape, plain=torch.ones(1, dtype=torch.float64))
    assert float(away) == 0.0


@pytest.mark.parametrize("kind", ["rpv", "hapke"])
def test_gradients_of_partly_plain_ground(kind: Kind) -> None:
    shape = tuple(p.bounded(torch.tensor([0.1, -0.2], dtype=torch.float64)) for p in SHAPE[kind])
    sun, view = unit((0.4, -0.3, 1.0)), unit((0.1, 0.2, 1.0))
    slopes = torch.tensor([[0.1, 0.2], [-0.2, 0.1]], dtype=torch.float64, requires_grad=True)
    amplitude = torch.tensor([[0.3, 0.5], [0.6, 0.2]], dtype=torch.float64, requires_grad=True)
    share = torch.tensor([0.3, 1.0], dtype=torch.float64, requires_grad=True)

    def light(slopes: torch.Tensor, amplitude: torch.Tensor, share: torch.Tensor) -> torch.Tensor:
        normal = unit_of(torch.cat([slopes, torch.ones_like(slopes[:, :1])], 1))
        return radiance_factor(kind, normal, sun, view, amplitude, shape, plain=share)

    assert torch.autograd.gradcheck(light, (slopes, amplitude, share))


def unit_of(v: torch.Tensor) -> torch.Tensor:
    return v / v.norm(dim=-1, keepdim=True)


def test_plain_ground_sends_its_share_of_an_open_sky_too() -> None:
    flat, up = torch.zeros(12, 12, dtype=torch.float64), torch.zeros(12, 12, 3, dtype=torch.float64)
    up[..., 2] = 1
    shape = tuple(torch.full((12, 12), v, dtype=torch.float64) for v in ROUGH)
    gain, _ = sky_gain(
        "hapke", flat, up, 1.0, torch.full((12, 12, 1), 0.4).double(), shape, plain=torch.ones_like(flat)
    )
    # nodes and spokes add up to the whole sky within rounding
    torch.testing.assert_close(gain, torch.ones_like(gain), rtol=1e-6, atol=1e-6)


@pytest.mark.parametrize("relative", [False, True])
@pytest.mark.parametrize("plain", [[0.0, 1.0], [1.0, 1.0, 0.0], [0.0, 0.0]])
def test_materials_of_lamberts_law_are_told_from_those_that_need_the_model(plain: list[float], relative: bool) -> None:
    found, notes = plain_materials("hapke", mixed_ground(plain), BLOCK, relative)
    assert found.tolist() == plain
    assert ["which is enough" in note for note in notes] == [bool(p) for p in plain]


def test_one_material_that_needs_a_model_is_enough_to_take_it() -> None:
    """Four fifths of the ground are Lambert's: no model predicts it better as a whole."""
    choice = choose_model(mixed_ground([1.0, 1.0, 1.0, 1.0, 0.0]), BLOCK, relative=False)
    assert "kept lambert" in choice.notes[0]
    assert "kept lambert" in choice.notes[1]
    assert choice.model in ("rpv", "hapke")
    # materials are found again on the fitted surface, where the same one may have another number
    assert "auto: one material (" in choice.notes[2]


def test_one_material_alone_needs_a_model_by_half_of_the_error_and_four_standard_errors() -> None:
    """Of towns, models take up to a quarter off one material's error by chance and by wrong heights."""
    assert Need(0, share=0.15, gain=0.75, doubt=0.11).surely
    assert not Need(0, share=0.31, gain=0.26, doubt=0.01).surely
    assert not Need(0, share=0.31, gain=0.75, doubt=0.2).surely
    assert not Need(0, share=0.03, gain=0.75, doubt=0.11).surely


def test_a_scenes_model_is_kept_for_what_is_too_little_to_tell() -> None:
    assert Need(0, share=0.3, gain=0.5, doubt=0.1).needed
    assert not Need(0, share=0.3, gain=0.1, doubt=0.1).needed
    assert Need(0, share=0.03, gain=0.1, doubt=0.1).needed  # little of it, and it may
    assert not Need(0, share=0.03, gain=-1.0, doubt=0.1).needed
    assert Need(0, share=0.3, gain=0.0, doubt=float("inf")).needed


def test_ground_of_lamberts_law_alone_takes_no_model_for_one_material_of_many() -> None:
    choice = choose_model(mixed_ground([1.0] * 6), BLOCK, relative=False)
    assert choice.model == "lambert"
    assert len(choice.notes) == 2


def test_a_scene_that_needs_a_model_keeps_it_where_no_material_tells() -> None:
    few = mixed_ground([0.0, 1.0]).subset(torch.arange(40))
    assert plain_materials("hapke", few, BLOCK[:40], relative=False) == (pytest.approx([0.0, 0.0]), [])
    everywhere = plain_materials("hapke", mixed_ground([1.0, 1.0]), BLOCK, relative=False)
    assert everywhere[0].tolist() == [0.0, 0.0]


def test_shapes_of_plain_materials_stay_their_prior_and_count_as_unknown() -> None:
    plain = torch.tensor([0.0, 1.0, 1.0], dtype=torch.float64)
    s = replace(mixed_ground(plain.tolist()), plain=plain)
    start = start_endmembers("hapke", 3, s.normal)
    solution = invert("hapke", s, start)
    torch.testing.assert_close(solution.endmembers[1:], start[1:])
    assert float(known_share("hapke", solution)[1:].max()) < 1e-9
    assert float(known_share("hapke", solution)[0].min()) > 0.5
    # cells of two materials, as their borders have: they say much of the one shape, and nothing of what has none
    share = torch.tensor([[0.1, 0.9, 0.0]], dtype=torch.float64)
    borders = replace(s, abundances=torch.where(s.abundances[:, :1] > 0.5, share, s.abundances))
    solution_there = invert("hapke", borders, start)
    assert float(known_share("hapke", solution_there)[0, 0]) > 0.5
    assert float(known_share("hapke", solution_there)[1:].max()) < 1e-3
    # the errors of what has no shape do not correlate, and two of three would be the median
    assert shape_correlation(solution) == pytest.approx(0.0, abs=1e-6)
    assert shape_correlation(solution, plain) < -0.9
    # plain ground takes nothing of the other's phase function
    again = predict("hapke", s, solution.amplitude, solution.endmembers)
    assert float((again - s.seen).abs().mean() / s.seen.mean()) < 0.01  # noise of 1 % has 0.8 % in the mean


def test_where_plain_ground_and_other_ground_meet_the_rest_has_the_others_shape() -> None:
    plain = torch.tensor([0.0, 1.0], dtype=torch.float64)
    meeting = torch.tensor([[1.0, 0.0], [0.1, 0.9], [0.0, 1.0]], dtype=torch.float64)
    shares = shape_shares(meeting, plain)
    # a plain material counts by a thousandth: 0.1 / (0.1 + 0.9e-3) = 0.991
    assert shares[:, 0].tolist() == pytest.approx([1.0, 0.99108, 0.0], abs=1e-5)
    assert shares.sum(-1).tolist() == pytest.approx([1.0, 1.0, 1.0])
    torch.testing.assert_close(shape_shares(meeting, None), meeting)
    # nine parts of ten are Lambert's and one is rough: theta of that one is known from such cells alone
    s = replace(mixed_ground([0.0, 1.0]), plain=plain)
    s = replace(s, abundances=torch.where(s.abundances[:, :1] > 0.5, meeting[1], meeting[2]))
    truth = raw_shapes("hapke", ROUGH, (0.2, 0.3, 10.0))
    amplitude = torch.zeros_like(s.seen[0])
    s = replace(s, seen=predict("hapke", s, amplitude, truth))
    found = invert("hapke", s, truth)
    here = shape_of("hapke", s.shape_shares, found.endmembers)[2][s.abundances[:, 0] > 0.05]
    assert here.tolist() == pytest.approx([25.0] * len(here), abs=1.0)  # the prior, of 20 degrees, pulls a little


AUTO = FitOptions(brdf="auto", resolution=2.0, epochs=[6])


@pytest.fixture(scope="module")
def mixed(tmp_path_factory: pytest.TempPathFactory) -> tuple[Scene, list[str]]:
    """Ground of two units, one of them Lambert's, 11 views within 45 degrees, fitted and exported."""
    options = SimulateOptions(
        terrain="natural", id="MIXED", size=160.0, views=11, train=11, off_nadir=45.0, units=2, plain_units=1, seed=5
    )
    scene = simulate(options, tmp_path_factory.mktemp("mixed") / "MIXED")
    prior(scene, PriorOptions())
    notes = fit(scene, AUTO)["notes"]
    export(scene, ExportOptions())
    return scene, notes


def test_a_map_says_which_ground_is_lamberts_and_no_shape_is_claimed_there(mixed: tuple[Scene, list[str]]) -> None:
    scene, notes = mixed
    truth = read_raster(scene.path(scene.products["truth_lambert_share"]))[0][0] > 0.5
    found = read_raster(scene.path(scene.products["lambert_share"]))[0][0]
    assert 0.2 < truth.mean() < 0.8
    assert ((found > 0.5) == truth).mean() > 0.9  # abundances are smoothed over some cells where units meet
    assert any("of them Lambert's" in note for note in notes)
    theta = read_raster(scene.path(scene.products["theta"]))[0][0]
    assert np.isnan(theta[found > 0.9]).all()


def test_a_fit_that_was_interrupted_and_resumed_has_the_same_model_and_tells_the_same(
    mixed: tuple[Scene, list[str]], tmp_path: Path
) -> None:
    """Why a material has no model is found once, where the model comes in; the checkpoint is of a later epoch."""

    class Interrupted(Exception):
        pass

    def progress(fraction: float, message: str) -> None:
        if "epoch 5/5" in message:
            raise Interrupted

    whole, notes = mixed
    cut = copied(whole, tmp_path / "CUT")
    with pytest.raises(Interrupted):
        fit(cut, AUTO, progress)
    again = fit(cut, replace(AUTO, resume=True))["notes"]
    assert any("which is enough" in note for note in notes)
    assert again == notes
    tensors = [load(scene.path(scene.products["model"]))[0] for scene in (whole, cut)]
    assert tensors[0].keys() == tensors[1].keys()
    for name, value in tensors[0].items():
        assert torch.equal(tensors[1][name], value), name


def test_pictures_of_the_model_hold_its_plain_ground(mixed: tuple[Scene, list[str]]) -> None:
    """BRF of level ground at standard geometry: on Lambert's ground r0 of w, whatever b, c and theta of the rest."""
    scene, _ = mixed
    tensors, _ = load(scene.path(scene.products["model"]))
    w = AMPLITUDE["hapke"].bounded(tensors["amplitude"])
    plain = (tensors["abundances"] @ tensors["plain"]) > 0.999
    assert plain.any()
    root = torch.sqrt(1 - w[plain])
    torch.testing.assert_close(tensors["albedo"][plain], (1 - root) / (1 + root), rtol=1e-3, atol=1e-4)


def test_simulated_plain_units_have_no_shape_and_look_alike_from_all_sides(mixed: tuple[Scene, list[str]]) -> None:
    scene, _ = mixed
    theta = read_raster(scene.path(scene.products["truth_theta"]))[0][0]
    share = read_raster(scene.path(scene.products["truth_lambert_share"]))[0][0]
    assert (np.isnan(theta) == (share > 0.5)).all()
    assert set(np.unique(share)) == {0.0, 1.0}


def test_a_place_on_plain_ground_is_lamberts_with_the_reflectance_of_its_w() -> None:
    values: dict[str, Any] = {"w": np.array([0.64, 0.36, 0.0]), "b": [np.nan], "c": [np.nan], "theta": [np.nan]}
    assert place_in(values, 0) is None
    assert place_in({**values, "lambert_share": np.array([1.0])}, 0) == Place("lambert", pytest.approx(0.25))
    assert place_in({**values, "lambert_share": np.array([1.0])}, 1) == Place("lambert", pytest.approx(1 / 9))
    shaped = {**values, "b": [0.3], "c": [0.5], "theta": [20.0], "lambert_share": np.array([0.2])}
    assert place_in(shaped, 0) == Place("hapke", 0.64, (0.3, 0.5, 20.0))
    rpv: dict[str, Any] = {"rho0": np.array([0.3]), "lambert_share": np.array([0.9])}
    assert place_in({**rpv, "k": [0.8], "asymmetry": [0.0], "rhoc": [1.0]}, 0) == Place("lambert", 0.3)


def test_too_little_ground_to_compare_models_on_is_told() -> None:
    """It was a change of -0.0 %, with a standard error of "inf %"."""
    few = choose_model(mixed_ground([0.0]), torch.arange(CELLS) // 200, relative=False)  # nine blocks
    assert few.model == "lambert"
    assert few.notes == [
        "brdf auto: too little ground is held out to tell rpv from lambert: kept lambert",
        "brdf auto: too little ground is held out to tell hapke from lambert: kept lambert",
    ]
