"""Networks that start from the prior: what they begin with, what they show, and that their time is honest."""

import dataclasses
import functools
import itertools
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import rasterio
import torch
from towns import copied

from sattools.compare import compare_dsm, read_reference
from sattools.errors import SceneError
from sattools.export.options import ExportOptions
from sattools.export.stage import export
from sattools.field.mlp import MlpField
from sattools.field.networks import NETWORKS
from sattools.field.protocol import Box
from sattools.field.surface_base import KnownLight, SurfaceBase, before_sigmoid, before_softplus
from sattools.fit.depth_prior import DepthPrior, depth_std_m
from sattools.fit.materials.scene import ReflectiveScene
from sattools.fit.model import FittedModel
from sattools.fit.options import FitOptions
from sattools.fit.presets import PRESETS, resolve
from sattools.fit.rays.losses import BETA_MIN
from sattools.fit.rays.start import restored_field
from sattools.fit.stage import check_start, fit
from sattools.fit.trace import Trace
from sattools.prior.files import read_prior
from sattools.render import sun_visibility
from sattools.scene import Scene

PAPERS = [name for name in PRESETS if name != "fast"]
TINY = {"width": 16, "rays": 64, "steps": 12, "resolution": 2.0}
STEPS = {"eonerf": 40}  # so many that not every step has a row of its own in the trace
BOX = Box((0.0, -8.0, 0.0), (8.0, 0.0, 20.0))


def tiny(preset: str) -> FitOptions:
    return resolve(preset, {**TINY, "resolution": 1.0, "steps": STEPS.get(preset, TINY["steps"])})


@pytest.fixture(scope="module")
def trained(matched_hamlet_source: Scene, tmp_path_factory: pytest.TempPathFactory) -> Callable[[str], Any]:
    """Trains `tiny` networks of the small scene, each once: the scene and what was found; tests must leave it alone."""

    @functools.cache
    def train(preset: str) -> tuple[Scene, dict[str, Any]]:
        scene = copied(matched_hamlet_source, tmp_path_factory.mktemp(preset) / "HAMLET")
        return scene, fit(scene, tiny(preset))

    return train


def slope_base(softness: float = 0.5) -> SurfaceBase:
    """Heights 5, 6, ... 12 m from west to east, red in the north and blue in the south."""
    height = torch.arange(5.0, 13.0).expand(8, 8).contiguous()
    colour = torch.tensor([0.8, 0.3, 0.1]).expand(8, 8, 3).clone()
    colour[4:] = torch.tensor([0.1, 0.3, 0.8])
    return SurfaceBase(BOX, height, colour, softness)


def test_the_activations_are_undone() -> None:
    density = torch.tensor([1e-3, 0.5, 20.0])
    assert torch.allclose(torch.nn.functional.softplus(before_softplus(density)), density, rtol=1e-4)
    value = torch.tensor([0.1, 0.4, 0.7])
    assert torch.allclose(0.8 * torch.sigmoid(before_sigmoid(value, 0.0, 0.8)), value, rtol=1e-5)


@pytest.mark.parametrize("name", list(NETWORKS))
def test_an_untrained_network_is_the_surface_it_starts_from(name: Any) -> None:
    base = slope_base()
    field = MlpField(NETWORKS[name], BOX, 3, width=16, base=base)
    # the middles of cells (row 1, column 2) and (row 6, column 5), of heights 7 and 10 m
    points = torch.tensor([[2.5, -1.5, 7.0], [5.5, -6.5, 10.0], [5.5, -6.5, 18.0], [5.5, -6.5, 2.0]])
    sigma, features = field.density(points)
    # sigmoid(0) / s on the surface, nothing far above it, 1 / s inside
    assert sigma.tolist() == pytest.approx([1.0, 1.0, 0.0, 2.0], abs=2e-5)
    albedo = field.look(features, None, None)["albedo"]
    assert albedo[0].tolist() == pytest.approx(
        [min(0.8, 0.98 * NETWORKS[name].heads["albedo"].high), 0.3, 0.1], abs=1e-4
    )
    assert albedo[1].tolist()[0] == pytest.approx(0.1, abs=1e-4)


def test_an_amplitude_above_the_papers_range_is_kept() -> None:
    """Images of unknown scale can make w 0.95; a range to 0.8 began 3 dB darker."""
    base = slope_base()
    base.colour[:] = 0.95
    base = dataclasses.replace(base, shape=torch.tensor([0.2, 0.3, 10.0]).expand(8, 8, 3).contiguous())
    field = MlpField(NETWORKS["hapke"], BOX, 3, width=16, base=base)
    _, features = field.density(torch.tensor([[2.5, -1.5, 7.0]]))
    assert field.look(features, None, None)["albedo"][0].tolist() == pytest.approx([0.95] * 3, abs=1e-3)


SUNS = torch.nn.functional.normalize(torch.tensor([[0.0, 0.6, 0.8], [0.6, 0.0, 0.8]]), dim=1)


def lit_base() -> SurfaceBase:
    """The slope, of which the first sun lights the west and the second nothing; shade is bluer under the second."""
    visible = torch.zeros(2, 8, 8)
    visible[0, :, :4] = 1.0
    return dataclasses.replace(
        slope_base(), light=KnownLight(SUNS, torch.tensor([[0.05, 0.08, 0.1], [0.1, 0.12, 0.16]]), visible)
    )


@pytest.mark.parametrize(("name", "shade"), [("satnerf", "sky"), ("eonerf-learned-shadow", "ambient")])
def test_an_untrained_network_is_lit_as_the_surface_it_starts_from(name: Any, shade: str) -> None:
    base = lit_base()
    field = MlpField(NETWORKS[name], BOX, 3, width=16, base=base)
    points = torch.tensor([[2.5, -1.5, 7.0], [5.5, -6.5, 10.0]])
    _, features = field.density(points)
    for sun, seen, colour in ((SUNS[0], [0.98, 0.02], [0.05, 0.08, 0.1]), (SUNS[1], [0.02, 0.02], [0.1, 0.12, 0.16])):
        answers = field.look(features, sun.expand(2, 3), torch.zeros(2, 4))
        assert answers["sun"][:, 0].tolist() == pytest.approx(seen, abs=1e-3)
        assert answers[shade][0].tolist() == pytest.approx(colour, abs=1e-3)
        if "tau" in answers:  # nothing moves until it is seen to
            assert bool((answers["tau"] > 0.97).all())
    # between two suns both count, an unknown one stays unknown
    between = torch.nn.functional.normalize(SUNS.sum(dim=0), dim=0).expand(2, 3)
    assert field.look(features, between, torch.zeros(2, 4))["sun"][0].tolist() == pytest.approx([0.5], abs=1e-3)
    unknown = torch.full((2, 3), torch.nan)
    assert torch.isnan(field.look(features, unknown, torch.zeros(2, 4))["sun"]).all()


def test_light_is_kept_with_the_surface() -> None:
    base = lit_base()
    again = SurfaceBase.restored(base.tensors(), BOX)
    assert again.light is not None
    assert base.light is not None
    for name in ("suns", "ambient", "visible"):
        assert torch.equal(getattr(again.light, name), getattr(base.light, name)), name
    assert SurfaceBase.restored(slope_base().tensors(), BOX).light is None


def test_learned_shadows_of_a_network_begin_as_the_surface_casts_them(
    trained: Callable[[str], Any], make_matched_hamlet: Callable[..., Scene]
) -> None:
    """And are no better than noise where they begin as the papers have it."""
    agreement = {}
    lit = make_matched_hamlet("LIT")
    fit(lit, dataclasses.replace(tiny("satnerf"), shadow_start="lit"))
    for begun, scene in (("geometric", trained("satnerf")[0]), ("lit", lit)):
        model = FittedModel.load(scene.path("fit/model.safetensors"))
        assert model.s_net is not None
        cast = torch.stack([sun_visibility(model.height, model.grid.cell_size, sun) for sun in model.suns if sun])
        found = model.s_net[[k for k, sun in enumerate(model.suns) if sun]]
        agreement[begun] = float(np.corrcoef(cast.ravel(), found.ravel())[0, 1])
    assert agreement["geometric"] > 0.8
    assert agreement["lit"] < 0.5


def test_all_of_a_network_learns_although_its_last_layers_begin_at_zero() -> None:
    field = MlpField(NETWORKS["eonerf"], BOX, 3, width=16, base=slope_base())
    points = torch.rand(64, 3) * torch.tensor([8.0, -8.0, 20.0])
    tensors = field.named_tensors()
    adam = torch.optim.SGD(tensors.values(), lr=0.1)
    before = {name: t.detach().clone() for name, t in tensors.items()}
    for _ in range(2):
        adam.zero_grad()
        sigma, features = field.density(points)
        (sigma.sum() + field.look(features, None, None)["albedo"].sum()).backward()
        adam.step()
    for name in ("trunk.0.weight", "sigma.weight", "albedo.0.weight", "albedo.1.weight"):
        assert not torch.equal(before[name], tensors[name]), name


def test_the_surest_heights_are_searched_closest() -> None:
    std = depth_std_m(torch.tensor([1.0, 0.5, 0.0]))
    assert std.tolist() == pytest.approx([0.5, 1.375, 4.0])


@pytest.mark.parametrize("preset", PAPERS)
def test_every_paper_begins_at_the_priors_error_and_exports_its_own_maps(
    trained: Callable[[str], Any], tmp_path: Path, preset: str
) -> None:
    source, found = trained(preset)
    scene = copied(source, tmp_path / "HAMLET")
    assert found["fit"]["epochs"] == (20 if preset == "eonerf" else 12)  # rows of the trace
    truth = read_reference(str(scene.path(scene.products["truth_dsm"])))
    model = FittedModel.load(scene.path("fit/model.safetensors"))
    assert (model.field, model.network) == ("mlp", tiny(preset).network)
    low, high = scene.require_height_range()
    assert low <= float(model.height.min()) <= float(model.height.max()) <= high
    for name in ("height", "height_std", "albedo", "gain"):
        assert torch.isfinite(getattr(model, name)).all(), name
    prior = DepthPrior.from_arrays(*read_prior(scene)).on(model.grid)
    error, start = (
        compare_dsm(height.numpy(), truth, model.grid).figures["mae"] for height in (model.height, prior.height)
    )
    # few steps of a tiny network change next to nothing: what is left is how a volume is read off
    assert error < start + 0.05
    item = scene.items[0].id
    export(scene, ExportOptions(view=[item], sun=(180.0, 45.0), undetermined="prior"))
    with rasterio.open(scene.path(scene.items[0].assets["rendered"].href)) as shown:
        picture = shown.read()
    with rasterio.open(scene.path(scene.items[0].assets["image"].href)) as image:
        pixels = image.read().astype(np.float32) / np.iinfo(image.dtypes[0]).max
    known = np.isfinite(picture).all(axis=0)
    assert known.mean() > 0.2  # the image shows more ground than the model has, the more so of a small area
    correlation = np.corrcoef(picture[:, known].ravel(), pixels[:, known].ravel())[0, 1]
    # without shadows, or before it has learned them, a network has one colour for a place lit in one image and shaded
    # in another
    assert correlation > (0.4 if resolve(preset, {}).shadow == "geometric" else 0.2)
    assert scene.path(scene.products["relit"]).is_file()
    expected = {
        "hapke-nerf": {"w", "b", "c", "theta", "w_std", "c_std", "identifiable", "normal", "reflectance"},
        "rpv-nerf": {"rho0", "k", "asymmetry", "rhoc", "asymmetry_std", "identifiable", "normal", "reflectance"},
    }.get(preset, set())
    assert expected <= set(scene.products)
    for name in expected:
        with rasterio.open(scene.path(scene.products[name])) as data:
            values = data.read(masked=True)
        assert values.count() > 0.5 * values.size
        assert np.isfinite(values.compressed()).all(), name
    assets = {name for item in scene.items for name in item.assets}
    assert ("s_net" in assets) == (preset in ("satnerf", "eonerf-learned-shadow"))
    assert ("tau" in assets) == (preset == "eonerf")
    assert ("beta" in assets) == (preset in ("eonerf", "satnerf"))
    if "beta" in assets:
        with rasterio.open(scene.path(scene.items[0].assets["beta"].href)) as data:
            assert float(data.read(masked=True).min()) >= BETA_MIN - 1e-6
    with rasterio.open(scene.path(scene.items[0].assets["rendered_height"].href)) as data:
        seen = data.read(1)
    assert np.array_equal(np.isfinite(seen), known)
    assert low - 1 <= np.nanmin(seen) <= np.nanmax(seen) <= high + 1


def test_a_model_gives_its_field_back(trained: Callable[[str], Any]) -> None:
    scene, _ = trained("eonerf")
    model = FittedModel.load(scene.path("fit/model.safetensors"))
    field = restored_field(model)
    for name, tensor in field.named_tensors().items():
        assert torch.equal(tensor, model.extra[f"field.{name}"])
    x, y = 20.0, -20.0  # on level ground, far from the wall that stands at 10 m
    ground = float(model.height[20, 20])
    sigma, _ = field.density(torch.tensor([[x, y, ground + 6.0], [x, y, ground - 6.0]]))
    above, below = sigma.tolist()
    assert above < 0.1 < below


def test_with_a_budget_the_reflectance_model_comes_in_after_its_share_of_what_is_really_run(
    make_matched_hamlet: Any, monkeypatch: Any
) -> None:
    """Of 100,000 steps the budget leaves some fifty: a fifth of those is Lambertian, not a fifth of the 100,000."""
    scene = make_matched_hamlet()
    seconds = itertools.count()
    monkeypatch.setattr(Trace, "seconds", lambda self: float(next(seconds)))
    found = fit(scene, resolve("hapke-nerf", {**TINY, "start": "prior", "steps": 100_000, "budget": 150.0}))
    assert "stopped by the budget of 150 s" in " ".join(found["notes"])
    trained = FittedModel.load(scene.path("fit/model.safetensors"))
    untouched = MlpField(NETWORKS["hapke"], BOX, 3, width=16, seed=0)
    for head in ("b", "c", "theta"):
        name = f"{head}.1.weight"
        assert not torch.equal(trained.extra[f"field.{name}"], untouched.named_tensors()[name].detach()), head


def test_images_of_one_scale_keep_it(make_hamlet: Any) -> None:
    """Gains learned for calibrated images would take their calibration away."""
    scene = make_hamlet()
    for item in scene.items:
        item.properties["sattools:radiance"] = "toa_reflectance"
    fit(scene, resolve("eonerf", TINY))
    model = FittedModel.load(scene.path("fit/model.safetensors"))
    assert torch.equal(model.gain, torch.ones_like(model.gain))
    assert torch.equal(model.offset, torch.zeros_like(model.offset))
    assert model.radiance == "toa_reflectance"


ALIKE = {"spsnerf", "rpv-nerf"}  # their checkpoints hold nothing that those of hapke-nerf do not


@pytest.mark.parametrize(
    "preset", [pytest.param(name, marks=[pytest.mark.slow] if name in ALIKE else []) for name in PAPERS]
)
def test_an_interrupted_network_goes_on_bit_for_bit_from_any_step(
    trained: Callable[[str], Any], make_matched_hamlet: Callable[..., Scene], monkeypatch: Any, preset: str
) -> None:
    from sattools.fit.rays import job as rays_job

    monkeypatch.setattr(rays_job, "SAVE_EVERY_S", 0.0)
    monkeypatch.setattr(rays_job, "TELL_EVERY_S", 0.0)
    options, broken = tiny(preset), make_matched_hamlet("BROKEN")
    whole, uninterrupted = trained(preset)
    half = options.steps // 2
    # told before it is kept: the step before it is, with eonerf one between two rows of the trace
    last = 24 if preset == "eonerf" else 9

    def stop(fraction: float, message: str) -> None:
        if message.startswith(f"step {last}/"):
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        fit(broken, options, stop)
    assert not broken.path("fit/model.safetensors").exists()
    with pytest.raises(SceneError, match=r"found a checkpoint of other options \(--seed 0\), expected --seed 1"):
        check_start(broken, dataclasses.replace(options, resume=True, seed=1))
    resumed = fit(broken, dataclasses.replace(options, resume=True))
    assert uninterrupted["notes"][-1].endswith(f"; its colours alone from step {half} on")
    assert resumed["notes"][-1] == f"mlp: its colours alone were trained from step {half} on"
    one, other = (FittedModel.load(s.path("fit/model.safetensors")) for s in (whole, broken))
    assert torch.equal(one.height, other.height)
    assert all(torch.equal(one.extra[name], other.extra[name]) for name in one.extra)
    losses = [s.path("fit/trace.csv").read_text().splitlines() for s in (whole, broken)]
    assert [row.split(",")[1:] for row in losses[0]] == [row.split(",")[1:] for row in losses[1]]


def test_at_every_sample_the_reflectance_model_sees_the_parameters_there(make_matched_hamlet: Any) -> None:
    """It is not that of the mean parameters, and not far from it."""
    losses = {}
    for where in ("ray", "sample"):
        scene = make_matched_hamlet(where)
        fit(scene, resolve("hapke-nerf", {**TINY, "steps": 3, "pretrain": 0.0, "brdf_at": where}))
        model = FittedModel.load(scene.path("fit/model.safetensors"))
        assert ("brdf_at_sample" in model.extra) == (where == "sample")
        trace = scene.path("fit/trace.csv").read_text().splitlines()
        losses[where] = float(trace[-1].split(",")[trace[0].split(",").index("loss")])
    assert losses["sample"] != losses["ray"]
    assert losses["sample"] == pytest.approx(losses["ray"], rel=0.3)


def test_a_network_begins_as_the_surface_that_the_fit_makes(make_matched_hamlet: Any) -> None:
    first, network = make_matched_hamlet("FIRST"), make_matched_hamlet("NETWORK")
    fit(first, FitOptions(pose=False))
    fit(network, resolve("eonerf", {**TINY, "resolution": None, "steps": 1, "rate": 0.0}))
    one, other = (FittedModel.load(s.path("fit/model.safetensors")) for s in (first, network))
    assert one.grid == other.grid
    assert (one.height - other.height).abs().median() < 0.02
    # the first image's relation stays, the others and the light in shade begin with the surface's
    assert torch.allclose(one.gain, other.gain, atol=0.01)
    assert torch.allclose(one.ambient, other.ambient, atol=0.01)


def test_a_network_begins_with_the_reflectance_that_the_fit_finds(make_matched_hamlet: Any) -> None:
    first, network = make_matched_hamlet("FIRST"), make_matched_hamlet("NETWORK")
    fit(first, FitOptions(pose=False, brdf="hapke", resolution=1.0))
    fit(network, resolve("hapke-nerf", {**TINY, "resolution": 1.0, "steps": 1, "rate": 0.0}))
    one, other = (FittedModel.load(s.path("fit/model.safetensors")) for s in (first, network))
    scene = one.surface()
    assert isinstance(scene, ReflectiveScene)
    amplitude, (b, c, theta) = scene.values()
    assert one.grid == other.grid
    for name, fitted, tolerance in (("w", amplitude, 0.02), ("b", b, 0.02), ("c", c, 0.02), ("theta", theta, 1.0)):
        assert (other.extra[f"map.{name}"] - fitted).abs().median() < tolerance, name
        assert torch.equal(other.extra[f"{name}_std"], one.extra[f"{name}_std"])
    # as of a surface, the albedo is the reflectance of level ground, a quarter of w or less
    assert (other.albedo - one.albedo).abs().median() < 0.005
    assert other.albedo.median() < 0.5 * amplitude.median()
    assert torch.equal(other.extra["identifiable"], one.extra["identifiable"])
    # and with its normals, so that the same light makes the same image
    assert torch.allclose(other.extra["normal"], scene.normals(), atol=1e-4)
