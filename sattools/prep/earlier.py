"""What an earlier `prep` has left in a scene's folder, of images that the new scene does not have."""

from __future__ import annotations

from collections.abc import Iterable
from contextlib import suppress
from pathlib import Path

from sattools.errors import SattoolsError, SceneError
from sattools.prep.colours import hrefs
from sattools.prep.outputs import clouds_href
from sattools.scene import Scene
from sattools.scene.dependencies import SOURCES, files_of


def left_by_earlier(scene: Scene) -> list[Path]:
    """Images, cameras and masks that the document in the scene's folder names and that `prep` has written there.

    Nothing where that document is not there, cannot be read, is of another folder, or was not made by `prep`. Files
    that lie elsewhere, also by a link, and files that `prep` does not name so are not among them.

    Args:
        scene: the new one, whose document is not written yet.
    """
    try:
        earlier = Scene.from_file(scene.root / "scene.json")
    except SattoolsError:
        return []
    root = scene.root.resolve()
    made_by = next((e.get("command") for e in reversed(earlier.history) if e.get("command") in SOURCES), None)
    if earlier.root.resolve() != root or made_by != "prep":
        return []
    found = []
    for item in earlier.items:
        own = {f"images/{item.id}.tif", f"rpc/{item.id}_RPC.TXT", clouds_href(item.id), *hrefs([item.id])}
        for href in sorted({asset.href for asset in item.assets.values()} & own):
            with suppress(SceneError):
                found.append(earlier.path(href))
    return [path for path in found if path.is_file() and path.resolve().is_relative_to(root)]


def remove_left(left: Iterable[Path], scene: Scene, inputs: Iterable[Path]) -> None:
    """Remove files that an earlier `prep` has left, but for those that the scene names and those that were read.

    Args:
        left: see `left_by_earlier`.
        scene: the new one, complete.
        inputs: files that the user has given.

    Raises:
        SattoolsError: a file cannot be removed.
    """
    # not by name: on disks without case two names may be one file
    needed = {_identity(path) for path in (*files_of(scene), *inputs)}
    for path in left:
        if _identity(path) in needed:
            continue
        try:
            path.unlink(missing_ok=True)
        except OSError as error:
            raise SattoolsError(f"{path}: cannot be removed ({error.strerror})") from error


def _identity(path: Path) -> tuple[int, int] | str:
    """What is one for all names of a file; the name of one that is not there."""
    try:
        found = path.stat()
    except (OSError, ValueError):
        return str(path)
    return found.st_dev, found.st_ino


__all__ = ["left_by_earlier", "remove_left"]
