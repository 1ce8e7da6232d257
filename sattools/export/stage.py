"""The stage `export`: a fitted model becomes georeferenced files."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch

from sattools.errors import InputError, SceneError
from sattools.export.datum import to_datum
from sattools.export.hillshade import write_picture
from sattools.export.options import ExportOptions
from sattools.progress import Progress, part, silent
from sattools.scene import Asset, Grid, Scene
from sattools.scene.raster import write_cog

# what the model may hold per image
IMAGE_MAPS = {"s_net": "learned sun visibility, 1 = lit", "tau": "share of the light that transient objects leave"}
DSM, STD, ALBEDO, PICTURE = "export/dsm.tif", "export/dsm_std.tif", "export/albedo.tif", "export/dsm.png"


def export(scene: Scene, options: ExportOptions, progress: Progress = silent, overwrite: bool = True) -> dict[str, Any]:
    """Write the DSM, its picture, the albedo and a shadow mask per image; adds products and assets to the scene.

    Raises:
        SceneError: the scene has no model.
        InputError: the model file is damaged.
    """
    from sattools.fit.model import read_model

    if "model" not in scene.products:
        raise SceneError(f"scene {scene.id}: found no product 'model', expected one made by `sattools fit`")
    source = scene.path(scene.products["model"])
    tensors, meta = read_model(source)
    grid = Grid.from_dict(meta["grid"])
    height, std, albedo = tensors["height"], tensors["height_std"], tensors["albedo"]
    names, suns = meta["items"], meta["suns"]
    targets = {name: scene.output(name, overwrite) for name in (DSM, STD, ALBEDO, PICTURE)}
    unknown = set(options.view) - {item.id for item in scene.items}
    if unknown:
        raise SceneError(f"scene {scene.id}: found no item {sorted(unknown)[0]!r}, expected one for --view")

    progress(0.1, "DSM")
    dsm, datum = to_datum(height.numpy(), grid, options.vertical)
    tags = {"VERTICAL_DATUM": datum, "SOFTWARE": "sattools"}
    write_cog(targets[DSM], dsm, grid, units="m", tags=tags, descriptions=["height"])
    method = {
        "METHOD": "curvature of the photometric loss; gross errors of matching are not in it",
        "SOFTWARE": "sattools",
    }
    write_cog(
        targets[STD], std.numpy(), grid, units="m", tags=method, descriptions=["standard deviation of the height"]
    )
    write_picture(dsm, grid, f"{scene.id}: DSM, {grid.cell_size:g} m", targets[PICTURE])
    progress(0.3, "albedo")
    bands = [f"albedo {b + 1}" for b in range(albedo.shape[-1])]
    scale = "relative: radiance of the first training image in full sun"
    if meta.get("radiance", "relative") != "relative":
        scale = f"absolute: {meta['radiance']}"
    relative = {"SCALE": scale, "SOFTWARE": "sattools"}
    write_cog(targets[ALBEDO], albedo.permute(2, 0, 1).numpy(), grid, units="1", tags=relative, descriptions=bands)
    scene.products.update(dsm=DSM, dsm_std=STD, albedo=ALBEDO, dsm_picture=PICTURE)
    if meta["shadow"] != "none":
        _shadows(scene, grid, height, names, suns, progress, overwrite)
    for name, description in IMAGE_MAPS.items():
        if name in tensors:
            _image_maps(scene, grid, tensors[name], name, description, names, overwrite)
    if meta.get("brdf", "lambert") != "lambert" or options.view or options.sun is not None:
        _views(scene, options, grid, tensors, meta, part(progress, 0.6, 1.0), overwrite)
    progress(1.0, "exported")
    return {"vertical_datum": datum}


def _image_maps(
    scene: Scene, grid: Grid, maps: torch.Tensor, name: str, description: str, names: list[str], overwrite: bool
) -> None:
    """One map ``[H, W]`` per image, on the ground grid."""
    items = {item.id: item for item in scene.items}
    for item_id, array in zip(names, maps.numpy(), strict=True):
        if item_id in items and np.isfinite(array).any():
            href = f"export/{name}/{item_id}.tif"
            write_cog(scene.output(href, overwrite), array, grid, units="1", descriptions=[description])
            items[item_id].assets[name] = Asset(href)


def _views(
    scene: Scene,
    options: ExportOptions,
    grid: Grid,
    tensors: dict[str, torch.Tensor],
    meta: dict[str, Any],
    progress: Progress,
    overwrite: bool,
) -> None:
    """Maps of a reflectance model, the images asked for, the scene under another sun."""
    from sattools.export.material import write_material
    from sattools.export.novel import write_relit, write_view
    from sattools.fit.reflective import ReflectiveScene, restored_model

    try:
        surface = restored_model(tensors, meta)
    except (KeyError, TypeError, ValueError, RuntimeError) as error:
        reason = " ".join(str(error).split())
        raise InputError(f"{scene.products['model']}: found a model without what its kind needs ({reason})") from error
    if isinstance(surface, ReflectiveScene):
        progress(0.0, "reflectance")
        write_material(scene, grid, surface, tensors, overwrite)
    for k, name in enumerate(options.view):
        progress((k + 1) / (len(options.view) + 2), f"rendering {name}")
        write_view(scene, name, surface, meta, None, overwrite)
    if options.sun is not None:
        write_relit(scene, surface, meta, options.sun, overwrite)
        for name in options.view:
            write_view(scene, name, surface, meta, options.sun, overwrite)


def _shadows(
    scene: Scene,
    grid: Grid,
    height: torch.Tensor,
    names: list[str],
    suns: list[list[float] | None],
    progress: Progress,
    overwrite: bool,
) -> None:
    """One mask per image, on the ground grid: 1 in cast shadow, 0 lit, 255 sun unknown."""
    from sattools.render import sun_visibility

    items = {item.id: item for item in scene.items}
    for k, (name, sun) in enumerate(zip(names, suns, strict=True)):
        progress(0.4 + 0.6 * k / len(names), f"shadow of {name}")
        if name not in items or sun is None:
            continue
        lit = sun_visibility(height, grid.cell_size, (sun[0], sun[1], sun[2])).numpy()
        href = f"export/shadow/{name}.tif"
        mask = np.where(lit < 0.5, 1, 0).astype(np.uint8)
        write_cog(scene.output(href, overwrite), mask, grid, nodata=255, descriptions=["1 = cast shadow"])
        items[name].assets["shadow"] = Asset(href)


__all__ = ["export"]
