"""On a CUDA device every field, loss and reflectance model answers as on the CPU, and fits end to end.

Skipped where there is no such device; `tests/field/test_placement.py` sees to it anywhere that nothing changes places.
"""

from collections.abc import Callable
from typing import Any

import pytest
import torch
from four_sides import CELLS, GRID, Z_RANGE, a_house

from sattools.camera.view_direction import ViewDirection
from sattools.compare import compare_dsm, read_reference
from sattools.export.options import ExportOptions
from sattools.export.stage import export
from sattools.field.mlp import MlpField
from sattools.fit.presets import PRESETS, resolve
from sattools.fit.rays.maps import read_maps
from sattools.fit.rays.precision import multiplied
from sattools.fit.rays.stage import STEPS, FieldSteps
from sattools.fit.rays.start import make_field, ray_set
from sattools.fit.rays.trainer import RayTrainer
from sattools.fit.stage import fit
from sattools.reflectance import hapke, rpv
from sattools.render import ParallelRays, Quadrature, render
from sattools.render.reference import render_planes
from sattools.scene import Scene
from sattools.scene.raster import read_raster

pytestmark = pytest.mark.skipif(not torch.cuda.is_available(), reason="no CUDA device")
CPU, CUDA = torch.device("cpu"), torch.device("cuda")
FIELDS = [*(name for name in PRESETS if name != "fast"), "neural", "voxel"]


def house(name: str, device: torch.device, **given: Any) -> RayTrainer:
    """A house of 10 m under noise, as a preset or field of that name sees it from four sides."""
    views, prior, base = a_house()
    if name in PRESETS:
        options = resolve(name, {"width": 32, **given})
    else:
        options = resolve("fast", {"field": name, "shadow": "geometric", **given})
    rays = ray_set(views, GRID, Z_RANGE, prior).to(device)
    with device:
        field = make_field(
            options, GRID, Z_RANGE, 2.0, 3, prior.to(device), base=None if name == "voxel" else base.to(device)
        )
        ones = torch.ones(len(views), 3)
        return RayTrainer(field, rays, options, ones, 0 * ones, STEPS.get(options.field, FieldSteps()))


def answers(trainer: RayTrainer, rest: bool) -> dict[str, torch.Tensor]:
    """Losses, and the gradients of all tensors that have one, on the CPU."""
    trainer.columns, trainer.at_rest = None, rest
    with trainer.device:
        chosen = torch.arange(0, len(trainer.rays.target), 5)
        loss, extra = trainer.losses(chosen, 6, 0.9, None)
        (loss + extra).backward()
    found = {"loss": loss, "extra": torch.as_tensor(extra)}
    found |= {n: t.grad for n, t in trainer.tensors.items() if t.grad is not None}
    return {name: tensor.detach().cpu() for name, tensor in found.items()}


def apart(one: torch.Tensor, other: torch.Tensor) -> float:
    """Largest difference, as a share of the largest value."""
    one, other = one.detach(), other.detach()
    return float((one - other).abs().max() / other.abs().max().clamp_min(1e-12))


@pytest.mark.parametrize("rest", [False, True])
@pytest.mark.parametrize("name", FIELDS)
def test_losses_and_gradients_are_those_of_the_cpu(name: str, rest: bool) -> None:
    """To single precision: samples that fall on the end of a ramp may fall on either side."""
    if rest and name in ("neural", "voxel"):
        pytest.skip("only networks rest")
    here, there = house(name, CPU), house(name, CUDA)
    noise = torch.Generator("cpu").manual_seed(5)
    with torch.no_grad():
        for tensor in here.tensors.values():
            tensor += 0.05 * torch.randn(tensor.shape, generator=noise)
    there.load(here.state())
    expected, found = answers(here, rest), answers(there, rest)
    assert found.keys() == expected.keys()
    assert len(found) > 4
    wrong = {n: apart(found[n], expected[n]) for n in found if apart(found[n], expected[n]) > 2e-3}
    assert not wrong


@pytest.mark.parametrize(("precision", "rounding"), [("tf32", 2**-11), ("bf16", 2**-9)])
@pytest.mark.parametrize("name", ["eonerf", "satnerf", "hapke-nerf"])
def test_gradients_of_rounded_products_are_those_of_float32_but_for_the_rounding(
    name: str, precision: str, rounding: float
) -> None:
    """Some twenty products, ten there and ten back, that round by that much each."""
    exact, rounded = house(name, CUDA), house(name, CUDA, precision=precision)
    noise = torch.Generator("cpu").manual_seed(5)
    with torch.no_grad():
        for tensor in exact.tensors.values():
            tensor += 0.05 * torch.randn(tensor.shape, generator=noise, device="cpu").to(CUDA)
    rounded.load(exact.state())
    expected = answers(exact, rest=False)
    with multiplied(rounded.field, rounded.options.precision):
        found = answers(rounded, rest=False)
    assert found.keys() == expected.keys()
    assert not torch.equal(found["field.trunk.1.weight"], expected["field.trunk.1.weight"])
    for layer in {name.rpartition(".")[0] for name in expected if name.startswith("field.")}:
        ours = [name for name in expected if name.rpartition(".")[0] == layer]
        wrong = sum(float((found[name] - expected[name]).square().sum()) for name in ours)
        assert wrong <= (20 * rounding) ** 2 * sum(float(expected[name].square().sum()) for name in ours), layer


@pytest.mark.parametrize("name", ["neural", "eonerf", "hapke-nerf"])
def test_what_is_read_off_is_that_of_the_cpu(name: str) -> None:
    maps = []
    for device in (CPU, CUDA):
        trainer = house(name, device)
        with device:
            maps.append(read_maps(trainer, GRID, Z_RANGE))
    assert apart(maps[1].height.cpu(), maps[0].height) < 1e-3
    assert apart(maps[1].albedo.cpu(), maps[0].albedo) < 1e-3
    assert maps[1].images.keys() == maps[0].images.keys()


def test_reflectance_models_are_those_of_the_cpu() -> None:
    """In double precision to its rounding, as formulas and compiled kernels differ in nothing else."""
    random = torch.Generator("cpu").manual_seed(1)
    vectors = torch.randn(3, 500, 3, generator=random, dtype=torch.float64)
    vectors[..., 2] = vectors[..., 2].abs() + 0.2
    n, s, v = vectors / vectors.norm(dim=-1, keepdim=True)
    w, b, c, theta = torch.rand(4, 500, generator=random, dtype=torch.float64) * 0.8 + 0.1
    there = [x.to(CUDA) for x in (n, s, v, w, b, c, theta)]
    assert apart(hapke(*there).cpu(), hapke(n, s, v, w, b, c, theta)) < 1e-9
    assert apart(rpv(*there).cpu(), rpv(n, s, v, w, b, c, theta)) < 1e-9


def test_a_surface_is_rendered_as_by_the_same_formulas_on_the_cpu() -> None:
    """How far the compiled kernels are from them is told by `tests/render/test_surface_renderer.py`."""
    random = torch.Generator("cpu").manual_seed(2)
    height, colour = 8 * torch.rand(CELLS, CELLS, generator=random), torch.rand(CELLS, CELLS, 3, generator=random)
    seen = []
    for renderer, device in ((render_planes, CPU), (render, CUDA)):
        h, c = (t.to(device).detach().requires_grad_() for t in (height, colour))
        outputs = renderer(h, c, ParallelRays(ViewDirection(0.3, -0.2), 2.0), Quadrature(0.5, 0.25, 12.0, -4.0), 1.0)
        torch.stack([x.square().sum() for x in outputs]).sum().backward()
        assert h.grad is not None
        assert c.grad is not None
        seen.append([x.detach().cpu() for x in (*outputs, h.grad, c.grad)])
    for found, expected in zip(seen[1], seen[0], strict=True):
        assert apart(found, expected) < 1e-4


def test_a_step_goes_on_from_what_another_has_saved() -> None:
    """Moments and their count, too: Adam's third step is another than its first."""
    one, other = house("eonerf", CUDA), house("eonerf", CUDA)
    with CUDA:
        for number in range(2):
            one.step(number)
        other.load(one.state())
        for trainer in (one, other):
            trainer.step(2)
    wrong = {n: apart(other.tensors[n], t) for n, t in one.tensors.items() if apart(other.tensors[n], t) > 1e-4}
    assert not wrong


@pytest.mark.parametrize(
    ("name", "precision"), [*((name, "float32") for name in FIELDS), ("eonerf", "bf16"), ("eonerf", "tf32")]
)
def test_recorded_steps_are_those_that_are_not(name: str, precision: str) -> None:
    """But for the order in which the device adds up, through what comes in late, and at rest."""
    given = {
        "steps": 24,
        "rays": 64,
        "precision": precision,
        **({"shadow": "geometric"} if name == "hapke-nerf" else {}),
    }
    one, other = house(name, CUDA, **given), house(name, CUDA, **given)
    assert one.recorded is not None
    assert other.recorded is not None
    other.recorded.possible = False
    losses = []
    with CUDA:
        for number in range(24):
            if number == 18 and isinstance(one.field, MlpField):
                for trainer in (one, other):
                    trainer.rest(number)
            losses.append((one.step(number), other.step(number)))
    assert one.recorded.possible
    assert len(one.recorded.recordings) > 1
    assert [found for found, _ in losses] == pytest.approx([expected for _, expected in losses], rel=2e-2, abs=1e-6)
    wrong = {n: apart(other.tensors[n], t) for n, t in one.tensors.items() if apart(other.tensors[n], t) > 2e-2}
    assert not wrong


@pytest.mark.parametrize(
    ("preset", "more"),
    [
        ("fast", {}),
        ("fast", {"field": "neural", "steps": 60}),
        ("eonerf", {"steps": 20}),
        ("eonerf", {"steps": 20, "precision": "bf16"}),
        ("eonerf", {"steps": 20, "precision": "tf32"}),
        ("satnerf", {"steps": 8}),
    ],
)
def test_a_scene_is_fitted_and_exported(make_town: Callable[[str], Scene], preset: str, more: dict[str, Any]) -> None:
    scene = make_town("TOWN")
    fit(scene, resolve(preset, {"device": "cuda", **more}))
    export(scene, ExportOptions())
    truth = read_reference(str(scene.path(scene.products["truth_dsm"])))
    errors = {}
    for product in ("prior_dsm", "dsm"):
        height, grid = read_raster(scene.path(scene.products[product]))
        errors[product] = float(compare_dsm(height[0], truth, grid).figures["mae"])
    assert errors["dsm"] < 1.05 * errors["prior_dsm"]
