"""The stage `export`: a fitted model becomes georeferenced files."""

from __future__ import annotations

import logging
from collections.abc import Iterable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from sattools.errors import InputError, MissingProductError, SceneError
from sattools.export.blocks import Block, Surroundings, blocks
from sattools.export.context import RELIT, Exported, shadow_suns, view_href
from sattools.export.datum import check_datum, check_grid
from sattools.export.options import ExportOptions
from sattools.export.products.collection import PRODUCTS as CATALOGUE
from sattools.export.products.collection import write_collection
from sattools.export.products.names import FILES
from sattools.export.products.names import hrefs as product_hrefs
from sattools.export.products.plan import Wanted, check_libraries, write_products
from sattools.export.surface_files import (
    ALBEDO,
    DSM,
    ERROR95,
    PICTURE,
    PROBABILITY,
    STD,
    VALIDITY,
    SurfaceFiles,
    heights_of_start,
    with_water,
)
from sattools.export.validity import Witnesses
from sattools.fit.stored import StoredModel
from sattools.progress import Progress, silent, subprogress
from sattools.render.around import read_around
from sattools.scene import Scene
from sattools.scene.area import wanted_cells
from sattools.scene.dependencies import MADE, STAGES, begin, check_current, may_begin, names_of, record
from sattools.scene.jsonio import JsonObject
from sattools.scene.stored import new_map
from sattools.scene.validity import CLASSES, FILLED, LEVELLED, MEASURED, UNSEEN, UNWANTED

if TYPE_CHECKING:  # PyTorch, whose import takes a second, is for reflectance models, networks and rendering alone
    from sattools.export.parts import Parts, WholeModel
    from sattools.fit.model import FittedModel

log = logging.getLogger(__name__)
EMPTY = "no two images show any of the surface, so every map is empty (0 from an image's edge inwards is no pixel)"


def export(scene: Scene, options: ExportOptions, progress: Progress = silent, overwrite: bool = True) -> JsonObject:
    """Write the DSM, its picture, where it is valid, the albedo and a shadow mask per image; adds products and assets.

    Ground that fewer than two images reach is no-data in all of them, unless `options.fill` asks otherwise, and so is
    ground outside the area that `prep` was asked for. Maps of
    large areas are read and written block by block.

    Args:
        scene: fitted; gets the products and assets.
        options: of the export.
        progress: told the share done.
        overwrite: replace files that are there.

    Returns:
        Figures for the history.

    Raises:
        SceneError: the scene has no model.
        StaleError: the model was made from something else than the scene holds now.
        InputError: the model file is damaged.
    """
    stored, model = _opened(scene, options)
    views = bool(options.view or options.sun is not None)
    outputs = _outputs(scene, options, stored, model)
    begin(scene, "export", outputs, overwrite)
    progress(0.05, "what the images show")
    witnesses = Witnesses(scene, stored.about.items)
    if not witnesses.known:
        log.warning("scene %s: images or cameras of the fit are missing: nobody knows what they show", scene.id)
    around = read_around(scene)
    surface = Surroundings(stored.grid, lambda rows, cols: stored.maps(rows, cols).height, around)
    pieces = blocks(stored.grid, model is not None)
    counts = np.zeros(len(CLASSES), np.int64)
    last: Exported | None = None
    shown = new_map(stored.grid.shape, np.uint8, scene.root)
    with SurfaceFiles(scene, stored, options.vertical, witnesses.known) as files:
        for k, block in enumerate(pieces):
            progress(0.1 + 0.5 * k / len(pieces), "DSM, albedo, shadows" + (f", block {k + 1}" if k else ""))
            exported, found = _write_block(scene, stored, block, (surface, witnesses, files), options.fill)
            counts += found
            last = exported
            if views:
                shown[block.rows, block.cols] = exported.valid
    part = subprogress(progress, 0.6, 0.7)
    if model is not None and last is not None:
        _views(scene, replace(_reflectance(last, model, options, part), beyond=around), options, part)
    elif views:
        from sattools.export.parts import ModelInParts

        _views(scene, ModelInParts(stored, surface, shown), options, part)
    asked = Wanted(options.wanted, options.vertical, files.datum, options.contours or 1.0, options.ground_width)
    products = write_products(scene, stored, asked, subprogress(progress, 0.7, 1.0))
    write_collection(scene, stored.grid)
    progress(1.0, "exported")
    kinds = {"measured": MEASURED, "filled": FILLED, "unseen": UNSEEN}
    if counts[UNWANTED]:
        kinds["outside"] = UNWANTED
    if counts[LEVELLED]:
        kinds["water"] = LEVELLED
    shares = {name: round(float(counts[kind] / max(counts.sum(), 1)), 4) for name, kind in kinds.items()}
    fractions = shares if witnesses.known else None
    empty = witnesses.known and not counts[[MEASURED, FILLED, LEVELLED]].any() and not options.fill
    made = record(scene, "export")
    notes = _notes(scene, stored, bool(empty), _left(scene, outputs, made["export"]["outputs"]["dsm"]))
    return {
        "vertical_datum": files.datum, "validity": fractions, "products": products, "notes": notes, MADE: made,
    }  # fmt: skip


def check_start(scene: Scene, options: ExportOptions, overwrite: bool = True, inputs: Iterable[Path] = ()) -> list[str]:
    """What `export` looks at before its work, for a dry run; arguments and errors as of `export`.

    Args:
        scene: is changed.
        options: of the export.
        overwrite: replace files that are there.
        inputs: more files that must not be written onto.

    Returns:
        Hrefs of what will be written.
    """
    outputs = _outputs(scene, options, *_opened(scene, options))
    may_begin(scene, "export", outputs, overwrite, inputs)
    return outputs


def check_options(options: ExportOptions) -> None:
    """What `check_start` can tell without a scene; SattoolsError where a library or the grid of a geoid is missing."""
    check_libraries(options.wanted)
    check_grid(options.vertical)


def _opened(scene: Scene, options: ExportOptions) -> tuple[StoredModel, FittedModel | None]:
    """The scene's model, as a whole, too, where that is needed; raises what is in the way of exporting it."""
    check_libraries(options.wanted)
    stored = _open_model(scene, options)
    check_datum(stored.grid, options.vertical)
    return stored, stored.load() if _needs_whole(options, stored) else None


def _write_block(
    scene: Scene, stored: StoredModel, block: Block, what: tuple[Surroundings, Witnesses, SurfaceFiles], fill: bool
) -> tuple[Exported, NDArray[np.int64]]:
    """Where a block, whose maps have been written, may be shown, and its cells by kinds of validity ``[5]``."""
    surface, witnesses, files = what
    maps = stored.maps(block.rows, block.cols)
    known = np.isfinite(maps.height)
    validity = with_water(scene, witnesses.validity(block, surface), block.grid) if witnesses.known else None
    valid = known if fill or validity is None else validity != UNSEEN
    wanted = wanted_cells(scene, block.grid)
    if wanted is not None:
        valid = valid & wanted
        validity = None if validity is None else np.where(wanted, validity, UNWANTED).astype(np.uint8)
    exported = Exported(scene, stored.about, valid)
    files.write(block, exported, maps, surface, validity, witnesses.saturated(block, surface))
    kinds = len(CLASSES)
    counts = np.zeros(kinds, np.int64) if validity is None else np.bincount(validity.ravel(), minlength=kinds)
    return exported, counts


def _open_model(scene: Scene, options: ExportOptions) -> StoredModel:
    """The scene's model, checked to be of what the scene holds now."""
    unknown = set(options.view) - {item.id for item in scene.items}
    if unknown:
        known = ", ".join(item.id for item in scene.items)[:200]
        raise SceneError(f"scene {scene.id}: found no item {sorted(unknown)[0]!r}, expected --view with one of {known}")
    if "model" not in scene.products:  # asked last: on a pipe of dry runs it would be there
        expected = "expected one made by `sattools fit`"
        raise MissingProductError(f"scene {scene.id}: found no product 'model', {expected}")
    stored = StoredModel.open(scene.path(scene.products["model"]))
    check_current(scene, "fit")
    return stored


def _outputs(scene: Scene, options: ExportOptions, stored: StoredModel, model: FittedModel | None) -> list[str]:
    """All files that will be written."""
    ids = {item.id for item in scene.items}
    hrefs = [DSM, STD, ERROR95, ALBEDO, PICTURE, VALIDITY, PROBABILITY, *CATALOGUE.values()]
    hrefs += [view_href("shadow", name) for name, _ in shadow_suns(stored.about) if name in ids]
    hrefs += [view_href(m, n) for m in stored.image_maps for n in stored.about.items if n in ids]
    hrefs += [view_href(asset, name) for asset in ("rendered", "rendered_height") for name in options.view]
    hrefs += [view_href("rendered_scored", name) for name in options.view if name not in stored.about.items]
    if model is not None:
        from sattools.export.material import material_names

        hrefs += [f"export/{name}.tif" for name in material_names(model)]
    if options.sun is not None:
        hrefs += [RELIT, *(view_href("relit", name) for name in options.view)]
    return hrefs + product_hrefs(options.wanted)


def _notes(scene: Scene, stored: StoredModel, empty: bool, left: Sequence[str]) -> list[str]:
    """What there is to say of an export, which is told, too."""
    notes = []
    if words := heights_of_start(stored.about):
        notes.append(f"heights: {words}")
    if empty:
        notes.append(EMPTY)
    if left:
        notes.append(f"{', '.join(left)}: left by an earlier export, not of this surface")
    for text in notes:
        log.warning("scene %s: %s", scene.id, text)
    return notes


def _left(scene: Scene, outputs: Sequence[str], surface: str | None) -> list[str]:
    """Files beside the outputs that look like more of them, but are not known to be of the same surface.

    Args:
        scene: that was exported.
        outputs: hrefs of what was written.
        surface: digest of its heights.
    """
    names = {f"export/{name}.tif": name for name in names_of(STAGES["export"])}
    names |= {href: name for files in FILES.values() for name, href in files.items()}
    made: dict[str, str | None] = {}  # product -> digest of the heights that it was exported with
    for entry in scene.history:
        if entry.get("command") == "export":
            known = (entry.get(MADE) or {}).get("export", {}).get("outputs", {})
            made |= dict.fromkeys(known, known.get("dsm"))
    others = [href for href, name in names.items() if href not in outputs and made.get(name) != surface]
    return sorted(href for href in others if scene.path(href).is_file())


def _needs_whole(options: ExportOptions, stored: StoredModel) -> bool:
    """Maps of reflectance are made of the whole, and networks know no parts."""
    shown = bool(options.view or options.sun is not None)
    return stored.about.brdf != "lambert" or (stored.about.field != "surface" and shown)


def _reflectance(exported: Exported, model: FittedModel, options: ExportOptions, progress: Progress) -> WholeModel:
    """The model as a whole, whose maps of reflectance have been written if it has some."""
    from sattools.export.material import material_maps, network_maps, write_material
    from sattools.export.parts import WholeModel
    from sattools.fit.materials.scene import ReflectiveScene

    try:
        surface = model.surface()
    except (KeyError, TypeError, ValueError, RuntimeError) as error:
        path, reason = exported.scene.products["model"], " ".join(str(error).split())
        raise InputError(f"{path}: found a model without what its kind needs ({reason})") from error
    if isinstance(surface, ReflectiveScene):
        progress(0.0, "reflectance")
        write_material(exported, material_maps(surface, model.extra), options.undetermined == "prior")
    elif model.brdf != "lambert":
        write_material(exported, network_maps(model), options.undetermined == "prior")
    return WholeModel(model, surface, exported.valid)


def _views(scene: Scene, parts: Parts, options: ExportOptions, progress: Progress) -> None:
    """The images asked for, the scene under another sun."""
    from sattools.export.novel import Shown, write_relit, write_view

    shown = Shown(scene, parts)
    for k, name in enumerate(options.view):
        progress((k + 1) / (len(options.view) + 2), f"rendering {name}")
        write_view(shown, name, None)
    if options.sun is not None:
        write_relit(shown, options.sun)
        for name in options.view:
            write_view(shown, name, options.sun)


__all__ = ["check_options", "check_start", "export"]
