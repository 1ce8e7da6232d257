"""`fit --precision`: networks that are trained in bfloat16, and everything else as it is."""

import logging
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch
from click.testing import CliRunner
from four_sides import house_trainer

from sattools.cli import main
from sattools.errors import SceneError
from sattools.field.mlp import MlpField
from sattools.fit.checkpoint import load
from sattools.fit.combinations import step_bytes
from sattools.fit.options import FitOptions
from sattools.fit.presets import resolve
from sattools.fit.rays import job as rays_job
from sattools.fit.rays.precision import check_precision, multiplied, warn_of_precision
from sattools.fit.rays.trainer import RayTrainer
from sattools.fit.stage import fit
from sattools.scene import Scene

CPU = torch.device("cpu")
TINY: dict[str, Any] = {"width": 16, "rays": 64, "steps": 24, "resolution": 2.0, "precision": "bf16"}


def trainer(preset: str, **given: Any) -> RayTrainer:
    return house_trainer(resolve(preset, {"width": 32, "steps": 40, "rays": 64, **given}))


def gradients(of: RayTrainer) -> dict[str, torch.Tensor]:
    of.adam.zero_grad(set_to_none=True)
    with of.multiplied():
        loss, extra = of.losses(torch.arange(0, 500, 3), 6, 0.9, None)
        (loss + extra).backward()
    return {name: tensor.grad.clone() for name, tensor in of.tensors.items() if tensor.grad is not None}


@pytest.mark.parametrize("preset", ["eonerf", "satnerf", "hapke-nerf"])
def test_gradients_are_those_of_float32_but_for_what_is_rounded(preset: str) -> None:
    """Some twenty products, ten there and ten back, that round to 2^-9 each: 20 / 512 = 0.04 of a gradient."""
    exact, mixed = trainer(preset), trainer(preset, precision="bf16")
    for number in range(4):  # until all of the network has a gradient: its last layers begin at zero
        exact.step(number)
    mixed.load(exact.state())
    expected, found = gradients(exact), gradients(mixed)
    assert expected.keys() == found.keys()
    # what lies behind the first layer is rounded, and so is its gradient
    assert not torch.equal(found["field.trunk.1.weight"], expected["field.trunk.1.weight"])
    layers = {name.rpartition(".")[0] for name in expected}
    for layer in layers:  # of a bias alone, which sums what cancels, little may be left
        ours = [name for name in expected if name.rpartition(".")[0] == layer]
        apart = sum(float((found[name] - expected[name]).square().sum()) for name in ours)
        assert apart <= 0.04**2 * sum(float(expected[name].square().sum()) for name in ours), layer


def test_between_steps_a_network_answers_in_float32() -> None:
    """What is judged, read off, exported and shown is what the stored weights say."""
    one = trainer("eonerf", precision="bf16")
    asked: list[torch.dtype] = []
    losses = one.losses

    def watched(*given: Any) -> Any:
        asked.append(one.field.hidden)
        return losses(*given)

    one.losses = watched
    one.step(0)
    assert asked == [torch.bfloat16]
    assert isinstance(one.field, MlpField)
    assert one.field.hidden == torch.float32
    assert all(tensor.dtype == torch.float32 for tensor in one.tensors.values())
    assert all(value.dtype == torch.float32 for state in one.adam.state.values() for value in state.values())


def products_on_a_gpu() -> str:
    """How PyTorch would multiply float32 there: ieee or tf32."""
    matmul = torch.backends.cuda.matmul
    if hasattr(matmul, "fp32_precision"):
        return matmul.fp32_precision
    return "tf32" if matmul.allow_tf32 else "ieee"


@pytest.mark.parametrize("before", ["highest", "high"])
def test_nothing_is_left_behind_by_a_step_that_fails(before: str) -> None:
    """Whatever the calling program had asked PyTorch for."""
    field, kept = trainer("eonerf").field, torch.get_float32_matmul_precision()
    assert isinstance(field, MlpField)
    inside: list[str] = []

    def fail(precision: Any) -> None:
        with multiplied(field, precision):
            inside.append(f"{field.hidden} {products_on_a_gpu()}")
            raise KeyboardInterrupt

    try:
        torch.set_float32_matmul_precision(before)
        for precision in ("float32", "tf32", "bf16"):
            with pytest.raises(KeyboardInterrupt):
                fail(precision)
            assert torch.get_float32_matmul_precision() == before
            assert field.hidden == torch.float32
    finally:
        torch.set_float32_matmul_precision(kept)
    plain = "tf32" if before == "high" else "ieee"
    assert inside == [f"torch.float32 {plain}", "torch.float32 tf32", f"torch.bfloat16 {plain}"]


def interrupted(scene: Any, options: FitOptions, monkeypatch: pytest.MonkeyPatch) -> None:
    """A fit that ends after its thirteenth step, past the middle of the training."""
    monkeypatch.setattr(rays_job, "SAVE_EVERY_S", 0.0)
    monkeypatch.setattr(rays_job, "TELL_EVERY_S", 0.0)

    def stop(fraction: float, message: str) -> None:
        if message.startswith("step 14/"):
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        fit(scene, options, stop)


def test_resumed_with_the_same_precision_it_ends_the_same_and_with_another_it_is_refused(
    make_matched_hamlet: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    whole, cut, plain = (make_matched_hamlet(name) for name in ("WHOLE", "CUT", "PLAIN"))
    options = resolve("eonerf", TINY)
    fit(whole, options)
    interrupted(cut, options, monkeypatch)
    with pytest.raises(SceneError, match=r"other options \(--precision 'bf16'\), expected --precision 'float32'"):
        fit(cut, replace(options, resume=True, precision="float32"))
    fit(cut, replace(options, resume=True))
    one, other = (load(scene.path("fit/model.safetensors"))[0] for scene in (whole, cut))
    assert one.keys() == other.keys()
    assert all(torch.equal(one[name], other[name]) for name in one)
    fit(plain, replace(options, precision="float32"))
    exact = load(plain.path("fit/model.safetensors"))[0]
    assert not torch.equal(exact["field.trunk.2.weight"], one["field.trunk.2.weight"])


def test_it_is_recorded(make_matched_hamlet: Any) -> None:
    scene = make_matched_hamlet()
    Path(scene.root / "scene.json").write_text(scene.to_json())
    flags = ["fit", "--preset", "eonerf", "--precision", "bf16", "--width", "16", "--rays", "32", "--steps", "2"]
    printed = CliRunner().invoke(main, [*flags, "--print-config"]).output
    assert 'precision = "bf16"' in printed
    done = CliRunner().invoke(main, [*flags, "--resolution", "4", str(scene.root / "scene.json")])
    assert done.exit_code == 0, done.stderr
    (entry,) = (one for one in Scene.from_json(done.stdout).history if one["command"] == "fit")
    assert entry["options"]["precision"] == "bf16"


def test_tf32_on_a_cpu_is_refused() -> None:
    with pytest.raises(SceneError, match=r"--precision tf32: found a training on the CPU, .* expected a CUDA device"):
        check_precision(resolve("eonerf", {"precision": "tf32"}), CPU)
    check_precision(resolve("fast", {"field": "neural", "precision": "tf32"}), CPU)  # told that it does nothing


@pytest.mark.parametrize(
    ("can", "lines"),
    [
        ({"avx512_bf16": True, "amx_bf16": True}, 0),
        ({"avx512_bf16": True, "amx_bf16": False}, 1),
        ({"sve": True}, 0),  # not an x86: nothing is known
    ],
)
def test_that_a_cpu_without_amx_is_slower_is_told(
    can: dict[str, bool], lines: int, caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(torch.cpu, "get_capabilities", lambda: can, raising=False)
    with caplog.at_level(logging.WARNING):
        warn_of_precision(resolve("eonerf", {"precision": "bf16"}), CPU)
        warn_of_precision(resolve("eonerf", {}), CPU)
    assert [r.getMessage() for r in caplog.records] == [
        "--precision bf16: found a CPU without AMX for it, where it takes longer than float32"
    ] * lines


def test_a_step_holds_half_of_the_bytes() -> None:
    exact, mixed = (step_bytes(resolve("eonerf", {"precision": each})) for each in ("float32", "bf16"))
    assert exact == 2 * mixed == 4 * 8 * 256 * 256 * 24  # bytes, layers, width, rays, samples
