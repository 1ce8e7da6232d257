"""Whether tiles go together: a tile may be fitted by a command of its own, with options of its own."""

from __future__ import annotations

import json
import logging
from collections import Counter
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from sattools.errors import SceneError, counted, some_of
from sattools.fit.options import FitOptions
from sattools.fit.stored import StoredModel
from sattools.scene import Scene
from sattools.scene.dependencies import current_entry
from sattools.settings import as_dict

log = logging.getLogger(__name__)
# what may differ between tiles and the whole: what is asked of the whole only, or found in a tile's scene already, and
# what changes no result; of a preset the values count
_OWN = ("preset", "tile", "overlap", "part", "views", "holdout", "reference", "device", "resume", "budget")


def check_maps_alike(models: Mapping[str, StoredModel], path: Callable[[str], Path]) -> None:
    """Refuse tiles whose maps cannot be joined cell by cell.

    Surfaces of other cells are not resampled: they were matched and smoothed otherwise, and would show as such.

    Args:
        models: of the tiles, by name.
        path: of a tile's model.

    Raises:
        SceneError: a tile of other cells or bands than most.
    """
    kinds = {name: (model.grid.cell_size, model.bands) for name, model in models.items()}
    if not kinds:
        return
    ((cell, bands), _), *others = Counter(kinds.values()).most_common()
    if not others:
        return
    name = next(name for name, kind in kinds.items() if kind != (cell, bands))
    own, own_bands = kinds[name]
    found, expected = (f"{own:g} m", f"{cell:g} m") if own != cell else (counted(own_bands, "bands"), f"{bands}")
    raise SceneError(
        f"{path(name)}: found a tile of {'cells of ' if own != cell else ''}{found}, expected {expected} as in the "
        f"others; fit it again (--overwrite) with their options"
    )


def tell_other_options(options: FitOptions, scenes: Mapping[str, Scene]) -> list[str]:
    """Notes of options that tiles were fitted with in place of those that the history of the whole names.

    Args:
        options: of the fit of the whole.
        scenes: of the tiles, by name; one without a history was fitted with the whole's options, or from Python.
    """
    wanted = _settings(options)
    found: dict[tuple[str, str], list[str]] = {}
    for name, scene in scenes.items():
        given = (current_entry(scene, "fit") or {}).get("options", {})
        for option, value in given.items():
            if option in wanted and option not in _OWN and value != wanted[option]:
                found.setdefault((option, json.dumps(value)), []).append(name)
    notes = []
    for (option, value), names in found.items():
        notes.append(
            f"{'tile' if len(names) == 1 else 'tiles'} {some_of(names)}: found a fit with --{option.replace('_', '-')} "
            f"{_shown(json.loads(value))}, expected {_shown(wanted[option])} as this fit is noted with"
        )
        log.warning(notes[-1])
    return notes


def _settings(options: FitOptions) -> dict[str, Any]:
    """As a history has them."""
    plain: dict[str, Any] = json.loads(json.dumps(as_dict(options)))
    return plain


def _shown(value: Any) -> str:
    if value is None or value == []:
        return "at its default"
    return " ".join(map(str, value)) if isinstance(value, list) else str(value)


__all__ = ["check_maps_alike", "tell_other_options"]
