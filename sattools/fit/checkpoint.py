"""Files of fitted scenes and of interrupted fits (safetensors with a JSON description, no pickle)."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from torch import Tensor

from sattools.errors import InputError
from sattools.scene.files import write_bytes

# one key, with the checksum inside: safetensors writes several in any order, and the same fit gives the same file
KEY, CHECKSUM, VERSION = "sattools", "sha256", "version"
FORMAT_VERSION = 2
# what tensors and members of the description were called in version 1, which had no number
_FORMERLY = {
    "amount": "amplitude", "members": "endmembers", "shares": "abundances", "lines": "view_vectors",
    "light": "illumination", "settled": "illumination_options",
}  # fmt: skip


def save(path: Path, tensors: Mapping[str, Tensor], description: Mapping[str, Any]) -> None:
    """Write tensors of any unit and a JSON description into one file, with a checksum of both: bytes in, bytes out.

    Args:
        path: file to write.
        tensors: by name.
        description: plain JSON types.

    Raises:
        SattoolsError: the file cannot be written.
    """
    from safetensors.torch import save as to_bytes

    tensors = {name: tensor.detach().cpu().contiguous() for name, tensor in tensors.items()}
    plain = json.loads(json.dumps({VERSION: FORMAT_VERSION, **description}))
    text = json.dumps({**plain, CHECKSUM: _checksum(tensors, plain)})
    write_bytes(path, to_bytes(tensors, metadata={KEY: text}))


def load(path: Path) -> tuple[dict[str, Tensor], Mapping[str, Any]]:
    """Read what `save` wrote.

    Raises:
        InputError: missing, damaged, or not written by sattools.
    """
    from safetensors import SafetensorError, safe_open

    try:
        with safe_open(path, framework="pt") as file:
            about = file.metadata() or {}
            tensors = {k: file.get_tensor(k) for k in file.keys()}  # noqa: SIM118
        description = json.loads(about[KEY])
    except FileNotFoundError as error:
        raise InputError(f"{path}: no such file, expected a model written by `sattools fit`") from error
    except (SafetensorError, KeyError, ValueError, OSError, RecursionError) as error:
        raise InputError(f"{path}: found no sattools model ({error})") from error
    if not isinstance(description, dict):
        raise InputError(f"{path}: found no sattools model (its description is no JSON object)")
    # older models have none
    expected = description.pop(CHECKSUM, None)
    if expected is not None and expected != _checksum(tensors, description):
        raise InputError(f"{path}: found other content than was written (checksum), expected an undamaged file")
    if description.pop(VERSION, None) is None:
        tensors = {_present(name): tensor for name, tensor in tensors.items()}
        description = {_FORMERLY.get(name, name): value for name, value in description.items()}
    return tensors, description


def _present(name: str) -> str:
    """The name of a tensor in the present version; a field's own tensors kept theirs."""
    return name if name.startswith("field.") else ".".join(_FORMERLY.get(word, word) for word in name.split("."))


def _checksum(tensors: Mapping[str, Tensor], description: Mapping[str, Any]) -> str:
    """SHA-256 of the description, and of names, types, shapes and bytes of the tensors."""
    known = hashlib.sha256(json.dumps(description, sort_keys=True).encode())
    for name in sorted(tensors):
        tensor = tensors[name]
        known.update(f"{name} {tensor.dtype} {list(tensor.shape)}".encode())
        known.update(tensor.contiguous().numpy().tobytes())
    return known.hexdigest()


__all__ = ["load", "save"]
