"""Model files: what is written is read back, and files of version 1 are read under the present names."""

import json
from pathlib import Path

import torch
from safetensors.torch import save_file

from sattools.fit import checkpoint


def test_a_model_survives_its_file(tmp_path: Path) -> None:
    tensors = {"height": torch.arange(6.0).reshape(2, 3)}
    checkpoint.save(tmp_path / "m.safetensors", tensors, {"shadow": "none"})
    again, meta = checkpoint.load(tmp_path / "m.safetensors")
    assert meta == {"shadow": "none"}
    assert torch.equal(again["height"], tensors["height"])


def test_a_file_of_version_1_is_read_under_the_present_names(tmp_path: Path) -> None:
    names = ["amount", "members", "shares", "lines", "height", "adam.amount.exp_avg", "light.features", "field.members"]
    save_file(
        {name: torch.full((2,), float(k)) for k, name in enumerate(names)},
        tmp_path / "old.safetensors",
        metadata={"sattools": json.dumps({"settled": {"shadow": "none"}})},
    )
    tensors, meta = checkpoint.load(tmp_path / "old.safetensors")
    assert {name: float(tensor[0]) for name, tensor in tensors.items()} == {
        "amplitude": 0, "endmembers": 1, "abundances": 2, "view_vectors": 3, "height": 4, "adam.amplitude.exp_avg": 5,
        "illumination.features": 6, "field.members": 7,
    }  # fmt: skip
    assert meta == {"illumination_options": {"shadow": "none"}}
