"""One unit of work of a batch: its folder, what counts as its result, and what an interrupted run of it leaves."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from sattools.errors import InputError, SattoolsError
from sattools.fit.tiles.state import STATE
from sattools.scene.copies import in_another_root
from sattools.scene.dependencies import files_of
from sattools.scene.document import CHECKPOINT, Scene
from sattools.scene.files import remove_orphans, write_text
from sattools.scene.jsonio import JsonObject, read_json
from sattools.scene.location import RemotePath
from sattools.scene.schema import Items, Number, Table, Text

_RECORD = Table({"key": Text(), "status": Text(), "scene_json": Text(), "row": Table()}, ("key", "scene_json"))
_BEGUN = Table({"key": Text(), "history": Number(0), "steps": Items(Text())}, ("key", "history", "steps"))


@dataclass(frozen=True)
class Task:
    """One unit of work: commands, run one after the other in a folder of its own.

    Attributes:
        name: for messages.
        folder: where `task.json`, `config.toml` and the results go.
        key: hash of everything that the result depends on.
        scene: id of the scene; configuration: name.
        out: folder of the batch, which may be moved with all that it holds.
        commands: arguments of `sattools`, one list a command; `{scene}` stands for the folder's scene.json.
        config: TOML with the options.
        source: scene.json to copy, or None where the first command makes the scene.
        options: of a run, see `options_of`.
        kind: `prep`, `run` (whose result is a row of the table), or for a fit in tiles before it `coarse`, `tile` (of
            pilots, too) and `split`.
    """

    name: str
    folder: str
    key: str
    scene: str
    configuration: str
    out: str
    commands: list[list[str]]
    config: str
    source: str | None = None
    options: str = ""
    kind: Literal["prep", "run", "coarse", "split", "tile"] = "run"

    @property
    def record(self) -> Path:
        """Where the result is kept; what is done of a scene before its tiles shares the folder with the run."""
        return Path(self.folder) / (f"{self.kind}.json" if self.kind in ("coarse", "split") else "task.json")

    @property
    def document(self) -> Path:
        """Where its scene's document is, once it has begun."""
        return Path(self.folder) / ("scene.json" if self.source is not None else f"{self.scene}/scene.json")

    @property
    def begun(self) -> Path:
        """Where it is noted while it is done, for another run to go on with it."""
        return Path(self.folder) / "begun.json"

    @property
    def _steps(self) -> list[str]:
        return [command[0] for command in self.commands]

    def result(self) -> JsonObject | None:
        """What an earlier run of the very same task left in this folder, or None; also where a file of it is gone."""
        try:
            record = read_json(self.record)
            _RECORD.check(record, str(self.record))
        except InputError:  # missing, or not what a batch has written: it is done again
            return None
        if record["key"] != self.key or not _complete(self.document):
            return None
        # the record of a folder that was copied or moved names the document in the old one
        return record | {"scene_json": str(self.document)}

    def start(self) -> Path:
        """Make the folder ready; the path of its scene.json. An earlier result is no longer valid from here on."""
        folder = self._ready()
        self.begun.unlink(missing_ok=True)
        if self.source is not None:
            self._remove_left_over()
            document = in_another_root(Path(self.source), folder, Path(self.out))
            known = len(Scene.from_file(document).history)
            begun = {"key": self.key, "history": known, "steps": self._steps}
            write_text(self.begun, json.dumps(begun) + "\n")
        return self.document

    def go_on(self) -> int | None:
        """As `start`, for what an interrupted run of the very same task has left.

        Returns:
            How many commands it has finished; None, and nothing is changed, where there is nothing to go on with.
        """
        finished = self._finished() if self.source is not None else None
        if finished is not None:
            self._ready()
        return finished

    def _ready(self) -> Path:
        folder = Path(self.folder)
        folder.mkdir(parents=True, exist_ok=True)
        remove_orphans(folder)
        self.record.unlink(missing_ok=True)
        write_text(folder / "config.toml", self.config)
        return folder

    def _finished(self) -> int | None:
        """Commands that an interrupted run has finished, by the history; None where there is nothing to go on with."""
        try:
            noted = read_json(self.begun)
            _BEGUN.check(noted, str(self.begun))
        except InputError:
            return None
        # a run that shares what is made of its scene begins with less to do, on another document, for the same result
        if noted["key"] != self.key or noted["steps"] != self._steps or not _complete(self.document):
            return None
        history = [entry.get("command") for entry in Scene.from_file(self.document).history]
        since = history[int(noted["history"]) :]
        known = len(history) >= noted["history"] and since == self._steps[: len(since)]
        return len(since) if known else None

    def _remove_left_over(self) -> None:
        """Remove what interrupted runs of other tasks have left, which this one cannot go on with."""
        from sattools.prior.resume import kept_in

        folder = Path(self.folder)
        # of a fit of the whole; of its tiles another task may be about to join what is there
        fits = any(command[0] == "fit" and not {"split", "mosaic"} & {*command} for command in self.commands)
        for path in [*kept_in(folder), *((folder / name for name in (CHECKPOINT, STATE)) if fits else ())]:
            path.unlink(missing_ok=True)

    def going_on(self, command: list[str]) -> list[str]:
        """How the command that was interrupted is called so that it goes on; `start` has removed what it must not."""
        from sattools.prior.resume import kept_in

        folder = Path(self.folder)
        left = any((folder / name).exists() for name in (CHECKPOINT, STATE))
        if command[0] == "fit" and left and not {"--resume", "mosaic"} & {*command}:
            return [*command, "--resume"]
        if command[0] == "prior" and kept_in(folder):  # which know whether they may replace what is there
            return [part for part in command if part != "--overwrite"]
        return command


def _complete(document: Path) -> bool:
    """Whether a scene's document is there and all files that it names are; those elsewhere are believed to be."""
    try:
        return all(isinstance(path, RemotePath) or path.is_file() for path in files_of(Scene.from_file(document)))
    except SattoolsError:  # missing, or damaged
        return False


__all__ = ["Task"]
