"""What may be in the way of a batch, asked before anything is done."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from sattools.batch.configuration import Configuration, reference_files
from sattools.batch.join import FILES, SEAMS, check_crs
from sattools.batch.options import BatchOptions
from sattools.batch.plan import Task
from sattools.batch.table import TABLES
from sattools.errors import OutputExistsError, OutputIsInputError, SattoolsError
from sattools.scene.dependencies import files_of
from sattools.scene.document import Scene, check_id
from sattools.scene.files import check_outputs
from sattools.scene.jsonio import read_json

FIGURE, DIGESTS, JOINED = "speed_error.png", "digests.json", "joined"


def check_folder(
    options: BatchOptions, scenes: Sequence[Scene], configurations: Sequence[Configuration], overwrite: bool = False
) -> None:
    """Whether a batch may write what is of all its tasks together, and begin its runs; arguments as of `batch`.

    Raises:
        SattoolsError: see `check_outputs`.
        InputError: scenes that are to be joined and cannot be.
        OutputExistsError: a joined surface of other scenes than these.
    """
    out = Path(options.out).absolute()
    ids = [*(scene.id for scene in scenes), *options.aoi]
    pairs = [(name, c) for name in ids for c in configurations]
    inputs = [path for scene in scenes for path in (scene.root / "scene.json", scene.origin, *files_of(scene)) if path]
    inputs += [path for name, c in pairs for path in _given(c, name)]
    outputs = [out / name for name in (*TABLES, FIGURE, DIGESTS)]
    outputs += [document_of(scene, out) for scene in scenes if not is_own(scene, out)]
    # the commands of a run replace whatever there is
    outputs += [out / "runs" / c.name / name / file for name, c in pairs for file in ("task.json", "scene.json")]
    if options.join:
        check_crs({scene.id: scene.grid.crs for scene in scenes if scene.grid is not None})
        folders = [joined_folder(out, c.name) for c in configurations]
        outputs += [folder / name for folder in folders for name in FILES]
        for folder in () if overwrite else folders:
            _check_joined(folder, ids)
    ours = overwrite or (out / DIGESTS).exists()  # a batch is begun again in its own folder
    check_outputs(dict.fromkeys(outputs), inputs, ours)


def _check_joined(folder: Path, ids: Sequence[str]) -> None:
    """Raise OutputExistsError where the surface of scenes that are not at hand would give way to one without them."""
    missing = sorted(joined_scenes(folder) - set(ids))
    if missing:
        raise OutputExistsError(
            f"{folder / FILES[0]}: found a surface with {', '.join(missing)}, expected none but those given; "
            "give them, too, or another --out (--overwrite replaces it, and does all tasks again)"
        )


def joined_scenes(folder: Path) -> set[str]:
    """Ids of the scenes that the joined surface in a folder is made of; none where there is none of ours."""
    path = folder / SEAMS
    try:
        return set(read_json(path)["scenes"]) if path.exists() else set()
    except (SattoolsError, KeyError, TypeError):
        return set()


def check_references(runs: Sequence[tuple[Task, Configuration]]) -> None:
    """Raise OutputIsInputError where a run would replace what it or another one is scored by or aligned with.

    Args:
        runs: what is not finished yet.
    """
    folders = [Path(task.folder).resolve() for task, _ in runs]
    for task, configuration in runs:
        for path in _given(configuration, task.scene):
            within = next((folder for folder in folders if path.resolve().is_relative_to(folder)), None)
            if within is not None:
                raise OutputIsInputError(
                    f"{path}: lies in {within}, which this batch writes, expected a reference in another place"
                )


def _given(configuration: Configuration, scene: str) -> list[Path]:
    """Files that the options of a configuration name."""
    scored = configuration.resolved.get("fit", {}).get("reference")  # changes nothing that a result is known by
    return [*reference_files(configuration, None, scene), *([Path(scored)] if scored else [])]


def joined_folder(out: Path, configuration: str) -> Path:
    """Where what a configuration has made of all scenes is joined."""
    return out / JOINED / check_id(configuration, "configuration")


def document_of(scene: Scene, out: Path) -> Path:
    """Where a batch keeps the document of a scene that it was given."""
    return out / "scenes" / f"{scene.id}.json"


def is_own(scene: Scene, out: Path) -> bool:
    """Whether a scene was read from where a batch keeps its document."""
    path = document_of(scene, out)
    return scene.origin is not None and path.exists() and scene.origin.samefile(path)


__all__ = [
    "DIGESTS", "FIGURE", "check_folder", "check_references", "document_of", "is_own", "joined_folder", "joined_scenes",
]  # fmt: skip
