"""Making the products that `export` was asked for, of the maps that it has written."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from sattools.errors import extra
from sattools.export.datum import vertical_crs
from sattools.export.products.maps import Maps
from sattools.export.products.names import FILES, LIBRARIES
from sattools.progress import Progress, subprogress
from sattools.scene import Scene

READ = ("dsm", "dsm_std", "albedo", "validity", "prior_confidence")


@dataclass(frozen=True)
class Wanted:
    """What is to be made.

    Attributes:
        names: keys of `FILES`.
        vertical: name of the vertical datum, see `sattools.export.datum`.
        datum: what heights are above, in words.
        interval: between contour lines [m].
    """

    names: Sequence[str]
    vertical: str = "ellipsoid"
    datum: str = "WGS84 ellipsoid"
    interval: float = 1.0


def check_libraries(names: Sequence[str]) -> None:
    """Raise SattoolsError where a library of the extra is missing, before any work is done."""
    for name in names:
        for library in LIBRARIES.get(name, ()):
            extra(library, "products")


def write_products(scene: Scene, wanted: Wanted, progress: Progress) -> None:
    """Make products of the maps that were exported, and name them in the scene.

    Args:
        scene: with the maps; is changed.
        wanted: what to make.
        progress: told the share done.
    """
    if not wanted.names:
        return
    maps = Maps.of({name: scene.path(scene.products[name]) for name in READ if name in scene.products})
    for k, name in enumerate(wanted.names):
        part = subprogress(progress, k / len(wanted.names), (k + 1) / len(wanted.names))
        part(0.0, name)
        files = {product: scene.output(href) for product, href in FILES[name].items()}
        _write(name, files, maps, wanted, part)
        scene.products.update(FILES[name])


def _write(name: str, files: dict[str, Path], maps: Maps, wanted: Wanted, progress: Progress) -> None:
    from sattools.export.products import contours, points

    if name == "laz":
        points.write_laz(files["points"], maps, vertical_crs(wanted.vertical), progress)
    elif name == "ply":
        points.write_ply(files["points_ply"], maps, wanted.datum, progress)
    elif name == "contours":
        contours.write_contours(files["contours"], maps, wanted.interval, progress)


__all__ = ["Wanted", "check_libraries", "write_products"]
