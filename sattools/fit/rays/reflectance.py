"""The reflectance model of a network: its maps, and what is known of them from the surface fit that it starts from."""

from __future__ import annotations

import torch
from torch import Tensor

from sattools.fit.materials.parameters import AMPLITUDE, SHAPE, Kind
from sattools.fit.materials.scene import level_reflectance
from sattools.fit.model import FittedModel
from sattools.fit.rays.maps import GroundMaps
from sattools.fit.rays.start import Beginning
from sattools.scene import Grid
from sattools.scene.regrid import sample_map

HEADS = {"asymmetry": "theta"}  # parameters whose head has another name


def reflectance_maps(kind: Kind, maps: GroundMaps) -> tuple[Tensor, dict[str, Tensor]]:
    """The BRF ``[H, W, C]`` at standard geometry, and every parameter by its name with ``map.`` before it.

    Args:
        kind: model.
        maps: of a network, whose albedo is the model's amplitude.
    """
    kept = {f"map.{AMPLITUDE[kind].name}": maps.albedo} | {f"map.{name}": values for name, values in maps.heads.items()}
    return level_reflectance(kind, maps.albedo, _shape(kind, kept)), kept


def network_values(model: FittedModel) -> tuple[Tensor, tuple[Tensor, Tensor, Tensor]]:
    """Amplitude ``[H, W, C]`` and the three shape parameters ``[H, W]`` of a network, in their own units.

    Args:
        model: with a reflectance model; an earlier version's has the amplitude as its albedo.

    Raises:
        KeyError: it has no such maps.
    """
    assert model.brdf != "lambert"
    extra = dict(model.extra)
    return extra.get(f"map.{AMPLITUDE[model.brdf].name}", model.albedo), _shape(model.brdf, extra)


def _shape(kind: Kind, maps: dict[str, Tensor]) -> tuple[Tensor, Tensor, Tensor]:
    one, two, three = (maps[f"map.{HEADS.get(p.name, p.name)}"] for p in SHAPE[kind])
    return one, two, three


def known_of_start(start: Beginning | None, grid: Grid) -> dict[str, Tensor]:
    """``NAME_std`` of the parameters and ``identifiable``, as the surface fit that a network starts from found them.

    A network has none of its own: its weights share what a cell's parameters say, and no curvature tells them apart.

    Args:
        start: of the network, or None.
        grid: of its maps.
    """
    if start is None or start.reflective is None:
        return {}
    found = start.surface.extra
    kind = start.reflective.kind
    names = [f"{p.name}_std" for p in (AMPLITUDE[kind], *SHAPE[kind])] + ["identifiable"]
    maps = {name: sample_map(found[name].numpy(), start.surface.grid, grid) for name in names if name in found}
    return {name: torch.from_numpy(values).float() for name, values in maps.items()}


__all__ = ["known_of_start", "network_values", "reflectance_maps"]
