"""The stage `export`: a fitted model becomes georeferenced files."""

from __future__ import annotations

import logging
from typing import TYPE_CHECKING

import numpy as np

from sattools.errors import InputError, SceneError
from sattools.export.context import Exported, shadow_suns
from sattools.export.datum import to_datum, vertical_crs
from sattools.export.hillshade import write_picture
from sattools.export.options import ExportOptions
from sattools.export.products.collection import PRODUCTS as CATALOGUE
from sattools.export.products.collection import write_collection
from sattools.export.products.names import hrefs as product_hrefs
from sattools.export.products.plan import Wanted, check_libraries, write_products
from sattools.export.validity import FILLED, MEANING, MEASURED, UNSEEN, validity_of
from sattools.progress import Progress, silent, subprogress
from sattools.scene import Asset, Grid, Scene
from sattools.scene.dependencies import MADE, begin, check_current, record
from sattools.scene.jsonio import JsonObject
from sattools.scene.raster import write_cog

if TYPE_CHECKING:
    from sattools.fit.model import FittedModel

log = logging.getLogger(__name__)
# what the model may hold per image
IMAGE_MAPS = {"s_net": "learned sun visibility, 1 = lit", "tau": "share of the light that transient objects leave"}
DSM, STD, ALBEDO, PICTURE = "export/dsm.tif", "export/dsm_std.tif", "export/albedo.tif", "export/dsm.png"
VALIDITY = "export/validity.tif"


def export(scene: Scene, options: ExportOptions, progress: Progress = silent, overwrite: bool = True) -> JsonObject:
    """Write the DSM, its picture, where it is valid, the albedo and a shadow mask per image; adds products and assets.

    Ground that fewer than two images reach is no-data in all of them, unless `options.fill` asks otherwise.

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
    wanted = options.wanted
    check_libraries(wanted)
    model = _read_model(scene, options)
    height = model.height.numpy()
    begin(scene, "export", _outputs(scene, options, model), overwrite)
    progress(0.05, "what the images show")
    validity = validity_of(scene, model.items, model.grid, height)
    if validity is None:
        log.warning("scene %s: images or cameras of the fit are missing: nobody knows what they show", scene.id)
    exported = Exported(scene, model, np.isfinite(height) if options.fill or validity is None else validity != UNSEEN)
    progress(0.1, "DSM")
    datum = _write_heights(exported, options.vertical)
    fractions = None if validity is None else _write_validity(scene, validity, model.grid)
    progress(0.3, "albedo")
    _write_albedo(exported)
    scene.products.update(dsm=DSM, dsm_std=STD, albedo=ALBEDO, dsm_picture=PICTURE)
    if model.shadow != "none":
        _shadows(exported, progress)
    for name, description in IMAGE_MAPS.items():
        if name in model.image_maps():
            _image_maps(exported, name, description)
    if _needs_surface(options, model):
        _views(exported, options, subprogress(progress, 0.6, 0.7))
    products = Wanted(wanted, options.vertical, datum, options.contours or 1.0)
    made = write_products(scene, model, products, subprogress(progress, 0.7, 1.0))
    write_collection(scene, model.grid)
    progress(1.0, "exported")
    return {"vertical_datum": datum, "validity": fractions, "products": made, MADE: record(scene, "export")}


def _read_model(scene: Scene, options: ExportOptions) -> FittedModel:
    """The scene's model, checked to be of what the scene holds now."""
    from sattools.fit.model import FittedModel

    if "model" not in scene.products:
        raise SceneError(f"scene {scene.id}: found no product 'model', expected one made by `sattools fit`")
    unknown = set(options.view) - {item.id for item in scene.items}
    if unknown:
        raise SceneError(f"scene {scene.id}: found no item {sorted(unknown)[0]!r}, expected one for --view")
    model = FittedModel.load(scene.path(scene.products["model"]))
    check_current(scene, "fit")
    return model


def _write_heights(exported: Exported, vertical: str) -> str:
    """Write the DSM, its standard deviation and its picture; the vertical datum."""
    scene, model = exported.scene, exported.model
    heights, datum = to_datum(model.height.numpy(), model.grid, vertical)
    dsm = exported.shown(heights)
    tags = {"VERTICAL_DATUM": datum, "SOFTWARE": "sattools"}
    above, crs = ["height"], vertical_crs(vertical)
    write_cog(scene.output(DSM), dsm, model.grid, units="m", tags=tags, descriptions=above, vertical=crs)
    method = {
        "METHOD": "curvature of the photometric loss; gross errors of matching are not in it",
        "SOFTWARE": "sattools",
    }
    about = ["standard deviation of the height"]
    std = exported.shown(model.height_std.numpy())
    write_cog(scene.output(STD), std, model.grid, units="m", tags=method, descriptions=about)
    title = f"{scene.id}: DSM, {model.grid.cell_size:g} m"
    write_picture(dsm, model.grid, title, scene.output(PICTURE), datum)
    return datum


def _write_albedo(exported: Exported) -> None:
    scene, model = exported.scene, exported.model
    bands, wavelengths = exported.band_names("albedo", model.albedo.shape[-1])
    scale = "relative: radiance of the first training image in full sun"
    if model.absolute:
        scale = f"absolute: {model.radiance}"
    tags = {"SCALE": scale, "SOFTWARE": "sattools", **wavelengths}
    colours = exported.shown(model.albedo.permute(2, 0, 1).numpy())
    write_cog(scene.output(ALBEDO), colours, model.grid, units="1", tags=tags, descriptions=bands)


def _write_validity(scene: Scene, validity: np.ndarray, grid: Grid) -> dict[str, float]:
    """Write the map; the share of every kind of cell."""
    tags = {"MEANING": MEANING, "SOFTWARE": "sattools"}
    write_cog(scene.output(VALIDITY), validity, grid, nodata=None, tags=tags, descriptions=["validity"])
    scene.products["validity"] = VALIDITY
    kinds = {"measured": MEASURED, "filled": FILLED, "unseen": UNSEEN}
    return {name: round(float((validity == kind).mean()), 4) for name, kind in kinds.items()}


def _outputs(scene: Scene, options: ExportOptions, model: FittedModel) -> list[str]:
    """All files that will be written."""
    from sattools.export.material import material_names
    from sattools.export.novel import RELIT, view_href

    ids = {item.id for item in scene.items}
    hrefs = [DSM, STD, ALBEDO, PICTURE, VALIDITY, *CATALOGUE.values()]
    hrefs += [view_href("shadow", name) for name, _ in shadow_suns(model) if name in ids]
    hrefs += [view_href(m, n) for m in IMAGE_MAPS if m in model.image_maps() for n in model.items if n in ids]
    hrefs += [view_href("rendered", name) for name in options.view]
    hrefs += [f"export/{name}.tif" for name in material_names(model)]
    if options.sun is not None:
        hrefs += [RELIT, *(view_href("relit", name) for name in options.view)]
    return hrefs + product_hrefs(options.wanted)


def _needs_surface(options: ExportOptions, model: FittedModel) -> bool:
    return bool(model.brdf != "lambert" or options.view or options.sun is not None)


def _image_maps(exported: Exported, name: str, description: str) -> None:
    """One map ``[H, W]`` per image, on the ground grid."""
    from sattools.export.novel import view_href

    scene, model = exported.scene, exported.model
    items = {item.id: item for item in scene.items}
    for item_id, array in zip(model.items, model.image_maps()[name].numpy(), strict=True):
        if item_id in items and np.isfinite(array).any():
            href = view_href(name, item_id)
            write_cog(scene.output(href), exported.shown(array), model.grid, units="1", descriptions=[description])
            items[item_id].assets[name] = Asset(href)


def _views(exported: Exported, options: ExportOptions, progress: Progress) -> None:
    """Maps of a reflectance model, the images asked for, the scene under another sun."""
    from sattools.export.material import material_maps, network_maps, write_material
    from sattools.export.novel import write_relit, write_view
    from sattools.fit.materials.scene import ReflectiveScene

    try:
        surface = exported.model.surface()
    except (KeyError, TypeError, ValueError, RuntimeError) as error:
        path, reason = exported.scene.products["model"], " ".join(str(error).split())
        raise InputError(f"{path}: found a model without what its kind needs ({reason})") from error
    if isinstance(surface, ReflectiveScene):
        progress(0.0, "reflectance")
        write_material(exported, material_maps(surface, exported.model.extra))
    elif exported.model.brdf != "lambert":
        write_material(exported, network_maps(exported.model))
    for k, name in enumerate(options.view):
        progress((k + 1) / (len(options.view) + 2), f"rendering {name}")
        write_view(exported, name, surface, None)
    if options.sun is not None:
        write_relit(exported, surface, options.sun)
        for name in options.view:
            write_view(exported, name, surface, options.sun)


def _shadows(exported: Exported, progress: Progress) -> None:
    """One mask per image, on the ground grid: 1 in cast shadow, 0 lit, 255 unknown."""
    from sattools.export.novel import view_href
    from sattools.render import sun_visibility

    scene, model = exported.scene, exported.model
    items = {item.id: item for item in scene.items}
    suns = shadow_suns(model)
    for k, (name, sun) in enumerate(suns):
        progress(0.4 + 0.2 * k / len(suns), f"shadow of {name}")
        if name not in items:
            continue
        lit = sun_visibility(model.height, model.grid.cell_size, sun).numpy()
        href = view_href("shadow", name)
        mask = np.where(exported.valid, lit < 0.5, 255).astype(np.uint8)
        write_cog(scene.output(href), mask, model.grid, nodata=255, descriptions=["1 = cast shadow"])
        items[name].assets["shadow"] = Asset(href)


__all__ = ["export"]
