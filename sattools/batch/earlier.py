"""What earlier calls have left in a batch's folder, and no longer goes with what is done now."""

from __future__ import annotations

import logging
import tomllib
from collections.abc import Collection, Sequence
from contextlib import suppress
from pathlib import Path

from sattools.batch.configuration import COMMANDS, Configuration, options_of, toml_of
from sattools.batch.gate import joined_folder, joined_scenes
from sattools.batch.join import FILES
from sattools.batch.table import Row, earlier_rows
from sattools.errors import InputError
from sattools.scene.jsonio import read_json, read_toml

log = logging.getLogger(__name__)


def comparable_rows(
    out: Path, pairs: Collection[tuple[str, str]], configurations: Sequence[Configuration]
) -> list[Row]:
    """Rows of earlier calls; those of other options under a name that this call has are told and left out.

    Args:
        out: folder of the batch.
        pairs: (scene, configuration) of this call.
        configurations: of this call.
    """
    now = {c.name: _Options(c) for c in configurations}
    kept: list[Row] = []
    others: dict[str, list[str]] = {}
    for row in earlier_rows(out, pairs):
        scene, name = row["scene"], row["configuration"]
        if name in now and not now[name].are_of(out / "runs" / name / scene):
            others.setdefault(name, []).append(scene)
        else:
            kept.append(row)
    for name, scenes in others.items():
        log.warning(
            "%s: has other options than in an earlier call, whose rows are left out of the table: give %s again, too",
            name, ", ".join(scenes),
        )  # fmt: skip
    if kept:
        log.info("the table keeps %d rows of earlier calls", len(kept))
    return kept


class _Options:
    """The options of a configuration.

    Args:
        configuration: the configuration.
    """

    def __init__(self, configuration: Configuration) -> None:
        # `prep` counts where the batch has made the scene, which the folder of a run knows
        self._hashes = {options_of(configuration, prepared) for prepared in (False, True)}
        self._tables = tomllib.loads(toml_of(configuration, COMMANDS))

    def are_of(self, folder: Path) -> bool:
        """Whether a run had them, by its folder; True where that does not say."""
        with suppress(InputError):  # a run that failed, whose tables must do
            if known := read_json(folder / "task.json").get("options"):
                return str(known) in self._hashes
        try:
            tables = read_toml(folder / "config.toml")
        except InputError:
            return True
        return all(tables.get(name) == self._tables.get(name) for name in COMMANDS if name != "prep")  # older: no prep


def tell_of_joined(out: Path, anew: Collection[tuple[str, str]], configurations: Sequence[Configuration]) -> None:
    """Say which joined surfaces are not of what has been done anew.

    Args:
        out: folder of the batch.
        anew: (scene, configuration).
        configurations: of this call.
    """
    for c in configurations:
        folder = joined_folder(out, c.name)
        if changed := sorted(joined_scenes(folder) & {scene for scene, name in anew if name == c.name}):
            log.warning(
                "%s: is still of what %s had before this call; --join makes it anew",
                folder / FILES[0], ", ".join(changed),
            )  # fmt: skip


__all__ = ["comparable_rows", "tell_of_joined"]
