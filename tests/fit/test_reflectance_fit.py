"""A fit with a reflectance model: materials, inversion, the whole on a small natural scene, and resuming it."""

import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from made_up_cells import made_up, unit

from sattools.camera.view_direction import ViewDirection
from sattools.errors import InputError, SceneError
from sattools.fit.checkpoint import load
from sattools.fit.illumination import LEAST_KNOWN, light_scale, phase_angles, radiance_kind, views_left_out
from sattools.fit.materials.blocks import blocks_of
from sattools.fit.materials.blur import blurred
from sattools.fit.materials.endmembers import cluster_endmembers
from sattools.fit.materials.inversion import (
    Samples,
    invert,
    material_mean,
    predict,
    shape_of,
    solve_amplitudes,
    start_endmembers,
)
from sattools.fit.materials.normals import surface_normals
from sattools.fit.materials.parameters import AMPLITUDE, SHAPE, radiance_factor
from sattools.fit.materials.scene import ReflectiveScene
from sattools.fit.materials.selection import choose_model, extreme_views
from sattools.fit.materials.uncertainty import known_share, shape_correlation
from sattools.fit.options import FitOptions
from sattools.fit.stage import fit
from sattools.fit.surface.schedule import schedule
from sattools.reflectance import hapke
from sattools.render import sun_visibility
from sattools.scene import Scene
from sattools.scene.raster import read_raster
from sattools.simulate import SimulateOptions, simulate

SHORT = FitOptions(brdf="hapke", resolution=4.0, epochs=[10], pretrain=0.2)


@pytest.fixture(scope="module")
def source(tmp_path_factory: pytest.TempPathFactory) -> Scene:
    options = SimulateOptions(terrain="natural", id="HILL", size=128.0, views=9, units=3, seed=3)
    return simulate(options, tmp_path_factory.mktemp("hill") / "HILL")


@pytest.fixture
def make_hill(source: Any, tmp_path: Path) -> Any:
    def make(name: str = "HILL") -> Scene:
        shutil.copytree(source.root, tmp_path / name)
        scene = Scene.from_json(source.to_json())
        scene.root = tmp_path / name
        return scene

    return make


def test_light_of_a_cell_is_the_models_brf_times_the_cosine_of_incidence() -> None:
    normal, sun, view = (unit(v) for v in ((0.1, 0.2, 1.0), (0.5, -0.4, 0.75), (0.2, 0.1, 1.0)))
    w = torch.tensor([0.3, 0.4, 0.5], dtype=torch.float64)
    shape = [torch.tensor(v, dtype=torch.float64) for v in (0.2, 0.6, 12.0)]
    got = radiance_factor("hapke", normal, sun, view, w, shape)
    assert torch.allclose(got, hapke(normal, sun, view, w, 0.2, 0.6, 12.0) * (normal @ sun))
    away = radiance_factor("hapke", unit((-1.0, 0.8, 0.1)), sun, view, w, shape)
    assert (away == 0).all()


def test_normals_of_a_plane_are_exact_up_to_its_edge() -> None:
    y, x = torch.meshgrid(torch.arange(9.0), torch.arange(7.0), indexing="ij")
    normal = surface_normals(5 + 2 * (0.3 * x - 0.1 * y), 2.0)  # rises 0.3 to the east, 0.1 to the north
    expected = torch.tensor([-0.3, -0.1, 1.0]) / (1 + 0.09 + 0.01) ** 0.5
    assert torch.allclose(normal, expected.expand_as(normal), atol=1e-6)
    assert torch.allclose(blurred(torch.full((5, 6), 3.0), 2.0), torch.full((5, 6), 3.0))


def test_ranges_hold_and_come_back() -> None:
    for parameter in (*SHAPE["hapke"], *SHAPE["rpv"], AMPLITUDE["hapke"]):
        value = torch.linspace(parameter.low + 0.01, parameter.high - 0.01, 5, dtype=torch.float64)
        assert torch.allclose(parameter.bounded(parameter.raw(value)), value)
        far = parameter.bounded(torch.tensor([-50.0, 50.0]))
        assert parameter.low <= far[0] < far[1] <= parameter.high


@pytest.mark.parametrize("kind", ["hapke", "rpv"])
def test_amounts_are_found_exactly_where_the_shapes_are_known(kind: Any) -> None:
    endmembers = start_endmembers(kind, 2, torch.zeros(1, dtype=torch.float64))
    samples, amplitude = made_up(kind, endmembers, 200)
    found, _ = solve_amplitudes(kind, samples, endmembers, rounds=12)
    values = [AMPLITUDE[kind].bounded(a) for a in (found, amplitude)]
    assert torch.allclose(*values, atol=2e-3)


def test_slopes_tell_the_roughness_of_materials() -> None:
    """theta-bar of two materials, 8 and 30 degrees, from seven views within 50 degrees of each other."""
    b, c, theta = SHAPE["hapke"]
    one = [b.raw(torch.tensor(0.3)), c.raw(torch.tensor(0.5))]
    endmembers = torch.tensor([[*one, theta.raw(torch.tensor(t))] for t in (8.0, 30.0)], dtype=torch.float64)
    samples, amplitude = made_up("hapke", endmembers)
    found = invert("hapke", samples, start_endmembers("hapke", 2, endmembers))
    assert theta.bounded(found.endmembers[:, 2]).tolist() == pytest.approx([8, 30], abs=2.0)
    w, truth = (AMPLITUDE["hapke"].bounded(a) for a in (found.amplitude, amplitude))
    assert float(((w - truth) ** 2).mean().sqrt()) < 0.02
    _, _, cell = shape_of("hapke", samples.abundances, found.endmembers)
    assert cell.min() >= 0.2
    assert cell.max() <= 50


def test_materials_are_told_apart_by_colour_not_by_shading() -> None:
    rng = np.random.default_rng(0)
    truth = np.zeros((60, 80), int)
    truth[:, 40:] = 1
    colours = np.array([[0.30, 0.22, 0.16], [0.28, 0.27, 0.26]])
    shading = rng.uniform(0.75, 1.25, (60, 80, 1))
    abundances = cluster_endmembers(
        colours[truth] * shading * rng.normal(1, 0.02, (60, 80, 3)), np.ones((60, 80), bool)
    )
    assert np.allclose(abundances.sum(-1), 1, atol=1e-5)
    left, right = abundances[:, :35].mean((0, 1)), abundances[:, 45:].mean((0, 1))
    assert np.abs(left - right).sum() / 2 > 0.95
    plain = cluster_endmembers(np.full((20, 20, 3), 0.3), np.ones((20, 20), bool))
    assert plain.shape == (20, 20, 1)


def test_the_scene_states_what_its_numbers_are(source: Any) -> None:
    assert radiance_kind(source, source.items) == "reflectance_factor"
    assert light_scale("toa_reflectance", (0.0, 0.6, 0.8)) == pytest.approx(1.25)
    assert light_scale("reflectance_factor", (0.0, 0.6, 0.8)) == 1.0
    wrong = Scene.from_json(source.to_json())
    wrong.items[0].properties["sattools:radiance"] = "furlongs"
    with pytest.raises(SceneError, match="furlongs"):
        radiance_kind(wrong, wrong.items)
    wrong.items[0].properties.pop("sattools:radiance")
    with pytest.raises(SceneError, match="one kind"):
        radiance_kind(wrong, wrong.items)


def test_views_near_the_nadir_are_chosen_and_the_others_held_out(source: Any) -> None:
    scene = Scene.from_json(source.to_json())
    for item in scene.items:
        item.properties["sattools:role"] = "train"
    left_out = views_left_out(scene, "nearest-nadir:3")
    assert [i.id[-3:] for i in scene.items if i.id not in left_out] == ["004", "005", "006"]
    with pytest.raises(InputError, match="nearest-nadir:N"):
        views_left_out(scene, "nearest-nadir:some")


def test_phase_angles() -> None:
    class Sight:
        sun = (0.0, 40.0)
        properties = {"view:azimuth": 0.0, "view:off_nadir": 20.0}  # noqa: RUF012

    assert phase_angles([Sight()]).tolist() == pytest.approx([30.0])  # 50 - 20 in one plane


def test_the_model_comes_in_after_a_share_of_the_last_stage() -> None:
    stages = schedule(replace(SHORT, epochs=[10], coarsest=8.0), 2.0, (0.0, 10.0), True)
    assert [(s.cell_size, s.epochs, s.reflective) for s in stages] == [(8, 10, False), (4, 2, False), (4, 8, True)]
    assert stages[1].softness[1] == stages[2].softness[0]
    at_once = schedule(replace(SHORT, pretrain=0.0), 2.0, (0.0, 10.0), True)
    assert [(s.epochs, s.reflective) for s in at_once] == [(10, True)]


def test_a_fit_finds_reflectance_with_its_uncertainty_and_resumes_exactly(make_hill: Any) -> None:
    whole, broken = make_hill("WHOLE"), make_hill("BROKEN")
    notes = fit(whole, SHORT)["notes"]
    tensors, meta = load(whole.root / "fit/model.safetensors")
    assert meta["brdf"] == "hapke"
    assert meta["radiance"] == "reflectance_factor"
    assert any("phase angles" in r for r in notes)
    assert all(torch.isfinite(t).all() for t in tensors.values())
    assert (tensors["gain"] == 1).all()
    assert (tensors["offset"] == 0).all()
    truth = read_raster(whole.path(whole.products["truth_w"]))[0]
    w = AMPLITUDE["hapke"].bounded(tensors["amplitude"]).permute(2, 0, 1).numpy()
    truth = truth.reshape(3, 32, 2, 32, 2).mean((2, 4))
    # cells twice as large as the truth's; the target for the scene as a whole is 0.1 (benchmarks/reflectance_recovery)
    assert np.sqrt(((w - truth) ** 2).mean()) / truth.mean() < 0.2
    assert np.corrcoef(w.ravel(), truth.ravel())[0, 1] > 0.9
    assert tensors["w_std"].shape == tensors["amplitude"].shape
    assert (tensors["theta_std"] > 0).all()

    class Interrupted(Exception):
        pass

    def progress(fraction: float, message: str) -> None:
        if "epoch 6/8" in message:
            raise Interrupted

    with pytest.raises(Interrupted):
        fit(broken, SHORT, progress)
    assert (broken.root / "fit/checkpoint.safetensors").exists()
    fit(broken, replace(SHORT, resume=True))
    again, _ = load(broken.root / "fit/model.safetensors")
    assert again.keys() == tensors.keys()
    for name in tensors:
        assert torch.equal(again[name], tensors[name]), name


def test_line_of_sight_is_a_unit_vector_to_the_sensor() -> None:
    assert ViewDirection(0.75, 0.0).unit() == pytest.approx((0.6, 0.0, 0.8))


def test_a_model_without_a_sun_is_refused(make_hill: Any) -> None:
    scene = make_hill()
    del scene.train_items()[0].properties["view:sun_azimuth"]
    with pytest.raises(SceneError, match="sun angles"):
        fit(scene, SHORT)


def seen_by_noise(samples: Samples) -> Samples:
    g = torch.Generator().manual_seed(1)
    noise = torch.randn(samples.seen.shape, generator=g, dtype=torch.float64)
    return replace(samples, seen=samples.seen + 0.01 * samples.seen * noise)


@pytest.mark.parametrize(("endmembers", "expected"), [((0.3, 0.5, 25.0), ("rpv", "hapke")), (None, ("lambert",))])
def test_auto_takes_a_model_only_where_it_predicts_held_out_views_better(endmembers: Any, expected: Any) -> None:
    if endmembers is None:
        samples, amplitude = made_up("hapke", start_endmembers("hapke", 1, torch.zeros(1, dtype=torch.float64)), 900)
        cosine = torch.stack([samples.normal @ sun for sun in samples.suns])
        seen = 0.4 * AMPLITUDE["hapke"].bounded(amplitude) * cosine[..., None]
    else:
        raw = [p.raw(torch.tensor(v, dtype=torch.float64)) for p, v in zip(SHAPE["hapke"], endmembers, strict=True)]
        samples, _ = made_up("hapke", torch.stack(raw)[None], 900)
        seen = samples.seen
    samples = seen_by_noise(replace(samples, seen=seen))
    choice = choose_model(samples, torch.arange(900) // 9, relative=False)
    assert choice.model in expected
    assert len(choice.notes) == 2
    assert all("held-out views" in text and "standard error" in text for text in choice.notes)


def test_auto_does_not_take_robustness_against_outliers_for_a_phase_function() -> None:
    samples, amplitude = made_up("hapke", start_endmembers("hapke", 1, torch.zeros(1, dtype=torch.float64)), 900)
    cosine = torch.stack([samples.normal @ sun for sun in samples.suns])
    seen = 0.4 * AMPLITUDE["hapke"].bounded(amplitude) * cosine[..., None]
    random = torch.Generator().manual_seed(7)
    wrong = torch.rand(seen.shape[:2], generator=random) < 0.05  # heights a cell off: views that show something else
    seen = torch.where(wrong[..., None], 1.6 * seen, seen)
    samples = seen_by_noise(replace(samples, seen=seen))
    assert choose_model(samples, torch.arange(900) // 9, relative=False).model == "lambert"


def test_auto_does_not_take_the_parallax_of_wrong_heights_for_a_phase_function() -> None:
    """A fifth of the blocks drifts by up to 9 % from the first view to the last, as flattened relief does."""
    samples, amplitude = made_up("hapke", start_endmembers("hapke", 1, torch.zeros(1, dtype=torch.float64)), 900)
    cosine = torch.stack([samples.normal @ sun for sun in samples.suns])
    seen = 0.4 * AMPLITUDE["hapke"].bounded(amplitude) * cosine[..., None]
    block = torch.arange(900) // 9
    drift = torch.where(block % 5 == 0, torch.linspace(-0.09, 0.09, 7, dtype=torch.float64)[:, None], 0.0)
    samples = seen_by_noise(replace(samples, seen=seen * (1 + drift[..., None])))
    assert choose_model(samples, block, relative=False).model == "lambert"


def test_what_lies_in_shade_is_of_the_material_that_lies_nearest() -> None:
    colour = np.full((20, 20, 3), 0.4)
    colour[:, 10:] = 0.1, 0.2, 0.3
    colour += 0.002 * np.random.default_rng(0).standard_normal(colour.shape)
    known = np.ones((20, 20), bool)
    known[5:10, 2:7] = False
    colour[~known] = 0.0
    abundances = cluster_endmembers(colour, known, most=3, blur=0.1)
    left, right = (abundances[:, columns].mean(axis=(0, 1)) for columns in (slice(0, 8), slice(12, 20)))
    assert left @ right < 0.02
    assert abundances[5:10, 2:7].reshape(-1, abundances.shape[-1]) @ right == pytest.approx(0, abs=0.02)


def test_cells_that_no_view_shows_in_the_sun_have_no_say_in_their_materials_mean() -> None:
    abundances = torch.tensor([[1.0, 0.0], [1.0, 0.0], [0.0, 1.0]])
    amplitude = torch.tensor([[0.5], [-7.0], [2.0]])
    counted = torch.tensor([[1.0], [0.0], [1.0]])
    assert material_mean(abundances, amplitude, counted)[:, 0].tolist() == pytest.approx([0.5, 0.5, 2.0], rel=1e-5)


def test_bumps_that_the_normals_do_not_show_cast_no_shadow() -> None:
    height = torch.zeros(30, 30)
    height[15, 15] = 3.0
    low_sun = (0.94, 0.0, 0.34)
    maps = {"amplitude": torch.zeros(30, 30, 3), "abundances": torch.ones(30, 30, 1), "endmembers": torch.zeros(1, 3)}
    none = torch.zeros(1, 3)
    rest = {"albedo": maps["amplitude"], "gain": none, "offset": none, "ambient": none, "pose": torch.zeros(1, 2)}
    scene = ReflectiveScene(height=height, kind="hapke", cell_size=2.0, **maps, **rest)
    assert float(sun_visibility(scene.height, 2.0, low_sun).min()) == 0
    assert float(sun_visibility(scene.casting(), 2.0, low_sun).min()) > 0.9


def test_auto_holds_out_the_views_at_either_end_of_the_phase_angles() -> None:
    samples, _ = made_up("hapke", start_endmembers("hapke", 1, torch.zeros(1, dtype=torch.float64)), 20)
    assert sorted(extreme_views(samples)) == [0, 6]
    few = replace(
        samples, seen=samples.seen[:2], weight=samples.weight[:2], suns=samples.suns[:2], views=samples.views[:2]
    )
    assert choose_model(few, torch.zeros(20, dtype=torch.int64), False).model == "lambert"


def test_blocks_alternate_so_that_half_of_them_can_set_the_scale() -> None:
    blocks = blocks_of((32, 32)).reshape(32, 32)
    assert blocks[0, 0] == blocks[7, 7]
    parity = blocks[::8, ::8] % 2
    assert (parity[:, 1:] != parity[:, :-1]).all()
    assert (parity[1:] != parity[:-1]).all()


def test_what_the_views_do_not_tell_counts_as_the_prior() -> None:
    """One phase angle tells of neither b nor c; many phase angles tell of both."""
    endmembers = start_endmembers("hapke", 1, torch.zeros(1, dtype=torch.float64))
    samples, _ = made_up("hapke", endmembers, 300)
    suns = [unit((0.9 * np.sin(a), 0.9 * np.cos(a), 0.5)) for a in np.linspace(0, 2 * np.pi, 7)]
    zenith = unit((0.0, 0.0, 1.0))
    few = replace(samples, suns=suns[:1] * 7, views=[zenith] * 7)
    many = replace(
        samples,
        suns=[unit((x, 0.0, 1.0)) for x in (-2.0, -1.0, -0.3, 0.0, 0.3, 1.0, 2.0)],
        views=[unit((0.5, 0.0, 1.0))] * 7,
    )
    known = {}
    for name, own in (("few", few), ("many", many)):
        own = replace(
            own, seen=predict("hapke", own, AMPLITUDE["hapke"].raw(torch.full_like(own.seen[0], 0.4)), endmembers)
        )
        solution = invert("hapke", own, endmembers, rounds=4, independent=0.02)
        known[name] = known_share("hapke", solution)[0].tolist()
        assert -1 <= shape_correlation(solution) <= 1
    assert max(known["few"][:2]) < LEAST_KNOWN
    assert min(known["many"][:2]) > LEAST_KNOWN


def test_brightness_that_changes_with_the_angles_is_not_taken_for_heights(make_hill: Any) -> None:
    """Under Lambert's model nothing else explains it; before, such a fit could be a third worse than its prior."""
    scene = make_hill()
    fit(scene, FitOptions(brdf="lambert", resolution=2.0))
    truth = read_raster(scene.path(scene.products["truth_dsm"]))[0][0]
    prior = read_raster(scene.path(scene.products["prior_dsm"]))[0][0]
    fitted = load(scene.root / "fit/model.safetensors")[0]["height"].numpy()
    inner = slice(8, -8)  # the rim has few views
    errors = [float(np.abs(h - truth)[inner, inner].mean()) for h in (prior, fitted)]
    assert errors[1] < 1.05 * errors[0], errors
