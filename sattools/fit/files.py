"""What a fit leaves below the scene's root."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from torch import Tensor

from sattools.fit import checkpoint
from sattools.fit.trace import Trace
from sattools.scene import Scene
from sattools.scene.dependencies import MADE, record
from sattools.scene.files import all_or_nothing, write_text

MODEL, TRACE, CHECKPOINT = "fit/model.safetensors", "fit/trace.csv", "fit/checkpoint.safetensors"
STATE = "fit/tiles/tiles.json"  # of a fit in tiles that is not finished


def save_fit(
    scene: Scene,
    path: Path,
    tensors: dict[str, Tensor],
    meta: dict[str, Any],
    trace: Trace,
    notes: list[str],
    made: dict[str, Any] | None = None,
) -> dict[str, Any]:
    """Write model and trace; figures for the history, with what was made from what (``made``: the prior's record)."""
    with all_or_nothing():
        checkpoint.save(path, tensors, meta)
        write_text(scene.output(TRACE), trace.to_csv())
    scene.output(CHECKPOINT).unlink(missing_ok=True)
    scene.products.update(model=MODEL, trace=TRACE)
    used = [item for item in scene.items if item.id in meta["items"]]
    return {
        "notes": notes,
        "fit": {"loss": trace.rows[-1]["loss"], "epochs": len(trace.rows)},
        MADE: {**(made or {}), **record(scene, "fit", used)},
    }


__all__ = ["CHECKPOINT", "MODEL", "STATE", "TRACE", "save_fit"]
