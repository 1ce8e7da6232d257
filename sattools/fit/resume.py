"""What an interrupted fit leaves, so that another run can go on with it."""

from __future__ import annotations

import logging
from collections.abc import Mapping
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import Any, Literal

from torch import Tensor

from sattools.errors import InputError, OutputExistsError, SceneError
from sattools.fit.checkpoint import describe, load, save
from sattools.fit.trace import Row
from sattools.progress import duration
from sattools.scene.files import immediately
from sattools.scene.jsonio import JsonObject
from sattools.scene.schema import shown

log = logging.getLogger(__name__)
ANEW = "give --overwrite in place of --resume to fit anew"
OTHER_FIT = f"found a checkpoint of other options, images or cameras, expected the same; {ANEW}"


@dataclass(frozen=True)
class IlluminationOptions:
    """The options of the illumination after every ``auto`` was resolved; see `FitOptions`."""

    shadow: Literal["none", "geometric", "learned", "auto"]
    transient: Literal["on", "off", "auto"]


@dataclass(frozen=True)
class Interrupted:
    """A fit that was interrupted.

    Attributes:
        tensors: of the trainer.
        fingerprint: of everything that the run going on must share, see `sattools.fit.inputs.fingerprint`.
        rows: of the trace so far.
        stage, epoch: where a surface is; step: where a field of rays is.
        illumination: of a surface.
        light: why that was chosen; reasons: for which materials a model was, and sky_ratio: see `ReflectiveScene`.
        basis: what was known before an image was read, see `sattools.fit.inputs.basis_of`; older checkpoints have none.
        seconds: spent so far [s]; 0 in older checkpoints.
    """

    tensors: Mapping[str, Tensor]
    fingerprint: str
    rows: list[Row]
    stage: int = 0
    epoch: int = 0
    step: int = 0
    illumination: IlluminationOptions | None = None
    light: list[str] = field(default_factory=list)
    reasons: list[str] = field(default_factory=list)
    sky_ratio: float = 0.0
    basis: JsonObject = field(default_factory=dict)
    seconds: float = 0.0

    def save(self, path: Path) -> None:
        """Write a checkpoint.

        Raises:
            SattoolsError: it cannot be written.
        """
        description: dict[str, Any] = {f.name: getattr(self, f.name) for f in fields(self) if f.name != "tensors"}
        description["illumination_options"] = vars(self.illumination) if self.illumination else None
        del description["illumination"]
        with immediately():
            save(path, self.tensors, description)

    @classmethod
    def load(cls, path: Path, fingerprint: str) -> Interrupted | None:
        """Read a checkpoint of the fit with that fingerprint; None, and a warning, where there is none.

        Raises:
            SceneError: a checkpoint of another fit.
            InputError: a damaged one.
        """
        if not path.exists():
            log.warning("%s: no checkpoint, the fit starts anew", path)
            return None
        tensors, description = load(path)
        if description.get("fingerprint") != fingerprint:
            raise SceneError(f"{path}: {OTHER_FIT}")
        known = {f.name: description[f.name] for f in fields(cls) if f.name in description}
        illumination = description.get("illumination_options")
        try:
            options = IlluminationOptions(**illumination) if illumination else None
            return cls(**{**known, "tensors": tensors, "illumination": options})
        except TypeError as error:
            raise InputError(f"{path}: found no checkpoint of a fit ({error})") from error


def check_checkpoint(path: Path, basis: JsonObject) -> None:
    """Whether a fit on that basis may go on with a checkpoint, as far as it can be said before images are read.

    Args:
        path: of the checkpoint; nothing is said where there is none.
        basis: of the fit, see `sattools.fit.inputs.basis_of`.

    Raises:
        SceneError: a checkpoint of another fit.
        InputError: a damaged one.
    """
    if not path.exists():
        return
    found = describe(path).get("basis")
    if not isinstance(found, dict) or not found:  # of an older version, told when all is known
        return
    for name in found | basis:
        old, new = found.get(name), basis.get(name)
        if old == new:
            continue
        if name.startswith("--") and name not in found:
            raise SceneError(
                f"{path}: found a checkpoint of an earlier version, without {name}, expected this one's; {ANEW}"
            )
        if name.startswith("--"):
            raise SceneError(
                f"{path}: found a checkpoint of other options ({name} {shown(old)}), expected {name} {shown(new)}; "
                f"{ANEW}"
            )
        raise SceneError(f"{path}: found a checkpoint of other {name}, expected the same; {ANEW}")


def check_nothing_begun(path: Path) -> None:
    """Whether a fit may begin anew, which would replace the checkpoint of an interrupted one.

    Args:
        path: of the checkpoint.

    Raises:
        OutputExistsError: there is one.
    """
    if not (path.exists() or path.is_symlink()):
        return
    try:
        done = _how_far(describe(path))
    except InputError as error:
        raise OutputExistsError(
            f"{path}: found a file that is no checkpoint, or a damaged one; give --overwrite to fit anew, onto it"
        ) from error
    raise OutputExistsError(
        f"{path}: found an interrupted fit{done}; give --resume to go on, or --overwrite to fit anew"
    )


def how_to_go_on(path: Path, since: float, steps: int) -> str | None:
    """What can be done with the checkpoint that an interruption leaves, in words; None where it leaves none.

    Args:
        path: of the checkpoint.
        since: when the fit began [s since 1970]; an older one is none of this fit.
        steps: that a field of rays was to be trained.
    """
    try:
        if path.stat().st_mtime < since:
            return None
        done = _how_far(describe(path), steps)
    except (OSError, InputError):
        return None
    return (
        f"interrupted; kept{done}: `sattools fit --resume` with the same options goes on, and with --budget 1 beside "
        "it ends there, so that `export` can show it"
    )


def _how_far(description: JsonObject, steps: int | None = None) -> str:
    """Where an interrupted fit is, in the words of its progress; older checkpoints may not say it."""
    try:
        last = (description["rows"] or [{}])[-1]
        step = description.get("step")  # of a field
        of = f" of {steps}" if steps else ""
        where = f"step {step}{of}" if step else f"{last['cell_m']:g} m, epoch {last['epoch']}"
        return f" after {duration(description.get('seconds') or last['seconds'])} ({where})"
    except (KeyError, IndexError, TypeError, ValueError):
        return ""


__all__ = [
    "ANEW",
    "OTHER_FIT",
    "IlluminationOptions",
    "Interrupted",
    "check_checkpoint",
    "check_nothing_begun",
    "how_to_go_on",
]
