"""What an earlier simulation has left in a scene's folder and the new one does not replace."""

from __future__ import annotations

import re
from contextlib import suppress

from sattools.errors import SattoolsError, SceneError
from sattools.scene.dependencies import current_entry
from sattools.scene.document import Scene
from sattools.scene.files import remove
from sattools.simulate.multispectral import colour_files
from sattools.simulate.views import view_files


def remove_earlier(scene: Scene, colours: bool) -> None:
    """Remove views and truth of another world, with which `prep` would mix the new ones: it reads whole folders.

    Only what the document from before says to be of a simulation goes, under the names that a simulation gives.

    Args:
        scene: the new one, complete.
        colours: whether it has multispectral images beside the panchromatic ones.
    """
    for href in sorted(_files(_earlier(scene)) - _written(scene, colours)):
        with suppress(SceneError):  # a link out of the folder: not what was written there
            remove(scene.path(href))


def _earlier(scene: Scene) -> Scene | None:
    path = scene.path("scene.json")
    if not path.is_file():
        return None
    try:
        return Scene.from_file(path)
    except SattoolsError:  # which --overwrite replaces, and of which nothing is known
        return None


def _files(earlier: Scene | None) -> set[str]:
    entry = current_entry(earlier, "simulate") if earlier else None
    if earlier is None or entry is None:
        return set()
    return _written(earlier, bool((entry.get("options") or {}).get("pan")))


def _written(scene: Scene, colours: bool) -> set[str]:
    """Hrefs of what a simulation has written, whatever later commands have added to its document."""
    names = [item.id for item in scene.items if "sattools:simulated" in item.properties]
    hrefs = {href for name in names for href in view_files(name).values()}
    hrefs |= {href for name in names for href in colour_files(name) if colours}
    own = re.compile(rf"truth/{re.escape(scene.id)}_[A-Z0-9_]+\.tif")
    return hrefs | {href for href in scene.products.values() if own.fullmatch(href)}


__all__ = ["remove_earlier"]
