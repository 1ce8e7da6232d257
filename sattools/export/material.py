"""Maps of a fitted reflectance model."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import torch
from torch import Tensor

from sattools.export.context import Exported
from sattools.fit.illumination import LEAST_KNOWN
from sattools.fit.materials.normals import surface_normals
from sattools.fit.materials.parameters import AMPLITUDE, SHAPE, Kind
from sattools.fit.materials.scene import STANDARD_SUN_DEG, ReflectiveScene, level_reflectance, standard_reflectance
from sattools.fit.materials.uncertainty import SLOPE_STD
from sattools.fit.model import FittedModel
from sattools.fit.rays.reflectance import network_values
from sattools.scene.raster import write_cog

ABSOLUTE = "absolute: the images are reflectances"
RELATIVE = "relative: the images have an unknown scale"
OF_START = "of the surface fit that the network started from"
UNKNOWN = "unknown: the model holds nothing of a surface fit, which would say so"


def material_maps(surface: ReflectiveScene, tensors: Mapping[str, Tensor]) -> dict[str, np.ndarray]:
    """Every map ``[B, H, W]`` by the name of its product; standard deviations end in ``_std``.

    ``normal_std`` is in degrees about either axis: 86 % of the normals are within twice as much.
    """
    maps = _parameter_maps(surface.kind, *surface.values(), tensors)
    if surface.identifiable.numel():
        maps["identifiable"] = surface.identifiable.permute(2, 0, 1)
    if (plain := surface.plain_share()) is not None:
        maps["lambert_share"] = plain[None]
    maps["normal"] = surface.normals().permute(2, 0, 1)
    tilt = torch.atan(torch.full_like(surface.height, SLOPE_STD))
    maps["normal_std"] = torch.rad2deg(tilt)[None]
    maps["reflectance"] = standard_reflectance(surface).permute(2, 0, 1)
    return {name: tensor.detach().cpu().numpy() for name, tensor in maps.items()}


def network_maps(model: FittedModel) -> dict[str, np.ndarray]:
    """As `material_maps`, of a network with a reflectance model.

    Standard deviations, and what the images determined, are those of the surface fit that it started from, if any.
    """
    assert model.brdf != "lambert"
    amplitude, shape = network_values(model)
    maps = _parameter_maps(model.brdf, amplitude, shape, model.extra)
    if "identifiable" in model.extra:
        maps["identifiable"] = model.extra["identifiable"].permute(2, 0, 1)
    maps["normal"] = surface_normals(model.height, model.grid.cell_size).permute(2, 0, 1)
    maps["reflectance"] = level_reflectance(model.brdf, amplitude, shape).permute(2, 0, 1)
    return {name: tensor.numpy() for name, tensor in maps.items()}


def _parameter_maps(
    kind: Kind, amplitude: Tensor, shape: tuple[Tensor, Tensor, Tensor], tensors: Mapping[str, Tensor]
) -> dict[str, Tensor]:
    """Amplitude and shape parameters ``[B, H, W]`` by name, and their standard deviations where there are some."""
    maps = {AMPLITUDE[kind].name: amplitude.permute(2, 0, 1)}
    maps |= {p.name: value[None] for p, value in zip(SHAPE[kind], shape, strict=True)}
    for name in list(maps):
        if f"{name}_std" in tensors:
            std = tensors[f"{name}_std"]
            maps[f"{name}_std"] = std.permute(2, 0, 1) if std.ndim == 3 else std[None]
    return maps


def material_names(model: FittedModel) -> list[str]:
    """Names of the `material_maps` of a model; none without a reflectance model."""
    if model.brdf == "lambert":
        return []
    names = [AMPLITUDE[model.brdf].name, *(p.name for p in SHAPE[model.brdf])]
    stds = [f"{name}_std" for name in names if f"{name}_std" in model.extra]
    stds += ["identifiable"] if "identifiable" in model.extra else []
    stds += ["lambert_share"] if "plain" in model.extra else []
    stds += ["normal_std"] if model.field == "surface" else []
    return [*names, *stds, "normal", "reflectance"]


def write_material(exported: Exported, maps: Mapping[str, np.ndarray], undetermined: bool = False) -> None:
    """Write `material_maps` or `network_maps` below ``export/`` and name them as products; angles in degrees.

    Args:
        exported: where to.
        maps: ``[B, H, W]`` by name.
        undetermined: keep shape parameters where the images did not determine them; else they are no-data there.
    """
    scene, model, grid = exported.scene, exported.about, exported.about.grid
    assert model.brdf != "lambert"
    tags: dict[str, Any] = {"SOFTWARE": "sattools", "MODEL": model.brdf}
    shapes = [parameter.name for parameter in SHAPE[model.brdf]]
    of_start = "" if model.field == "surface" else f"; {OF_START}"
    for name, array in maps.items():
        href = f"export/{name}.tif"
        own = dict(tags)
        stem = name.removesuffix("_std")
        if stem in (AMPLITUDE[model.brdf].name, "reflectance"):
            own["SCALE"] = ABSOLUTE if model.absolute else RELATIVE
        if name == "reflectance":
            own["GEOMETRY"] = f"level ground, nadir view, sun {STANDARD_SUN_DEG:g} degrees from the vertical"
        if name.endswith("_std"):
            own["METHOD"] = f"curvature of the fit; materials told apart wrongly are not in it{of_start}"
        if name in shapes and "identifiable" not in maps:
            own["DETERMINED"] = UNKNOWN
        if name in shapes and "identifiable" in maps:
            known = maps["identifiable"][shapes.index(name)] >= LEAST_KNOWN
            share = f"{float(known.mean()):.2f} of the cells, see identifiable.tif; "
            if undetermined:
                own["DETERMINED"] = share + "elsewhere this is mostly the prior" + of_start
            else:
                own["DETERMINED"] = share + "no data elsewhere, where it would be mostly the prior" + of_start
                array = np.where(known, array, np.float32(np.nan))
        if name == "lambert_share":
            own["CONTENT"] = (
                f"share of the ground that reflects as Lambert's law has it, with the reflectance for light from all "
                f"sides that belongs to {AMPLITUDE[model.brdf].name}"
            )
        if stem == "normal" and array.shape[0] == 3:
            bands = ["normal east", "normal north", "normal up"]
        elif name == "identifiable":
            bands = shapes
            own["CONTENT"] = (
                "share of the prior's variance that the images took away: 0 = its prior, 1 = known" + of_start
            )
        else:
            bands, wavelengths = ([name], {}) if array.shape[0] == 1 else exported.band_names(name, array.shape[0])
            own |= wavelengths
        unit = "degrees" if name in ("theta", "theta_std", "normal_std") else "1"
        write_cog(scene.output(href), exported.shown(array), grid, units=unit, tags=own, descriptions=bands)
        scene.products[name] = href


__all__ = ["material_maps", "material_names", "network_maps", "write_material"]
