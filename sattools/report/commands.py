"""The command lines that made a scene, from its history."""

from __future__ import annotations

import importlib
import shlex
from collections.abc import Mapping, Sequence
from typing import Any

from sattools.scene.dependencies import STAGES, in_force
from sattools.scene.jsonio import JsonObject
from sattools.settings import specs

OPTIONS = {
    "simulate": ("sattools.simulate.options", "SimulateOptions"),
    "prep": ("sattools.prep.options", "PrepOptions"),
    "normalise": ("sattools.radiometry.options", "NormaliseOptions"),
    "prior": ("sattools.prior.options", "PriorOptions"),
    "fit": ("sattools.fit.options", "FitOptions"),
    "export": ("sattools.export.options", "ExportOptions"),
    "align": ("sattools.align.options", "AlignOptions"),
    "compare": ("sattools.compare.options", "CompareOptions"),
}


def command_line(command: str, options: Mapping[str, Any]) -> str:
    """`sattools COMMAND` with the options that are not the defaults, quoted for a shell."""
    words = ["sattools", command]
    if command == "prep":
        words.append("IMAGE...")
    if command in OPTIONS:
        module, name = OPTIONS[command]
        defaults = {spec.name: spec.default for spec in specs(getattr(importlib.import_module(module), name))}
    else:
        defaults = {}
    for name, value in options.items():
        if value is None or (name in defaults and _same(value, defaults[name])):
            continue
        flag = "--" + name.replace("_", "-")
        if isinstance(value, bool):
            words.append(flag if value else "--no-" + flag[2:])
        elif isinstance(value, list) and (name == "bounds" or isinstance(defaults.get(name), type(None))):
            words += [flag, *map(str, value)] if value else []
        elif isinstance(value, list):
            for entry in value:
                words += [flag, str(entry)]
        else:
            words += [flag, str(value)]
    return " ".join(word if word == "IMAGE..." else shlex.quote(word) for word in words)


def pipeline(history: Sequence[JsonObject]) -> str:
    """The command lines of a history as one pipe that leads to the same scene: without what was done in vain."""
    lines: list[str] = []
    done: set[str] = set()
    for entry in in_force(history):
        command = entry["command"]
        again = " --overwrite" if command in done and command in STAGES else ""  # not `align`, with a folder each time
        lines.append(command_line(command, entry.get("options", {})) + again)
        done.add(command)
    return " |\n    ".join(lines)


def _same(value: Any, default: Any) -> bool:
    if isinstance(default, tuple | list):
        return list(value) == list(default)
    return bool(value == default)


__all__ = ["command_line", "pipeline"]
