"""Fitted tiles put together into the model of the whole area."""

from __future__ import annotations

import csv
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch

from sattools.errors import SceneError
from sattools.fit.files import MODEL, TRACE, Fitted, save_fit
from sattools.fit.model import FittedModel
from sattools.fit.tiles.plan import COARSE, COMMON, FOLDER, Plan
from sattools.fit.trace import Trace
from sattools.progress import Progress
from sattools.scene import Grid
from sattools.scene.dependencies import record
from sattools.scene.jsonio import JsonObject
from sattools.scene.raster import read_raster
from sattools.scene.regrid import sample_map
from sattools.scene.tiles import Tile

MAPS = ("height", "height_std", "albedo")


class FeatheredMosaic:
    """A map of the whole, summed up from weighted pieces.

    Args:
        grid: of the whole.
        bands: values per cell.
    """

    def __init__(self, grid: Grid, bands: int) -> None:
        self.grid = grid
        self.total = np.zeros((*grid.shape, bands), np.float32)
        self.weight = np.zeros(grid.shape, np.float32)

    def add(self, tile: Tile, values: np.ndarray, cell: float) -> None:
        """Add a tile's map ``[h, w]`` or ``[h, w, B]``; unknown (NaN) cells count nothing.

        Args:
            tile: where it lies.
            values: see above.
            cell: edge of a cell [m].
        """
        rows, cols = tile.place(self.grid, values.shape[:2])
        share = tile.weights(values.shape[:2], cell)[: rows.stop - rows.start, : cols.stop - cols.start]
        piece = values.reshape(*values.shape[:2], -1)[: share.shape[0], : share.shape[1]]
        share = np.where(np.isfinite(piece).all(axis=-1), share, 0).astype(np.float32)
        self.total[rows, cols] += share[..., None] * np.nan_to_num(piece)
        self.weight[rows, cols] += share

    def done(self) -> np.ndarray:
        """The map ``[H, W, B]`` in the unit of its pieces; NaN in cells where nothing was added."""
        with np.errstate(invalid="ignore"):
            self.total /= self.weight[..., None]  # 0 / 0 is NaN
        return self.total


def mosaic_tiles(plan: Plan, notes: list[str], progress: Progress) -> JsonObject:
    """Write model, trace and, where the tiles made one, the prior of the whole; see `sattools.fit.tiles.stage`.

    Args:
        plan: tiles and their scenes.
        notes: gets what a user should know.
        progress: told the share done and what is being done.

    Raises:
        SceneError: a tile that is not fitted.
    """
    scene, names = plan.scene, plan.names()
    for name in names:
        if not (plan.root(name) / MODEL).exists():
            raise SceneError(f"{plan.root(name) / MODEL}: no such file, expected the model of a fitted tile")
    progress(1.0, f"joining {len(names)} tiles")
    # a fit may give its surface on the cells of the prior, finer than its own
    cell = FittedModel.load(plan.root(names[0]) / MODEL).grid.cell_size if names else plan.finest
    whole = scene.require_grid().resized(cell)
    common = FittedModel.load(scene.root / COMMON)
    made = {}
    if plan.options.prior_weight > 0 and "prior_dsm" not in scene.products:
        _mosaic_priors(plan, names)
        made = record(scene, "prior", scene.train_items(), implicit=True)
    mosaics: dict[str, FeatheredMosaic] = {}
    image_mosaics: dict[str, list[FeatheredMosaic]] = {}
    softness = common.softness
    for tile in plan.tiles:
        if tile.name in names:
            model = FittedModel.load(plan.root(tile.name) / MODEL)
            softness = model.softness
        else:
            model = _resampled(common, tile.grid.resized(cell))
        for name in MAPS:
            values = getattr(model, name).numpy()
            if name not in mosaics:
                mosaics[name] = FeatheredMosaic(whole, values[..., None].shape[2])
            mosaics[name].add(tile, values, model.grid.cell_size)
        for name, layers_of in model.image_maps().items():
            layers = image_mosaics.setdefault(name, [FeatheredMosaic(whole, 1) for _ in common.items])
            for item, values in zip(model.items, layers_of.numpy(), strict=True):
                layers[common.items.index(item)].add(tile, values, model.grid.cell_size)
    maps = {name: torch.from_numpy(mosaic.done()) for name, mosaic in mosaics.items()}
    of_images = {n: torch.from_numpy(np.stack([s.done()[..., 0] for s in own])) for n, own in image_mosaics.items()}
    model = replace(
        common,
        grid=whole,
        softness=softness,
        height=maps["height"][..., 0],
        height_std=maps["height_std"][..., 0],
        albedo=maps["albedo"],
        s_net=of_images.get("s_net"),
        tau=of_images.get("tau"),
        extra={},
    )
    notes = [f"{len(names)} tiles of up to {plan.options.tile:g} m", *notes]
    result = save_fit(scene, Fitted(model, _trace(plan, [COARSE, *names]), notes), made)
    if spent := plan.spent():
        result["parts"] = spent
    if plan.options.part == "all":
        shutil.rmtree(scene.root / FOLDER)
    return result


def _resampled(model: FittedModel, grid: Grid) -> FittedModel:
    """The maps of a model on another grid, without those of single images."""
    height, height_std, albedo = (
        torch.from_numpy(sample_map(getattr(model, name).numpy(), model.grid, grid)) for name in MAPS
    )
    return replace(model, grid=grid, height=height, height_std=height_std, albedo=albedo, s_net=None, tau=None)


def _mosaic_priors(plan: Plan, names: list[str]) -> None:
    """The tiles' matched surfaces as the scene's own; where a tile has none, the coarse one without confidence."""
    from sattools.prior.stage import CONFIDENCE, DSM, write_maps

    whole = plan.scene.require_grid()
    height, confidence = FeatheredMosaic(whole, 1), FeatheredMosaic(whole, 1)
    for tile in plan.tiles:
        if tile.name in names:
            for mosaic, href in ((height, DSM), (confidence, CONFIDENCE)):
                values, grid = read_raster(plan.root(tile.name) / href)
                mosaic.add(tile, values[0], grid.cell_size)
        else:
            values, grid = read_raster(plan.root(COARSE) / DSM)
            rough = sample_map(values[0], grid, tile.grid)
            height.add(tile, rough, tile.grid.cell_size)
            confidence.add(tile, np.zeros_like(rough), tile.grid.cell_size)
    write_maps(plan.scene, height.done()[..., 0], confidence.done()[..., 0], whole)


def _trace(plan: Plan, names: list[str]) -> Trace:
    """What happened in all parts, one after the other."""
    trace, before = Trace(), 0.0
    for name in names:
        rows = _rows(plan.root(name) / TRACE)
        for row in rows:
            number = {key: float(value) for key, value in row.items() if key in ("seconds", "loss")}
            trace.rows.append({"part": name, **row, **number, "seconds": round(before + number["seconds"], 3)})
        before = float(trace.rows[-1]["seconds"])
    return trace


def _rows(path: Path) -> list[dict[str, str]]:
    with open(path, newline="", encoding="utf-8") as file:
        return list(csv.DictReader(file))


__all__ = ["mosaic_tiles"]
