"""Files of fitted scenes and of interrupted fits (safetensors with a JSON description, no pickle)."""

from __future__ import annotations

import hashlib
import json
import math
import os
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import IO, TYPE_CHECKING, Any

import numpy as np

from sattools.errors import InputError
from sattools.scene.files import write_bytes, write_with
from sattools.scene.jsonio import JsonObject

if TYPE_CHECKING:
    from torch import Tensor

# one key, with the checksum inside: safetensors writes several in any order, and the same fit gives the same file
KEY, CHECKSUM, VERSION = "sattools", "sha256", "version"
FORMAT_VERSION = 2
# what a reader has to know lest it shows another scene than was fitted; a file names those that it has, if any
NEEDS, KNOWN_NEEDS = "needs", ("opened", "plain")
_PIECE = 1 << 22  # bytes that are read at a time
_TYPES = {
    "F64": "torch.float64", "F32": "torch.float32", "F16": "torch.float16", "BF16": "torch.bfloat16",
    "I64": "torch.int64", "I32": "torch.int32", "I16": "torch.int16", "I8": "torch.int8", "U8": "torch.uint8",
    "BOOL": "torch.bool",
}  # fmt: skip
Put = Callable[[str, int, np.ndarray], None]
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


def save_in_pieces(
    path: Path, shapes: Mapping[str, tuple[int, ...]], description: Mapping[str, Any], fill: Callable[[Put], None]
) -> None:
    """`save` for float32 tensors that are larger than memory.

    Args:
        path: file to write.
        shapes: of the tensors, by name.
        description: plain JSON types.
        fill: is given ``put(name, first, values)``, which writes values from the first-th element of a tensor on.

    Raises:
        SattoolsError: the file cannot be written.
    """
    plain = json.loads(json.dumps({VERSION: FORMAT_VERSION, **description}))
    unknown = "0" * hashlib.sha256().digest_size * 2
    table: dict[str, Any] = {"__metadata__": {KEY: json.dumps({**plain, CHECKSUM: unknown})}}
    begin: dict[str, int] = {}
    end = 0
    for name, shape in shapes.items():
        begin[name], end = end, end + 4 * math.prod(shape)
        table[name] = {"dtype": "F32", "shape": list(shape), "data_offsets": [begin[name], end]}
    text = json.dumps(table).encode()
    text += b" " * (-len(text) % 8)
    base = 8 + len(text)

    def write(target: Path) -> None:
        with open(target, "x+b") as file:
            file.write(len(text).to_bytes(8, "little") + text)
            os.truncate(file.fileno(), base + end)

            def put(name: str, first: int, values: np.ndarray) -> None:
                file.seek(base + begin[name] + 4 * first)
                file.write(np.ascontiguousarray(values, dtype="<f4").data)

            fill(put)
            file.flush()
            file.seek(8 + text.index(unknown.encode()))
            file.write(_checksum_of(file.name).encode())

    def check(target: Path) -> None:
        try:
            verify(target)
        except InputError as error:
            raise OSError(5, "found other content than was written") from error

    write_with(path, write, check)


def verify(path: Path) -> None:
    """Read a file of `save` piece by piece and compare it with its checksum.

    Raises:
        InputError: missing, damaged, not written by sattools, or by a later version that says more than this one knows.
    """
    describe(path)


def describe(path: Path) -> JsonObject:
    """`verify` a file; its description, as it was written.

    Raises:
        InputError: as `verify`.
    """
    try:
        with open(path, "rb") as file:
            table, _ = _table(file)
        description = dict(json.loads(table["__metadata__"][KEY]))
        _compare(path, description, lambda: _checksum_of(path))
        return description
    except InputError:
        raise
    except (KeyError, TypeError, ValueError, AttributeError, OSError) as error:
        raise InputError(f"{path}: found no sattools model ({error})") from error


def _table(file: IO[bytes]) -> tuple[dict[str, Any], int]:
    """The table of contents of a safetensors file, and where its data begin."""
    length = int.from_bytes(file.read(8), "little")
    return dict(json.loads(file.read(min(length, 1 << 26)))), 8 + length


def _checksum_of(path: Path | str) -> str:
    """`_checksum` of what a file holds, in the memory of a piece."""
    with open(path, "rb") as file:
        table, base = _table(file)
        description = json.loads(table.pop("__metadata__")[KEY])
        description.pop(CHECKSUM, None)
        known = hashlib.sha256(json.dumps(description, sort_keys=True).encode())
        for name in sorted(table):
            known.update(f"{name} {_TYPES[table[name]['dtype']]} {table[name]['shape']}".encode())
            first, last = table[name]["data_offsets"]
            file.seek(base + first)
            for piece in _pieces(file, last - first):
                known.update(piece)
    return known.hexdigest()


def _pieces(file: IO[bytes], count: int) -> Iterator[bytes]:
    while count > 0:
        piece = file.read(min(count, _PIECE))
        if not piece:
            raise ValueError("truncated")
        count -= len(piece)
        yield piece


def load(path: Path) -> tuple[dict[str, Tensor], Mapping[str, Any]]:
    """Read what `save` wrote.

    Raises:
        InputError: as `verify`.
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
    _compare(path, description, lambda: _checksum(tensors, description))
    description.pop(CHECKSUM, None)
    if description.pop(VERSION, None) is None:
        tensors = {_present(name): tensor for name, tensor in tensors.items()}
        description = {_FORMERLY.get(name, name): value for name, value in description.items()}
    return tensors, description


def _compare(path: Path, description: Mapping[str, Any], checksum: Callable[[], str]) -> None:
    """Whether a file is what was written, and by no later version; models of before checksums had no version either."""
    later = "; the version of sattools that wrote it, or a later one, reads it"
    version, needs = description.get(VERSION, FORMAT_VERSION), description.get(NEEDS, [])
    if isinstance(version, int) and version > FORMAT_VERSION:
        raise InputError(f"{path}: found a model of format {version}, expected at most {FORMAT_VERSION}{later}")
    if unknown := [name for name in needs if name not in KNOWN_NEEDS] if isinstance(needs, list) else [needs]:
        known = ", ".join(KNOWN_NEEDS)
        raise InputError(f"{path}: found a model that needs {unknown[0]!r}, expected no more than {known}{later}")
    if (CHECKSUM in description or VERSION in description) and description.get(CHECKSUM) != checksum():
        raise InputError(f"{path}: found other content than was written (checksum), expected an undamaged file")


def _present(name: str) -> str:
    """The name of a tensor in the present version; a field's own tensors kept theirs."""
    return name if name.startswith("field.") else ".".join(_FORMERLY.get(word, word) for word in name.split("."))


def _checksum(tensors: Mapping[str, Tensor], description: Mapping[str, Any]) -> str:
    """SHA-256 of the description without its own checksum, and of names, types, shapes and bytes of the tensors."""
    described = {key: value for key, value in description.items() if key != CHECKSUM}
    known = hashlib.sha256(json.dumps(described, sort_keys=True).encode())
    for name in sorted(tensors):
        tensor = tensors[name]
        known.update(f"{name} {tensor.dtype} {list(tensor.shape)}".encode())
        known.update(tensor.contiguous().numpy().tobytes())
    return known.hexdigest()


__all__ = ["KEY", "KNOWN_NEEDS", "NEEDS", "VERSION", "Put", "describe", "load", "save", "save_in_pieces", "verify"]
