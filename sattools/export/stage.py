"""The stage `export`: a fitted model becomes georeferenced files."""

from __future__ import annotations

import logging
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch

from sattools.errors import InputError, SceneError
from sattools.export.datum import to_datum
from sattools.export.hillshade import write_picture
from sattools.export.options import ExportOptions
from sattools.export.validity import FILLED, MEANING, MEASURED, UNSEEN, validity_of
from sattools.progress import Progress, silent, subprogress
from sattools.scene import Asset, Grid, Scene
from sattools.scene.dependencies import MADE, begin, check_current, record
from sattools.scene.raster import write_cog

log = logging.getLogger(__name__)
# what the model may hold per image
IMAGE_MAPS = {"s_net": "learned sun visibility, 1 = lit", "tau": "share of the light that transient objects leave"}
DSM, STD, ALBEDO, PICTURE = "export/dsm.tif", "export/dsm_std.tif", "export/albedo.tif", "export/dsm.png"
VALIDITY = "export/validity.tif"


@dataclass(frozen=True)
class _Model:
    """A fitted model and where it may be shown.

    Attributes:
        tensors, meta: of the model file.
        grid: of its maps.
        valid: ``[H, W]`` cells that get values; all others are no-data.
    """

    tensors: dict[str, torch.Tensor]
    meta: dict[str, Any]
    grid: Grid
    valid: np.ndarray

    @property
    def height(self) -> torch.Tensor:
        """``[H, W]`` [m]."""
        return self.tensors["height"]

    def shown(self, maps: np.ndarray) -> np.ndarray:
        """Maps ``[..., H, W]`` with NaN for no data."""
        return np.where(self.valid, maps, np.nan)


def export(scene: Scene, options: ExportOptions, progress: Progress = silent, overwrite: bool = True) -> dict[str, Any]:
    """Write the DSM, its picture, where it is valid, the albedo and a shadow mask per image; adds products and assets.

    Ground that fewer than two images reach is no-data in all of them, unless `options.fill` asks otherwise.

    Raises:
        SceneError: the scene has no model.
        StaleError: the model was made from something else than the scene holds now.
        InputError: the model file is damaged.
    """
    from sattools.fit.model import read_model

    if "model" not in scene.products:
        raise SceneError(f"scene {scene.id}: found no product 'model', expected one made by `sattools fit`")
    unknown = set(options.view) - {item.id for item in scene.items}
    if unknown:
        raise SceneError(f"scene {scene.id}: found no item {sorted(unknown)[0]!r}, expected one for --view")
    source = scene.path(scene.products["model"])
    tensors, meta = read_model(source)
    check_current(scene, "fit")
    grid, names = Grid.from_dict(meta["grid"]), meta["items"]
    height, std, albedo = tensors["height"], tensors["height_std"], tensors["albedo"]
    begin(scene, "export", _outputs(scene, options, tensors, meta), overwrite)

    progress(0.05, "what the images show")
    validity = validity_of(scene, names, grid, height.numpy())
    if validity is None:
        log.warning("scene %s: images or cameras of the fit are missing: nobody knows what they show", scene.id)
    valid = np.isfinite(height.numpy()) if options.fill or validity is None else validity != UNSEEN
    model = _Model(tensors, meta, grid, valid)
    progress(0.1, "DSM")
    dsm, datum = to_datum(height.numpy(), grid, options.vertical)
    dsm = model.shown(dsm)
    tags = {"VERTICAL_DATUM": datum, "SOFTWARE": "sattools"}
    write_cog(scene.output(DSM), dsm, grid, units="m", tags=tags, descriptions=["height"])
    method = {
        "METHOD": "curvature of the photometric loss; gross errors of matching are not in it",
        "SOFTWARE": "sattools",
    }
    about = ["standard deviation of the height"]
    write_cog(scene.output(STD), model.shown(std.numpy()), grid, units="m", tags=method, descriptions=about)
    write_picture(dsm, grid, f"{scene.id}: DSM, {grid.cell_size:g} m", scene.output(PICTURE))
    fractions = None if validity is None else _write_validity(scene, validity, grid)
    progress(0.3, "albedo")
    bands = [f"albedo {b + 1}" for b in range(albedo.shape[-1])]
    scale = "relative: radiance of the first training image in full sun"
    if meta.get("radiance", "relative") != "relative":
        scale = f"absolute: {meta['radiance']}"
    relative = {"SCALE": scale, "SOFTWARE": "sattools"}
    colours = model.shown(albedo.permute(2, 0, 1).numpy())
    write_cog(scene.output(ALBEDO), colours, grid, units="1", tags=relative, descriptions=bands)
    scene.products.update(dsm=DSM, dsm_std=STD, albedo=ALBEDO, dsm_picture=PICTURE)
    if meta["shadow"] != "none":
        _shadows(scene, model, progress)
    for name, description in IMAGE_MAPS.items():
        if name in tensors:
            _image_maps(scene, model, name, description)
    if _needs_surface(options, meta):
        _views(scene, options, model, subprogress(progress, 0.6, 1.0))
    progress(1.0, "exported")
    return {"vertical_datum": datum, "validity": fractions, MADE: record(scene, "export")}


def _write_validity(scene: Scene, validity: np.ndarray, grid: Grid) -> dict[str, float]:
    """Write the map; the share of every kind of cell."""
    tags = {"MEANING": MEANING, "SOFTWARE": "sattools"}
    write_cog(scene.output(VALIDITY), validity, grid, nodata=None, tags=tags, descriptions=["validity"])
    scene.products["validity"] = VALIDITY
    kinds = {"measured": MEASURED, "filled": FILLED, "unseen": UNSEEN}
    return {name: round(float((validity == kind).mean()), 4) for name, kind in kinds.items()}


def _outputs(scene: Scene, options: ExportOptions, tensors: dict[str, torch.Tensor], meta: dict[str, Any]) -> list[str]:
    """All files that will be written."""
    from sattools.export.material import material_names
    from sattools.export.novel import RELIT, view_href

    ids = {item.id for item in scene.items}
    hrefs = [DSM, STD, ALBEDO, PICTURE, VALIDITY]
    hrefs += [view_href("shadow", name) for name, _ in _suns(meta) if name in ids]
    hrefs += [view_href(m, n) for m in IMAGE_MAPS if m in tensors for n in meta["items"] if n in ids]
    hrefs += [view_href("rendered", name) for name in options.view]
    if meta.get("brdf", "lambert") != "lambert":
        hrefs += [f"export/{name}.tif" for name in material_names(meta["brdf"], tensors)]
    if options.sun is not None:
        hrefs += [RELIT, *(view_href("relit", name) for name in options.view)]
    return hrefs


def _suns(meta: dict[str, Any]) -> list[tuple[str, list[float]]]:
    """Ids and suns of the images whose shadows are known."""
    if meta["shadow"] == "none":
        return []
    return [(name, sun) for name, sun in zip(meta["items"], meta["suns"], strict=True) if sun is not None]


def _needs_surface(options: ExportOptions, meta: dict[str, Any]) -> bool:
    return bool(meta.get("brdf", "lambert") != "lambert" or options.view or options.sun is not None)


def _image_maps(scene: Scene, model: _Model, name: str, description: str) -> None:
    """One map ``[H, W]`` per image, on the ground grid."""
    from sattools.export.novel import view_href

    items = {item.id: item for item in scene.items}
    for item_id, array in zip(model.meta["items"], model.tensors[name].numpy(), strict=True):
        if item_id in items and np.isfinite(array).any():
            href = view_href(name, item_id)
            array = model.shown(array)
            write_cog(scene.output(href), array, model.grid, units="1", descriptions=[description])
            items[item_id].assets[name] = Asset(href)


def _views(scene: Scene, options: ExportOptions, model: _Model, progress: Progress) -> None:
    """Maps of a reflectance model, the images asked for, the scene under another sun."""
    from sattools.export.material import write_material
    from sattools.export.novel import write_relit, write_view
    from sattools.fit.reflective import ReflectiveScene, restored_model

    try:
        surface = restored_model(model.tensors, model.meta)
    except (KeyError, TypeError, ValueError, RuntimeError) as error:
        reason = " ".join(str(error).split())
        raise InputError(f"{scene.products['model']}: found a model without what its kind needs ({reason})") from error
    if isinstance(surface, ReflectiveScene):
        progress(0.0, "reflectance")
        write_material(scene, model.grid, surface, model.tensors, model.valid)
    for k, name in enumerate(options.view):
        progress((k + 1) / (len(options.view) + 2), f"rendering {name}")
        write_view(scene, name, surface, model.meta, None)
    if options.sun is not None:
        write_relit(scene, surface, model.meta, options.sun, model.valid)
        for name in options.view:
            write_view(scene, name, surface, model.meta, options.sun)


def _shadows(scene: Scene, model: _Model, progress: Progress) -> None:
    """One mask per image, on the ground grid: 1 in cast shadow, 0 lit, 255 unknown."""
    from sattools.export.novel import view_href
    from sattools.render import sun_visibility

    items = {item.id: item for item in scene.items}
    suns = _suns(model.meta)
    for k, (name, sun) in enumerate(suns):
        progress(0.4 + 0.2 * k / len(suns), f"shadow of {name}")
        if name not in items:
            continue
        lit = sun_visibility(model.height, model.grid.cell_size, (sun[0], sun[1], sun[2])).numpy()
        href = view_href("shadow", name)
        mask = np.where(model.valid, lit < 0.5, 255).astype(np.uint8)
        write_cog(scene.output(href), mask, model.grid, nodata=255, descriptions=["1 = cast shadow"])
        items[name].assets["shadow"] = Asset(href)


__all__ = ["export"]
