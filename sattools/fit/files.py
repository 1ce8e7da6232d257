"""What a fit leaves below the scene's root."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field

from sattools.fit.model import FittedModel
from sattools.fit.stored import StreamedModel
from sattools.fit.tiles.state import end
from sattools.fit.trace import Trace
from sattools.scene import Scene
from sattools.scene.dependencies import MADE, Seen, record
from sattools.scene.document import CHECKPOINT
from sattools.scene.files import all_or_nothing, together, write_text
from sattools.scene.jsonio import JsonObject
from sattools.scene.runner import at_the_end, unchanged_unless_done

MODEL, TRACE = "fit/model.safetensors", "fit/trace.csv"


@dataclass(frozen=True)
class Fitted:
    """What a fit has come to: the model, what happened on the way, and notes and seconds of steps for the history."""

    model: FittedModel | StreamedModel
    trace: Trace
    notes: list[str]
    seconds: Mapping[str, float] = field(default_factory=dict)


def save_fit(scene: Scene, fitted: Fitted, made: JsonObject | None, read: Seen | None) -> JsonObject:
    """Write model and trace below the scene's root.

    Args:
        scene: gets the products.
        fitted: what to write.
        made: record of a prior that the fit has made.
        read: the images as they were when the fit began.

    Returns:
        Figures for the history, with what was made from what.
    """
    trace = fitted.trace
    fitted.model.save(scene.output(MODEL))
    write_text(scene.output(TRACE), trace.to_csv())
    scene.products.update(model=MODEL, trace=TRACE)
    used = [item for item in scene.items if item.id in fitted.model.items]
    made = {**(made or {}), **record(scene, "fit", used, read)}
    return {
        "notes": fitted.notes,
        **fitted.seconds,
        "fit": {"loss": trace.rows[-1]["loss"], "epochs": len(trace.rows)},
        MADE: made,
    }


@contextmanager
def one_result(scene: Scene) -> Iterator[None]:
    """What a fit leaves, a prior that it makes included, appears together at its end, with the scene's document.

    Until then what an earlier fit has left still counts. Thereafter there is nothing to go on with any more. A part of
    a fit in tiles stands for itself: its document says nothing of what is left to do.

    Args:
        scene: what is fitted.
    """
    with unchanged_unless_done(scene), all_or_nothing() if scene.is_part else together():
        yield
    if scene.is_part:
        _forget_interrupted(scene)
    else:
        at_the_end(lambda: _forget_interrupted(scene))


def _forget_interrupted(scene: Scene) -> None:
    """What a fit would go on with, had this one been interrupted."""
    scene.output(CHECKPOINT).unlink(missing_ok=True)
    end(scene.root)


__all__ = ["CHECKPOINT", "MODEL", "TRACE", "Fitted", "one_result", "save_fit"]
