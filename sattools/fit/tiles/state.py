"""What is noted of an area that is fitted in tiles, in `fit/tiles/tiles.json`, for the run that goes on with it."""

from __future__ import annotations

import json
from contextlib import suppress
from pathlib import Path

from sattools.errors import InputError, SceneError
from sattools.scene.files import immediately, write_text
from sattools.scene.jsonio import JsonObject, read_json
from sattools.scene.schema import Flag, Items, Maybe, Number, Table, Text

STATE = "fit/tiles/tiles.json"
COARSE = "coarse"  # the part that is the whole, fitted coarsely
_STATE = Table(
    {
        "key": Text(),
        "tile": Number(0),
        "tiles": Maybe(Items(Text())),
        "pilots": Maybe(Items(Text())),
        "notes": Items(Text()),
        "seconds": Number(0),
        "over": Flag(),
    },
    ("key", "tiles", "notes"),
)


def read_state(root: Path) -> JsonObject | None:
    """What is noted below a scene's root, None where nothing is.

    Raises:
        SceneError: a damaged list of tiles.
    """
    path = root / STATE
    try:
        state = read_json(path) if path.exists() else None
        if state is not None:
            _STATE.check(state, str(path))
        return state
    except InputError as error:
        raise SceneError(f"{error} (a list of tiles of `fit --tile`)") from error


def write_state(path: Path, state: JsonObject) -> None:
    """Note it.

    Args:
        path: of the file.
        state: what is noted.
    """
    with immediately():
        write_text(path, json.dumps(state, indent=1) + "\n")


def begun(root: Path) -> JsonObject | None:
    """What is noted of tiles that are not joined, if no fit has ended since they were begun.

    Raises:
        SceneError: a damaged list of tiles.
    """
    state = read_state(root)
    return state if state and not state.get("over") else None


def end(root: Path) -> None:
    """A fit has ended: what tiles there still are is no fit to go on with."""
    with suppress(SceneError):  # damaged, it says nothing that anybody would go on with
        state = begun(root)
        if state is not None:
            write_state(root / STATE, {**state, "over": True})


__all__ = ["COARSE", "STATE", "begun", "end", "read_state", "write_state"]
