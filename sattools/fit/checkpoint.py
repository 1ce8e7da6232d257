"""Saving and loading of fitted scenes and of interrupted fits (safetensors with JSON metadata, no pickle)."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from torch import Tensor

from sattools.errors import InputError
from sattools.scene.raster import atomic

KEY = "sattools"


def save(path: Path, tensors: dict[str, Tensor], meta: dict[str, Any]) -> None:
    """Write tensors and a JSON description into one file, atomically."""
    from safetensors.torch import save_file

    with atomic(path) as temporary:
        save_file({k: v.contiguous() for k, v in tensors.items()}, temporary, metadata={KEY: json.dumps(meta)})


def load(path: Path) -> tuple[dict[str, Tensor], dict[str, Any]]:
    """Read what `save` wrote.

    Raises:
        InputError: missing, damaged, or not written by sattools.
    """
    from safetensors import SafetensorError, safe_open

    try:
        with safe_open(path, framework="pt") as file:
            meta = json.loads((file.metadata() or {})[KEY])
            return {k: file.get_tensor(k) for k in file.keys()}, meta  # noqa: SIM118
    except FileNotFoundError as error:
        raise InputError(f"{path}: no such file, expected a model written by `sattools fit`") from error
    except (SafetensorError, KeyError, ValueError, OSError) as error:
        raise InputError(f"{path}: found no sattools model ({error})") from error


__all__ = ["load", "save"]
