"""What an interrupted matching in tiles leaves, so that another run can go on with it."""

from __future__ import annotations

import hashlib
import io
import json
import logging
import re
import zipfile
from contextlib import suppress
from dataclasses import asdict, dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from sattools import __version__
from sattools.errors import SattoolsError, counted
from sattools.prior.cells import grids
from sattools.prior.matched import Matched
from sattools.prior.options import PriorOptions
from sattools.scene import Item, Scene
from sattools.scene.dependencies import left_behind
from sattools.scene.files import digest, immediately, remove_orphans, write_bytes
from sattools.scene.tiles import Tile
from sattools.views import used_assets

log = logging.getLogger(__name__)
TILES = "prior/tiles"  # below a scene's root, a file a tile
_NAME = re.compile(r"r\d+c\d+\.npz")
_MAPS = ("height", "confidence", "water")  # of a match, which are no figures
# of an option, what does not change a tile
_HOUSEKEEPING = ("water", "per_image")


@dataclass(frozen=True)
class MatchedTile:
    """What is kept of a tile.

    Attributes:
        height: ``[h, w]`` [m].
        confidence: ``[h, w]`` in [0, 1].
        figures: of the match, see `Matched`; None where nothing was found there.
        seconds: that it took [s].
    """

    height: np.ndarray
    confidence: np.ndarray
    figures: dict[str, Any] | None
    seconds: float = 0.0

    @classmethod
    def of(cls, found: Matched) -> MatchedTile:
        """A tile that was matched."""
        return cls(found.height, found.confidence, {k: v for k, v in vars(found).items() if k not in _MAPS})

    def match(self) -> Matched | None:
        """What matching the tile has found, None where that was nothing."""
        if self.figures is None:
            return None
        pairs = [(first, second) for first, second in self.figures["pairs"]]
        name, bent = self.figures["bent"]
        return Matched(self.height, self.confidence, **{**self.figures, "pairs": pairs, "bent": (name, bent)})


class KeptTiles:
    """Tiles that runs of one matching have finished, each in a file of its own.

    Args:
        scene: of the images.
        items: the images.
        options: of the matching.
        overwrite: the user begins anew, and what is there may be replaced.

    Raises:
        SceneError: the folder of the tiles lies outside the scene's root.
    """

    def __init__(self, scene: Scene, items: list[Item], options: PriorOptions, overwrite: bool) -> None:
        self.scene, self.items, self.options = scene, items, options
        self.may_replace = overwrite
        self.earlier_s = 0.0  # of those that were read
        if not overwrite and (begun := self._known()):
            self.may_replace = any(about["overwrite"] for about in begun)

    @cached_property
    def key(self) -> str | None:
        """Hash of everything that the tiles depend on, but for their size; None where images may change unseen."""
        scene = self.scene
        paths = [scene.path(item.assets[name].href) for item in self.items for name in used_assets(item.assets)]
        digests = [digest(path) for path in paths]
        if None in digests:  # on another machine
            return None
        options = {name: value for name, value in asdict(self.options).items() if name not in _HOUSEKEEPING}
        fine = grids(scene, self.items, self.options)[1]
        what: list[Any] = [__version__, options, fine.to_dict(), scene.surroundings_m, scene.require_height_range()]
        what += [digests, [_as_given(item) for item in self.items]]
        return hashlib.sha256(json.dumps(what, sort_keys=True, default=str).encode()).hexdigest()

    def edge(self) -> int | None:
        """Cells along the edge of the tiles that were begun, None where none were: they go on as they are."""
        return next((int(about["edge"]) for about in self._known()), None)

    def count(self, edge: int) -> int:
        """How many there are with that edge."""
        return sum(about["edge"] == edge for about in self._known())

    def read(self, tile: Tile, edge: int) -> MatchedTile | None:
        """A tile that an earlier run has finished; None where it is to be matched.

        Args:
            tile: which one.
            edge: about so many cells along that of all tiles, without their overlap.
        """
        path = self._path(tile)
        about = _about(path) or {}
        if about.get("key") != self.key or self.key is None or about.get("edge") != edge:
            return None
        try:
            with np.load(path, allow_pickle=False) as file:
                found = MatchedTile(file["height"], file["confidence"], about["figures"], float(about["seconds"]))
        except (OSError, KeyError, ValueError, EOFError, zipfile.BadZipFile) as error:
            log.warning("%s: cannot be read (%s), the tile is matched anew", path, " ".join(str(error).split()))
            return None
        if not found.height.shape == found.confidence.shape == tile.grid.shape:
            return None
        self.earlier_s += found.seconds
        return found

    def keep(self, tile: Tile, edge: int, found: MatchedTile) -> None:
        """Write a finished tile at once.

        Args:
            tile: which one.
            edge: as of `read`.
            found: what is kept of it.

        Raises:
            SattoolsError: it cannot be written.
        """
        if self.key is None:
            return
        about = {"key": self.key, "edge": edge, "overwrite": self.may_replace}
        about |= {"figures": found.figures, "seconds": round(found.seconds, 3)}
        text = np.frombuffer(json.dumps(about).encode(), np.uint8)
        stream = io.BytesIO()
        np.savez(stream, about=text, height=found.height, confidence=found.confidence)
        with immediately():
            write_bytes(self.scene.output(f"{TILES}/{tile.name}.npz"), stream.getbuffer())

    def _known(self) -> list[dict[str, Any]]:
        """What the tiles of this matching say of themselves."""
        abouts = [about for path in kept_files(self.scene) if (about := _about(path))]
        # the images are read for the key, if there is anything that could have it
        return [about for about in abouts if about["key"] == self.key] if abouts else []

    def _path(self, tile: Tile) -> Path:
        return self.scene.path(f"{TILES}/{tile.name}.npz")


def kept_files(scene: Scene) -> list[Path]:
    """Files of tiles that an interrupted matching has left, of whatever options; sorted.

    Raises:
        SceneError: their folder lies outside the scene's root.
    """
    scene.path(TILES)
    return kept_in(scene.root)


def kept_in(root: Path) -> list[Path]:
    """`kept_files` of the scene whose folder that is."""
    folder = root / TILES
    return sorted(path for path in folder.iterdir() if _NAME.fullmatch(path.name)) if folder.is_dir() else []


def remove_tiles(scene: Scene) -> None:
    """Remove tiles that an interrupted matching has left; files of other origin stay beside them.

    Raises:
        SceneError: their folder lies outside the scene's root.
        SattoolsError: a file cannot be removed.
    """
    folder = scene.path(TILES)
    if not folder.is_dir():
        return
    remove_orphans(folder)
    for path in kept_files(scene):
        try:
            path.unlink(missing_ok=True)
        except OSError as error:
            raise SattoolsError(f"{path}: cannot be removed ({error.strerror})") from error
    with suppress(OSError):  # something else is in it
        folder.rmdir()


def how_to_go_on(scene: Scene) -> str | None:
    """What can be done with the tiles that an interruption leaves, in words; None where it leaves none.

    Args:
        scene: that was matched.
    """
    count = len(kept_files(scene))
    if not count:
        return None
    return (
        f"interrupted; kept {counted(count, 'tiles')}: `sattools prior` with the same options goes on with them, with "
        "--overwrite it begins anew"
    )


def _as_given(item: Item) -> list[Any]:
    """What the document says of an image, without what was made of it and goes as soon as the matching begins."""
    assets, properties = left_behind("prior")
    given = {name: value for name, value in item.properties.items() if name not in properties}
    return [item.id, given, {name: asset.extra for name, asset in item.assets.items() if name not in assets}]


def _about(path: Path) -> dict[str, Any] | None:
    """What a tile's file says of itself; None where there is none, or none of this program."""
    try:
        with np.load(path, allow_pickle=False) as file:
            about = json.loads(file["about"].tobytes())
        return about if about.keys() >= {"key", "edge", "overwrite", "figures", "seconds"} else None
    except (OSError, KeyError, ValueError, EOFError, AttributeError, zipfile.BadZipFile):
        return None


__all__ = ["TILES", "KeptTiles", "MatchedTile", "how_to_go_on", "kept_files", "kept_in", "remove_tiles"]
