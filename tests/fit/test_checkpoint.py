"""Model files: what is written is read back, and files of version 1 are read under the present names."""

import json
from pathlib import Path
from typing import Any

import pytest
import torch
from safetensors.torch import save_file

from sattools.errors import InputError
from sattools.fit import checkpoint
from sattools.fit.model import FittedModel
from sattools.fit.options import FitOptions
from sattools.fit.stage import fit
from sattools.fit.stored import StoredModel
from sattools.scene import Grid


def test_a_model_survives_its_file(tmp_path: Path) -> None:
    tensors = {"height": torch.arange(6.0).reshape(2, 3)}
    checkpoint.save(tmp_path / "m.safetensors", tensors, {"shadow": "none"})
    again, meta = checkpoint.load(tmp_path / "m.safetensors")
    assert meta == {"shadow": "none"}
    assert torch.equal(again["height"], tensors["height"])


def test_no_byte_of_a_model_can_change_unnoticed(tmp_path: Path) -> None:
    """Not of its header either, which names the checksum."""
    path = tmp_path / "m.safetensors"
    checkpoint.save(path, {"height": torch.arange(6.0).reshape(2, 3)}, {"shadow": "none"})
    whole = path.read_bytes()
    for place in range(len(whole)):
        data = bytearray(whole)
        data[place] ^= 1
        path.write_bytes(data)
        for read in (checkpoint.load, checkpoint.verify):
            with pytest.raises(InputError, match=r"m\.safetensors: found "):
                read(path)


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


def test_a_model_written_in_pieces_is_that_written_at_once(tmp_path: Path) -> None:
    tensors = {"height": torch.arange(12.0).reshape(3, 4), "gain": torch.tensor([[0.5], [2.0]])}
    checkpoint.save(tmp_path / "once.safetensors", tensors, {"shadow": "none"})

    def fill(put: checkpoint.Put) -> None:
        put("gain", 0, tensors["gain"].numpy())
        for row in (2, 0, 1):
            put("height", 4 * row, tensors["height"][row].numpy())

    shapes = {name: tuple(tensor.shape) for name, tensor in tensors.items()}
    checkpoint.save_in_pieces(tmp_path / "pieces.safetensors", shapes, {"shadow": "none"}, fill)
    again, meta = checkpoint.load(tmp_path / "pieces.safetensors")
    assert meta == {"shadow": "none"}
    assert {name: tensor.tolist() for name, tensor in again.items()} == {
        "height": [[0, 1, 2, 3], [4, 5, 6, 7], [8, 9, 10, 11]], "gain": [[0.5], [2]],
    }  # fmt: skip
    for name in ("once", "pieces"):
        checkpoint.verify(tmp_path / f"{name}.safetensors")


def test_a_damaged_model_is_found_without_holding_it(tmp_path: Path) -> None:
    path = tmp_path / "m.safetensors"
    checkpoint.save(path, {"height": torch.zeros(50, 50)}, {"shadow": "none"})
    content = bytearray(path.read_bytes())
    content[-7] ^= 1
    path.write_bytes(content)
    with pytest.raises(InputError, match=r"^[^:]*m\.safetensors: found other content than was written \(checksum\)"):
        checkpoint.verify(path)
    path.write_bytes(content[: len(content) // 2])
    with pytest.raises(InputError, match=r"m\.safetensors: found no sattools model \(truncated\)"):
        checkpoint.verify(path)


LATER = "; the version of sattools that wrote it, or a later one, reads it"


@pytest.mark.parametrize(
    ("description", "found"),
    [
        ({"needs": ["plain", "fog"]}, "a model that needs 'fog', expected no more than opened, plain"),
        ({"version": 3}, "a model of format 3, expected at most 2"),
    ],
)
def test_a_model_of_a_later_version_is_refused_and_not_half_read(
    tmp_path: Path, description: dict[str, Any], found: str
) -> None:
    path = tmp_path / "m.safetensors"
    checkpoint.save(path, {"height": torch.zeros(2, 3)}, description)
    for read in (checkpoint.load, checkpoint.verify, StoredModel.open):
        with pytest.raises(InputError) as error:
            read(path)
        assert str(error.value) == f"{path}: found {found}{LATER}"


@pytest.mark.parametrize(
    ("extra", "needs"), [({}, None), ({"field.plain": 1}, None), ({"plain": 1, "opened": 2}, ["opened", "plain"])]
)
def test_a_model_names_what_a_reader_has_to_know_and_nothing_else(
    tmp_path: Path, extra: dict[str, int], needs: list[str] | None
) -> None:
    """Materials of Lambert's law, and light from the ground around, were left out by versions that do not know them."""
    model = a_model(extra={name: torch.ones(size) for name, size in extra.items()})
    model.save(tmp_path / "m.safetensors")
    assert checkpoint.describe(tmp_path / "m.safetensors").get("needs") == needs
    again = FittedModel.load(tmp_path / "m.safetensors")
    assert {name: tensor.tolist() for name, tensor in again.extra.items()} == {n: [1.0] * k for n, k in extra.items()}


def a_model(**given: Any) -> FittedModel:
    """A level surface of 2 x 3 cells in one image."""
    grid = Grid("EPSG:32617", 500_000.0, 3_300_000.0, 1.0, 3, 2)
    return FittedModel(
        grid=grid, items=["A"], suns=[None], height=torch.zeros(2, 3), height_std=torch.zeros(2, 3),
        albedo=torch.ones(2, 3, 1), gain=torch.ones(1, 1), offset=torch.zeros(1, 1), ambient=torch.zeros(1, 1),
        pose=torch.zeros(1, 2), **given,
    )  # fmt: skip


def test_a_model_that_goes_away_while_it_is_read_is_named(make_town: Any) -> None:
    """A scene's folder that was moved while `export` ran ended it with an "internal error"."""
    scene = make_town()
    fit(scene, FitOptions(resolution=4.0, epochs=[1], prior_weight=0.0))
    path = scene.path(scene.products["model"])
    stored = StoredModel.open(path, in_memory=0)
    whole = slice(0, 2), slice(0, 2)
    assert stored.part(*whole).height.shape == (2, 2)
    scene.root.rename(scene.root.with_name("MOVED"))
    for read in (stored.colours, lambda: stored.part(*whole), lambda: stored.maps(*whole)):
        with pytest.raises(InputError) as error:
            read()
        assert str(error.value) == f"{path}: no such file any more, expected it there until the end"
