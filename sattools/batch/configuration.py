"""A configuration of a batch: the options of all commands under one name, and what they amount to."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

# what a configuration may hold, in the order of the pipe
COMMANDS = ("prep", "normalise", "prior", "fit", "export", "align", "compare")
OPTIONAL = ("normalise", "prior")  # run only where a configuration asks for them; `fit` does without or by itself


@dataclass(frozen=True)
class Configuration:
    """Options of all commands under one name.

    Attributes:
        name: of the file, or `default`.
        tables: command -> options as given.
        resolved: command -> all options, defaults included; what a result is known by.
    """

    name: str
    tables: dict[str, dict[str, Any]] = field(default_factory=dict)
    resolved: dict[str, dict[str, Any]] = field(default_factory=dict)


def options_of(configuration: Configuration, prepared: bool) -> str:
    """Hash of a configuration's options, those that it does not name included.

    Args:
        configuration: the configuration.
        prepared: with those of `prep`, for areas whose scene the batch makes.
    """
    run = [name for name in (*OPTIONAL, "align") if name in configuration.tables]
    told = [run, {name: table for name, table in configuration.resolved.items() if prepared or name != "prep"}]
    return hashlib.sha256(json.dumps(told, sort_keys=True, default=str).encode()).hexdigest()


def reference_files(configuration: Configuration, truth: Path | None, scene: str) -> Iterable[Path]:
    """Files that the options of a configuration name, which none of its commands makes.

    Args:
        configuration: the configuration.
        truth: folder of the reference, or None.
        scene: its id.
    """
    given = configuration.resolved.get("compare", {})
    for folder in {given.get("truth"), truth}:
        if folder and Path(folder).is_dir():
            yield from Path(folder).glob(f"{given.get('aoi') or scene}_*")
    for name in ("dsm", "classes", "points"):
        if given.get(name):
            yield Path(given[name])
    if to := configuration.resolved.get("align", {}).get("to"):
        yield Path(to)
    for pair in given.get("map") or ():
        yield Path(pair.partition("=")[2])


def metadata_files(configuration: Configuration) -> list[Path]:
    """Files in the folder of vendors' metadata that `normalise` is given; none where it is not there."""
    named = configuration.resolved.get("normalise", {}).get("metadata")
    folder = Path(named) if named else None
    if folder is None or not folder.is_dir():
        return []
    return sorted(path for path in folder.iterdir() if path.suffix.lower() in (".imd", ".xml", ".json"))


def toml_of(configuration: Configuration, commands: Iterable[str]) -> str:
    """The tables of some commands as they were given, as TOML."""
    import tomli_w

    return tomli_w.dumps({name: configuration.tables[name] for name in commands if name in configuration.tables})


__all__ = ["COMMANDS", "OPTIONAL", "Configuration", "metadata_files", "options_of", "reference_files", "toml_of"]
