"""What a batch has to do: tasks, and a key for each by which finished ones are known again."""

from __future__ import annotations

import hashlib
import json
import logging
from dataclasses import replace
from pathlib import Path
from typing import Any

from sattools import __version__
from sattools.batch.configuration import (
    COMMANDS,
    OPTIONAL,
    Configuration,
    metadata_files,
    options_of,
    reference_files,
    toml_of,
)
from sattools.batch.work import Task
from sattools.errors import InputError
from sattools.scene.dependencies import files_of
from sattools.scene.document import Scene, check_id
from sattools.scene.files import write_text
from sattools.scene.jsonio import read_json
from sattools.scene.schema import Anything, Items, Table, Text

log = logging.getLogger(__name__)
_DIGESTS = Table(other=Items(Anything(), 4, 4))
TILES = "fit/tiles"  # below the folder of a run; see `sattools.fit.tiles.stage`


class Digests:
    """SHA-256 of files, remembered in a file as long as their sizes and times stay what they were.

    Among the times is that of the last change of whatever, as `cp -p`, `rsync -t` and `tar` give other pixels the size
    and the time of those before.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        try:
            self.known = read_json(path)
            _DIGESTS.check(self.known, str(path))
        except InputError:
            self.known = {}

    def __call__(self, path: Path, what: str = "a file of the scene") -> str:
        """SHA-256 of a file, read again only where its size or a time has changed; what it is, for messages."""
        try:
            state = path.stat()
            name, stamp = str(path.resolve()), [state.st_size, state.st_mtime_ns, state.st_ctime_ns]
            if self.known.get(name, [None])[:3] != stamp:
                with open(path, "rb") as file:
                    self.known[name] = [*stamp, hashlib.file_digest(file, "sha256").hexdigest()]
        except OSError as error:
            raise InputError(f"{path}: cannot be read ({error.strerror}), expected {what}") from error
        return str(self.known[name][-1])

    def save(self) -> None:
        """Write what is known."""
        write_text(self.path, json.dumps(self.known) + "\n")


def _key_of(*parts: Any) -> str:
    """Hash of JSON-able parts and the suite's version."""
    text = json.dumps([__version__, *parts], sort_keys=True, default=str)
    return hashlib.sha256(text.encode()).hexdigest()


def scene_content(scene: Scene, digests: Digests) -> list[Any]:
    """What a scene holds, but not where it lies nor how long it took to make."""
    document = scene.to_dict()
    for name in ("root", "history"):
        del document["sattools"][name]
    return [document, [digests(path) for path in files_of(scene)]]


def with_metadata(content: Any, configuration: Configuration, digests: Digests) -> Any:
    """What a scene's inputs are, with the metadata that a configuration calibrates them by.

    Args:
        content: of the scene.
        configuration: the configuration.
        digests: of files, as known so far.
    """
    files = [(path.name, digests(path)) for path in metadata_files(configuration)]
    return [content, files] if files else content


def run_task(
    out: Path,
    scene: str,
    source: Path,
    content: Any,
    configuration: Configuration,
    *,
    truth: Path | None,
    digests: Digests,
    prepared: bool = False,
) -> Task:
    """The task that fits, exports and scores one scene in one configuration.

    Args:
        out: folder of the batch.
        scene: its id.
        source: its document.
        content: what the scene's inputs are, for the key.
        configuration: the configuration.
        truth: folder of the reference, or None.
        digests: of files, as known so far.
        prepared: the batch makes the scene itself.
    """
    commands = _run_commands(configuration, scene, truth)
    references = sorted(reference_files(configuration, truth, scene))
    wanted = {name: table for name, table in configuration.resolved.items() if name != "prep"}
    what = f"a file that [compare] or [align] of {configuration.name} names"
    known = [digests(path, what) for path in references]
    # the reference counts by what it holds
    steps = [[part for part in command if part != str(truth)] for command in commands]
    key = _key_of("run", content, wanted, sorted(configuration.tables), steps, known)
    folder = out / "runs" / check_id(configuration.name, "configuration") / check_id(scene, "scene")
    name = f"{scene}/{configuration.name}"
    config = toml_of(configuration, COMMANDS)  # `prep`'s, too, which is part of what a row of the table is of
    options = options_of(configuration, prepared)
    return Task(name, str(folder), key, scene, configuration.name, str(out), commands, config, str(source), options)


def _run_commands(configuration: Configuration, scene: str, truth: Path | None) -> list[list[str]]:
    """Those of a run, the optional ones where the configuration has a table of theirs."""
    commands = []
    for name in COMMANDS[1:]:
        if name in (*OPTIONAL, "align") and name not in configuration.tables:
            continue
        reference = _reference(configuration, scene, truth) if name == "compare" else []
        if reference is not None:
            commands.append([name, "{scene}", "--overwrite", *reference])
    return commands


def _reference(configuration: Configuration, scene: str, truth: Path | None) -> list[str] | None:
    """What tells `compare` of a reference that the configuration does not name itself; None = there is none."""
    given = configuration.resolved.get("compare", {})
    if given.get("truth") or given.get("dsm"):
        return []
    if truth is not None:
        return ["--truth", str(truth)] if truth.is_dir() else []
    if "compare" in configuration.tables:
        log.warning("%s: found no reference of scene %s, [compare] is left out", configuration.name, scene)
    return None


def prep_task(
    out: Path,
    aoi: str,
    images: list[Path],
    arguments: list[str],
    configuration: Configuration,
    *,
    metadata: Path | None,
    digests: Digests,
) -> Task:
    """The task that makes the scene of an area; configurations with the same options of `prep` share it.

    Args:
        out: folder of the batch.
        aoi: name of the area.
        images: files to read.
        arguments: more arguments of `prep`.
        configuration: the configuration.
        metadata: folder of the images' metadata, where the configuration names none.
        digests: of files, as known so far.
    """
    from sattools.prep.folders import input_files

    options = configuration.resolved.get("prep", {})
    given = options.get("metadata")
    named = [options.get("aoi"), *options.get("mask", ())]
    files = input_files(images, given or (str(metadata) if metadata else None), named, options.get("colours"))
    read = sorted((path.name, digests(path, f"a file that prep of {aoi} reads")) for path in files)
    key = _key_of("prep", aoi, read, arguments, options)
    folder = out / "prep" / _key_of(options)[:8] / check_id(aoi, "scene")
    where = ["--metadata", str(metadata)] if metadata and not given else []
    command = ["prep", *map(str, images), "--id", aoi, "--out", str(folder), *where, *arguments, "--overwrite"]
    config = toml_of(configuration, ["prep"])
    return Task(f"{aoi}/prep", str(folder), key, aoi, configuration.name, str(out), [command], config, kind="prep")


def shared_task(out: Path, run: Task, content: Any, configuration: Configuration) -> Task | None:
    """The task that makes what the runs of a scene may share, `normalise` and `prior`.

    None where the fit makes its own prior, as held-out images have no part in it, or none.

    Args:
        out: folder of the batch.
        run: task of the run.
        content: what the scene's inputs are, for the key.
        configuration: the configuration.
    """
    fit = configuration.resolved.get("fit", {})
    apart = fit.get("holdout") or fit.get("views", "all") != "all" or fit.get("preset", "fast") != "fast"
    if apart or fit.get("tile") or not fit.get("prior_weight", 1.0):
        return None
    wanted = {name: configuration.resolved.get(name) for name in OPTIONAL}
    given = ["normalise"] if "normalise" in configuration.tables else []
    folder = out / "shared" / _key_of(wanted, given)[:8] / run.scene
    return replace(
        run,
        name=f"{run.scene}: prior",
        folder=str(folder),
        key=_key_of("shared", content, wanted, given),
        commands=[[name, "{scene}", "--overwrite"] for name in (*given, "prior")],
        config=toml_of(configuration, list(OPTIONAL)),
        kind="prep",
    )


def after_shared(run: Task, shared: Task) -> Task:
    """A run that goes on from what `shared_task` has left."""
    rest = [command for command in run.commands if command[0] not in OPTIONAL]
    return replace(run, commands=rest, source=str(Path(shared.folder) / "scene.json"))


def coarse_task(run: Task, content: Any, configuration: Configuration) -> Task:
    """The task that begins a run in tiles with a coarse fit; see `sattools.fit.tiles.stage`.

    Args:
        run: task of the run.
        content: what the scene's inputs are, for the key.
        configuration: the configuration.
    """
    before = ("normalise", "prior", "fit")
    wanted = {name: configuration.resolved.get(name) for name in before}
    given = [name for name in before if name in configuration.tables]
    commands = [["normalise", "{scene}", "--overwrite"]] if "normalise" in given else []
    commands.append(["fit", "{scene}", "--overwrite", "--part", "coarse"])
    return replace(
        run, name=f"{run.name}: coarse", key=_key_of("coarse", content, wanted, given), commands=commands, kind="coarse"
    )


def pilot_tasks(run: Task, coarse: Task) -> tuple[list[Task], Task]:
    """The tasks of the pilot tiles that a finished coarse fit has left, and the split that follows them.

    Args:
        run: task of the run.
        coarse: task of the coarse fit.
    """
    names = _listed(run, "pilots")
    commands = [["fit", "{scene}", "--overwrite"]]
    pilots = [_part(run, name, _key_of("pilot", coarse.key, name), commands) for name in names]
    split = replace(
        run, name=f"{run.name}: split", key=_key_of("split", coarse.key), kind="split",
        commands=[["fit", "{scene}", "--overwrite", "--resume", "--part", "split"]],
        source=str(Path(run.folder) / "scene.json"),
    )  # fmt: skip
    return pilots, split


def tile_tasks(run: Task, split: Task, configuration: Configuration) -> tuple[list[Task], Task]:
    """The tasks of the tiles that a finished split has left, and the run that joins them.

    Args:
        run: task of the run.
        split: task of the split.
        configuration: the configuration.
    """
    steps = ["prior", "fit"] if "prior" in configuration.tables else ["fit"]
    commands = [[step, "{scene}", "--overwrite"] for step in steps]
    tiles = [_part(run, name, _key_of("tile", split.key, name), commands) for name in _listed(run, "tiles")]
    # an area of one tile is fitted at once, by the run
    done = OPTIONAL if tiles else ("normalise",)
    rest = [command for command in run.commands if command[0] not in done]
    joined = [[*command, "--part", "mosaic"] if command[0] == "fit" else command for command in rest]
    return tiles, replace(run, commands=joined, source=str(Path(run.folder) / TILES / "scene.json"))


def _listed(run: Task, what: str) -> list[str]:
    """Names of a run's ``tiles`` or ``pilots``."""
    path = Path(run.folder) / TILES / "tiles.json"
    listing = read_json(path)
    Table({what: Items(Text())}, (what,)).check(listing, str(path))
    return list(listing[what])


def _part(run: Task, name: str, key: str, commands: list[list[str]]) -> Task:
    """The task of a tile."""
    folder = Path(run.folder) / TILES / name
    return replace(
        run, name=f"{run.name}: tile {name}", folder=str(folder), key=key, commands=commands,
        source=str(folder / "scene.json"), kind="tile",
    )  # fmt: skip


__all__ = [
    "Digests", "Task", "after_shared", "coarse_task", "pilot_tasks", "prep_task", "run_task", "scene_content",
    "shared_task", "tile_tasks", "with_metadata",
]  # fmt: skip
