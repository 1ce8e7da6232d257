"""A fit that was interrupted at any moment ends as one that was not, bit for bit."""

import json
import random
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import pytest
import torch

from sattools.errors import InputError, SceneError
from sattools.fit.checkpoint import load, save
from sattools.fit.options import FitOptions
from sattools.fit.stage import fit
from sattools.scene import Scene

SHORT = FitOptions(resolution=2.0, coarsest=4.0, epochs=[10, 9], prior_weight=0.0)
FLAGS = ["--resolution", "2", "--coarsest", "4", "--epochs", "20", "--epochs", "20", "--prior-weight", "0"]


class Interrupted(Exception):
    """Stands for whatever ends a process."""


def model(scene: Scene) -> dict[str, torch.Tensor]:
    return load(scene.root / "fit/model.safetensors")[0]


def interrupt_after(calls: int):
    def progress(fraction: float, message: str) -> None:
        nonlocal calls
        calls -= 1
        if calls < 0:
            raise Interrupted

    return progress


def assert_same(a: dict[str, torch.Tensor], b: dict[str, torch.Tensor]) -> None:
    assert a.keys() == b.keys()
    for name in a:
        assert torch.equal(a[name], b[name]), name


@pytest.fixture
def whole(make_town):
    scene = make_town("TOWN")
    fit(scene, SHORT)
    return model(scene)


def test_the_same_seed_gives_the_same_model_and_another_seed_does_not(whole, make_town):
    again, other = make_town("AGAIN"), make_town("OTHER")
    fit(again, SHORT)
    fit(other, replace(SHORT, seed=1))
    assert_same(model(again), whole)
    assert not torch.equal(model(other)["height"], whole["height"])


def test_interrupted_anywhere_and_resumed(whole, make_town):
    """In the first stage before and after a checkpoint, between the stages, in the second, and twice in a row."""
    for number, calls in enumerate([(2,), (5,), (10,), (16,), (6, 3, 8)]):
        scene = make_town(f"CUT{number}")
        for count in calls:
            with pytest.raises(Interrupted):
                fit(scene, replace(SHORT, resume=True), interrupt_after(count))
        fit(scene, replace(SHORT, resume=True))
        assert_same(model(scene), whole)
        assert not (scene.root / "fit/checkpoint.safetensors").exists()
        rows = (scene.root / "fit/trace.csv").read_text().splitlines()
        assert len(rows) == 1 + 10 + 9


def test_killed_at_random_moments_and_resumed(make_town):
    reference, scene = make_town("WHOLE"), make_town("KILLED")
    command = [sys.executable, "-m", "sattools", "--threads", "1", "--progress", "json", "fit", *FLAGS]
    done = subprocess.run([*command, str(reference.root / "scene.json")], capture_output=True, text=True, check=True)
    records = len(done.stderr.splitlines())
    rng = random.Random(0)
    for _ in range(2):
        process = subprocess.Popen(
            [*command, "--resume", str(scene.root / "scene.json")],
            stderr=subprocess.PIPE,
            stdout=subprocess.DEVNULL,
            text=True,
        )
        assert process.stderr is not None
        for _ in range(rng.randrange(3, records // 2)):
            process.stderr.readline()
        process.kill()
        process.stderr.close()
        assert process.wait() in (-9, 0)  # 0: a machine so busy that the fit was done first
    again = subprocess.run(
        [*command, "--resume", str(scene.root / "scene.json")], capture_output=True, text=True, check=True
    )
    assert_same(model(scene), model(reference))
    assert json.loads(again.stdout)["sattools"]["history"][-1]["command"] == "fit"


def test_resuming_with_other_options_is_refused(make_town):
    scene = make_town()
    with pytest.raises(Interrupted):
        fit(scene, SHORT, interrupt_after(6))
    with pytest.raises(SceneError, match="found a checkpoint of other options, images or cameras"):
        fit(scene, replace(SHORT, resume=True, seed=3))


def test_a_damaged_checkpoint_is_named(make_town):
    scene = make_town()
    with pytest.raises(Interrupted):
        fit(scene, SHORT, interrupt_after(6))
    path = scene.root / "fit/checkpoint.safetensors"
    path.write_bytes(path.read_bytes()[:100])
    with pytest.raises(InputError, match=r"checkpoint\.safetensors: found no sattools model"):
        fit(scene, replace(SHORT, resume=True))


def test_a_model_file_survives_a_round_trip_and_others_are_refused(tmp_path: Path):
    tensors = {"a": torch.arange(6.0).reshape(2, 3), "step": torch.tensor(3)}
    save(tmp_path / "m", tensors, {"grid": {"left": 0.1}})
    found, meta = load(tmp_path / "m")
    assert_same(found, tensors)
    assert meta == {"grid": {"left": 0.1}}
    with pytest.raises(InputError, match="no such file"):
        load(tmp_path / "none")
    (tmp_path / "text").write_text("text")
    with pytest.raises(InputError, match="found no sattools model"):
        load(tmp_path / "text")
