"""Making the products that `export` was asked for, of the maps that it has written."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

from sattools.errors import extra
from sattools.export.context import follows_prior
from sattools.export.datum import vertical_crs
from sattools.export.products.maps import Maps
from sattools.export.products.names import FILES, LIBRARIES
from sattools.progress import Progress, subprogress
from sattools.scene import Scene
from sattools.scene.jsonio import JsonObject

if TYPE_CHECKING:
    from sattools.fit.stored import StoredModel

READ = ("dsm", "dsm_std", "albedo", "validity", "probability", "prior_confidence", "ortho")


@dataclass(frozen=True)
class Wanted:
    """What is to be made.

    Attributes:
        names: keys of `FILES`.
        vertical: name of the vertical datum, see `sattools.export.datum`.
        datum: what heights are above, in words.
        interval: between contour lines [m].
        ground_width: of the widest building [m].
    """

    names: Sequence[str]
    vertical: str = "ellipsoid"
    datum: str = "WGS84 ellipsoid"
    interval: float = 1.0
    ground_width: float = 100.0


def check_libraries(names: Sequence[str]) -> None:
    """Raise SattoolsError where a library of the extra is missing, before any work is done."""
    for name in names:
        for library in LIBRARIES.get(name, ()):
            extra(library, "products")


def write_products(scene: Scene, stored: StoredModel, wanted: Wanted, progress: Progress) -> JsonObject:
    """Make products of the maps that were exported, and name them in the scene; figures for the history.

    Args:
        scene: with the maps; is changed.
        stored: the model that the maps are of.
        wanted: what to make.
        progress: told the share done.
    """
    if not wanted.names:
        return {}
    notes: JsonObject = {}
    kept = [name for name in READ if follows_prior(scene) or not name.startswith("prior_")]
    for k, name in enumerate(wanted.names):
        part = subprogress(progress, k / len(wanted.names), (k + 1) / len(wanted.names))
        part(0.0, name)
        files = {product: scene.output(href) for product, href in FILES[name].items()}
        maps = Maps.of({name: scene.path(scene.products[name]) for name in kept if name in scene.products})
        notes[name] = _MAKERS[name](_Order(scene, stored, maps, files, wanted, part))
        scene.products.update(FILES[name])
    return notes


class _Order(NamedTuple):
    """What a maker of a product is told.

    Attributes:
        scene: of the maps.
        stored: the model that they are of.
        maps: that were exported.
        files: to write, by product.
        wanted: how.
        progress: told the share done.
    """

    scene: Scene
    stored: StoredModel
    maps: Maps
    files: Mapping[str, Path]
    wanted: Wanted
    progress: Progress


def _laz(order: _Order) -> JsonObject:
    from sattools.export.products.points import write_laz

    vertical = vertical_crs(order.wanted.vertical)
    return {"points": write_laz(order.files["points"], order.maps, vertical, order.progress)}


def _ply(order: _Order) -> JsonObject:
    from sattools.export.products.points import write_ply

    return {"points": write_ply(order.files["points_ply"], order.maps, order.wanted.datum, order.progress)}


def _contours(order: _Order) -> JsonObject:
    from sattools.export.products.contours import write_contours

    interval, datum = order.wanted.interval, order.wanted.datum
    return {"lines": write_contours(order.files["contours"], order.maps, interval, order.progress, datum)}


def _dtm(order: _Order) -> JsonObject:
    from sattools.export.products.terrain import write_terrain

    vertical = vertical_crs(order.wanted.vertical), order.wanted.datum
    return write_terrain(order.files, order.maps, order.wanted.ground_width, vertical, order.progress)


def _ortho(order: _Order) -> JsonObject:
    from sattools.export.products.ortho import write_ortho

    files = order.files["ortho"], order.files["ortho_source"]
    model = replace(order.stored.head, grid=order.stored.grid)
    return dict(write_ortho(order.scene, model, order.maps, files, order.wanted.vertical, order.progress))


def _mesh(order: _Order) -> JsonObject:
    from sattools.export.products.model3d import make_model, write_glb, write_obj, write_tileset

    model = make_model(order.maps, order.wanted.datum)
    if "mesh" in order.files:
        write_glb(order.files["mesh"], model)
    elif "tileset" in order.files:
        content = Path(FILES["mesh"]["mesh"]).name
        write_tileset(order.files["tileset"], content, model, order.wanted.vertical)
    else:
        write_obj(order.files, model)
    return {"vertices": len(model.place), "faces": len(model.mesh.faces)}


_MAKERS: dict[str, Callable[[_Order], JsonObject]] = {
    "laz": _laz,
    "ply": _ply,
    "contours": _contours,
    "dtm": _dtm,
    "ortho": _ortho,
    "mesh": _mesh,
    "obj": _mesh,
    "tiles": _mesh,
}


__all__ = ["Wanted", "check_libraries", "write_products"]
