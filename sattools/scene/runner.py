"""How a stage is run on a scene, from the command line and from Python alike.

It is alone in the scene, all its files appear together, and an entry goes to the history.
"""

from __future__ import annotations

import contextlib
import contextvars
import copy
import logging
import sys
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

from sattools import __version__, system
from sattools.errors import SceneError, StaleError
from sattools.processors import imported
from sattools.progress import Progress, silent
from sattools.runlog import RunLog
from sattools.scene.dependencies import SOURCES
from sattools.scene.document import Scene
from sattools.scene.files import all_or_nothing, locked
from sattools.scene.given import flag_of
from sattools.scene.jsonio import JsonObject
from sattools.scene.location import is_remote
from sattools.settings import as_dict

Work = Callable[[Scene, Progress], dict[str, Any] | None]
_last: contextvars.ContextVar[list[Callable[[], object]] | None] = contextvars.ContextVar("last", default=None)


@dataclass(frozen=True)
class Step:
    """What is run.

    Attributes:
        command: its name in the history.
        options: of the stage, a dataclass; None = none.
        overwrite: whether outputs may replace what is there.
        progress: told the share done.

    Raises:
        InputError: `overwrite` is neither True nor False.
    """

    command: str
    options: Any = None
    overwrite: bool = False
    progress: Progress = silent

    def __post_init__(self) -> None:
        object.__setattr__(self, "overwrite", flag_of(self.overwrite, "overwrite"))


def run_on(scene: Scene, step: Step, work: Work) -> tuple[Scene, JsonObject]:
    """Work on a scene while no other process does; the scene and its new history entry.

    The scene's folder is what counts: what another command has added to its document since this one was read is kept.

    Args:
        scene: the scene; it stays as it was where the work fails.
        step: what is run, and how.
        work: what is done.

    Raises:
        SceneError: the scene's folder is not there, has none of its files, or holds the document of something else.
    """
    if not scene.root.is_dir():
        raise SceneError(f"scene {scene.id}: found no folder {scene.root}, expected the scene's root")
    check_place(scene)
    with locked(scene.root), _log_of(step) as log, unchanged_unless_done(scene):
        log.place(scene.root)
        if scene.origin is not None:
            _catch_up(scene, Scene.from_file(scene.origin))
        there = document_of(scene, step.overwrite)
        later: list[str] = []  # commands that the scene in hand has not been through
        if there is not None and there.history[: len(scene.history)] == scene.history:
            later = [entry.get("command", "") for entry in there.history[len(scene.history) :]]
            scene.history = there.history
        start = _Clock.now()
        with _last_things(), all_or_nothing():
            with _told_of(scene, later, anew=there is not None and _made_anew(there, scene)) as notes:
                extra = work(scene, log.told(step.progress)) or {}
            if notes:
                extra = {**extra, "notes": [*extra.get("notes", []), *notes]}
            entry = _note(scene, step, start, extra)
        log.done(entry)
        scene.origin = None  # from here on the scene knows more than that file
        return scene, entry


def _catch_up(scene: Scene, now: Scene) -> None:
    """Make of a scene what its file is now, where a command has been at that since; else a program may have changed it.

    Args:
        scene: as it was read, or as a program has made it since.
        now: its file.
    """
    if now.history != scene.history:
        vars(scene).update(vars(now))


def run_first(
    step: Step, make: Callable[[Progress], tuple[Scene, JsonObject | None]], inputs: Iterable[Path] = ()
) -> Scene:
    """Make a scene; ``inputs`` are files that it must not write onto.

    Its files appear while no other command works in its folder: one that has begun with those from before ends with
    them, and what it notes is true.

    Args:
        step: what is run, and how.
        make: gives the scene and its history entry.
        inputs: see above.
    """
    start = _Clock.now()
    with _log_of(step) as log, contextlib.ExitStack() as alone:
        with _last_things(), all_or_nothing(inputs, step.overwrite):
            scene, extra = make(log.told(step.progress))
            entry = _note(scene, step, start, extra)
            alone.enter_context(locked(scene.root))
        log.place(scene.root)
        log.done(entry)
    return scene


def at_the_end(call: Callable[[], object]) -> None:
    """Do something once the scene's document is written, such as to remove what a lost one would be made of again.

    Where no command works on a scene it is done at once.

    Args:
        call: what is done.
    """
    waiting = _last.get()
    if waiting is None:
        call()
    else:
        waiting.append(call)


@contextlib.contextmanager
def unchanged_unless_done(scene: Scene) -> Iterator[None]:
    """A scene in memory, of a program that goes on, is what it was where its files are.

    Args:
        scene: that the work inside changes.
    """
    before = copy.deepcopy(vars(scene))
    try:
        yield
    except BaseException:
        vars(scene).update(before)
        raise


def _made_anew(there: Scene, scene: Scene) -> bool:
    """Whether `prep` or `simulate` has been run again between the two documents of one folder."""
    first = [(s.history[0] if s.history else {}) for s in (there, scene)]
    if any(entry.get("command") not in SOURCES for entry in first):
        return False
    # numbers that are written as they are; others may come back from a file changed, as NaN does
    return any(first[0].get(name) != first[1].get(name) for name in ("command", "seconds", "cpu_seconds"))


@contextlib.contextmanager
def _told_of(scene: Scene, later: Sequence[str], anew: bool) -> Iterator[list[str]]:
    """What to say of a document of before, as a pipe has left it in a file: notes; why products are out of date.

    Args:
        scene: as that document has it.
        later: commands that have changed the one in the scene's folder since.
        anew: the scene has been made anew since.
    """
    commands = ", ".join(dict.fromkeys(later))
    since = f"the document is older than {scene.path('scene.json')}, which has been through {commands} since"
    notes = [f"{since}: cameras and heights are those from before `align`"] if "align" in later else []
    if anew:
        notes = [
            f"the document is not that of {scene.path('scene.json')}, which was made anew since: grid, heights and "
            "angles are the document's, images and cameras may be the new ones"
        ]
    for text in notes:
        logging.getLogger(__name__).warning("scene %s: %s", scene.id, text)
    try:
        yield notes
    except StaleError as error:
        raise StaleError(f"{error}; {since}" if later else str(error)) from error


@contextlib.contextmanager
def _last_things() -> Iterator[None]:
    waiting: list[Callable[[], object]] = []
    token = _last.set(waiting)
    try:
        yield
    finally:
        _last.reset(token)
    for call in waiting:
        call()


def _log_of(step: Step) -> RunLog:
    return RunLog(step.command, _settings(step))


def _settings(step: Step) -> JsonObject:
    return _plain(as_dict(step.options)) if step.options is not None else {}


def check_place(scene: Scene) -> None:
    """Raise SceneError where a `scene.json` lies elsewhere than its files: its root is "." and means another folder.

    Args:
        scene: as it was read: of a file, whose folder is meant, or of a pipe, where it is the current folder.
    """
    if scene.root not in (Path.cwd(), scene.origin and scene.origin.parent):
        return
    hrefs = [asset.href for item in scene.items for asset in item.assets.values()] + list(scene.products.values())
    own = [href for href in hrefs if not (is_remote(href) or Path(href).is_absolute())]
    if own and not any((scene.root / href).exists() for href in own):
        if scene.origin is not None:
            here = Path.cwd()
            shown = scene.origin.relative_to(here) if scene.origin.is_relative_to(here) else scene.origin
            raise SceneError(
                f"scene {scene.id}: found none of its files in {scene.root}, where {shown} lies, "
                "expected the scene.json in the scene's folder (was that moved?)"
            )
        raise SceneError(
            f"scene {scene.id}: found none of its files in {scene.root}, the current folder, where a scene.json on a "
            "pipe has them, expected its path on the command line instead"
        )


def document_of(scene: Scene, overwrite: bool) -> Scene | None:
    """The document in the scene's folder, None where there is none; SceneError where it is of something else.

    Args:
        scene: whose folder it is.
        overwrite: whether it may be of something else.
    """
    path = scene.path("scene.json")
    if not path.exists():
        return None
    try:
        existing = Scene.from_file(path)
    except SceneError as error:
        if overwrite:
            return None
        raise SceneError(f"{error}; it would be replaced: give --overwrite, or another root") from error
    if existing.id != scene.id and not overwrite:
        raise SceneError(
            f"{path}: found scene {existing.id}, expected {scene.id}; give --overwrite to replace its document"
        )
    return existing if existing.id == scene.id else None


class _Clock(NamedTuple):
    """Seconds on the wall, and of all threads of the process and its children."""

    wall: float
    cpu: float

    @classmethod
    def now(cls) -> _Clock:
        return cls(time.perf_counter(), time.process_time() + system.children_seconds())


def _note(scene: Scene, step: Step, start: _Clock, extra: JsonObject | None) -> JsonObject:
    """Add the history entry and write the document."""
    end = _Clock.now()
    entry = {
        "command": step.command,
        "options": _settings(step),
        "seconds": round(end.wall - start.wall, 3),
        "cpu_seconds": round(end.cpu - start.cpu, 3),
        "peak_memory_mb": round(system.memory_peak(children=True) / 2**20, 1),
        "versions": _versions(),
        **(extra or {}),
    }
    scene.history.append(entry)
    scene.write()
    return entry


def _versions() -> dict[str, str]:
    versions = {"sattools": __version__, "python": ".".join(map(str, sys.version_info[:3]))}
    for name in ("numpy", "torch", "rasterio"):
        # only what the command really used: importing torch for its version costs seconds
        if module := imported(name):
            versions[name] = str(module.__version__)
    return versions


def _plain(value: Any) -> Any:
    if isinstance(value, dict):
        return {k: _plain(v) for k, v in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(v) for v in value]
    return str(value) if isinstance(value, Path) else value


__all__ = ["Step", "Work", "at_the_end", "check_place", "document_of", "run_first", "run_on", "unchanged_unless_done"]
