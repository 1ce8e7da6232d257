"""Fitted tiles put together into the model of the whole area."""

from __future__ import annotations

import csv
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from sattools.errors import SceneError, counted
from sattools.fit.described import CELL_MAPS, COLOURS
from sattools.fit.files import MODEL, TRACE, Fitted, one_result, save_fit
from sattools.fit.model import FittedModel
from sattools.fit.stored import CellMaps, StoredModel, StreamedModel
from sattools.fit.tiles.alike import check_maps_alike, tell_other_options
from sattools.fit.tiles.clearing import COMMON, remove_parts
from sattools.fit.tiles.plan import Plan
from sattools.fit.tiles.state import COARSE
from sattools.fit.trace import Trace
from sattools.progress import Progress
from sattools.render.around import PRODUCT as AROUND
from sattools.scene import Grid
from sattools.scene.dependencies import Seen, record
from sattools.scene.files import write_bytes
from sattools.scene.jsonio import JsonObject
from sattools.scene.raster import raster_grid, read_on, read_raster
from sattools.scene.regrid import sample_map
from sattools.scene.runner import at_the_end
from sattools.scene.tiles import Tile

STRIP_ROWS = 256  # of the whole that are put together at a time, or fewer where they are wide:
STRIP_CELLS = 1_000_000
LEAST_ROWS = 16


class FeatheredMosaic:
    """Some rows of a map of the whole, summed up from weighted pieces.

    Args:
        grid: of the whole.
        rows: of it.
        bands: values per cell.
    """

    def __init__(self, grid: Grid, rows: slice, bands: int) -> None:
        self.grid, self.rows = grid, rows
        self.total = np.zeros((rows.stop - rows.start, grid.width, bands), np.float32)
        self.weight = np.zeros(self.total.shape[:2], np.float32)

    def add(self, tile: Tile, share: np.ndarray, values: np.ndarray, own: slice) -> None:
        """Add some rows of a tile's map; unknown (NaN) cells count nothing.

        Args:
            tile: where it lies.
            share: ``[H, W]``, its weights.
            values: ``[h, W]`` or ``[h, W, B]``, of these rows.
            own: rows of the tile.
        """
        place, cols = tile.place(self.grid, share.shape)
        first = place.start + own.start - self.rows.start
        rows = slice(first, first + own.stop - own.start)
        piece = values.reshape(*values.shape[:2], -1)[:, : cols.stop - cols.start]
        part = share[own, : cols.stop - cols.start]
        part = np.where(np.isfinite(piece).all(axis=-1), part, 0).astype(np.float32)
        self.total[rows, cols] += part[..., None] * np.nan_to_num(piece)
        self.weight[rows, cols] += part

    def done(self) -> np.ndarray:
        """The rows ``[h, W, B]`` in the unit of the pieces; NaN in cells where nothing was added."""
        with np.errstate(invalid="ignore"):
            self.total /= self.weight[..., None]  # 0 / 0 is NaN
        return self.total


@dataclass
class Piece:
    """A tile with a map on it.

    Attributes:
        tile: where it lies.
        grid: of the map.
        read: the map or maps of some of its rows.
        items: ids of the images that it has maps of.
    """

    tile: Tile
    grid: Grid
    read: Callable[[slice], Any]
    items: Sequence[str] = ()

    def share(self) -> np.ndarray:
        """Weights of the map's cells."""
        return self.tile.weights(self.grid.shape, self.grid.cell_size)

    def rows_within(self, whole: Grid, rows: slice) -> slice | None:
        """Those of its rows that lie in some rows of the whole."""
        place, _ = self.tile.place(whole, self.grid.shape)
        first, last = max(place.start, rows.start), min(place.stop, rows.stop)
        return slice(first - place.start, last - place.start) if first < last else None


def mosaic_tiles(plan: Plan, notes: list[str], read: Seen, progress: Progress) -> JsonObject:
    """Write model, trace and, where the tiles made one, the prior of the whole; see `sattools.fit.tiles.stage`.

    Args:
        plan: tiles and their scenes.
        notes: gets what a user should know.
        read: the images as they were when the fit began.
        progress: told the share done and what is being done.

    Raises:
        SceneError: a tile that is not fitted, or has other cells or bands than the others.
    """
    scene, names = plan.scene, plan.names()
    for name in names:
        if not (plan.root(name) / MODEL).exists():
            raise SceneError(f"{plan.root(name) / MODEL}: no such file, expected the model of a fitted tile")
    progress(1.0, f"joining {counted(len(names), 'tiles')}")
    common = FittedModel.load(scene.root / COMMON)
    models = {name: StoredModel.open(plan.root(name) / MODEL, in_memory=0) for name in names}
    check_maps_alike(models, lambda name: plan.root(name) / MODEL)
    notes = [*notes, *tell_other_options(plan.options, {name: plan.part_scene(name) for name in names})]
    # a fit may give its surface on the cells of the prior, finer than its own
    cell = models[names[0]].grid.cell_size if names else plan.finest
    whole = scene.require_grid().resized(cell)
    made: JsonObject = {}
    with one_result(scene):
        if plan.options.prior_weight > 0 and "prior_dsm" not in scene.products:
            _mosaic_priors(plan, names)
            made = record(scene, "prior", scene.train_items(), implicit=True)
        model = _streamed(plan, models, common, whole)
        notes = [f"{counted(len(names), 'tiles')} of up to {plan.options.tile:g} m", *notes]
        result = save_fit(scene, Fitted(model, _trace(plan, [COARSE, *names]), notes), made, read)
    if spent := plan.spent():
        result["parts"] = spent
    if plan.options.part == "all":
        at_the_end(lambda: remove_parts(scene.root))
    return result


def _streamed(plan: Plan, models: Mapping[str, StoredModel], common: FittedModel, whole: Grid) -> StreamedModel:
    """The model of the whole, of which rows are put together when they are asked for."""

    def piece(tile: Tile) -> Piece:
        if tile.name in models:
            model = models[tile.name]
            width = slice(0, model.grid.width)
            return Piece(tile, model.grid, lambda rows: model.maps(rows, width), model.about.items)
        grid = tile.grid.resized(whole.cell_size)
        return Piece(tile, grid, lambda rows: _resampled(common, grid.part(rows, slice(0, grid.width))))

    pieces = [piece(tile) for tile in plan.tiles]
    images = {name for model in models.values() for name in model.image_maps}

    def maps_of(rows: slice) -> dict[str, np.ndarray]:
        mosaics = {name: FeatheredMosaic(whole, rows, bands[name]) for name in CELL_MAPS}
        layers = {name: [FeatheredMosaic(whole, rows, 1) for _ in common.items] for name in images}
        for one in pieces:
            own = one.rows_within(whole, rows)
            if own is None:
                continue
            found, share = one.read(own), one.share()
            for name, mosaic in mosaics.items():
                mosaic.add(one.tile, share, getattr(found, name), own)
            for name, layers_of in found.images.items():
                for item, values in zip(one.items, layers_of, strict=True):
                    layers[name][common.items.index(item)].add(one.tile, share, values, own)
        done = {name: mosaic.done() for name, mosaic in mosaics.items()}
        per_image = {name: np.stack([one.done()[..., 0] for one in own]) for name, own in layers.items()}
        return {**done, "height": done["height"][..., 0], "height_std": done["height_std"][..., 0], **per_image}

    bands = {"height": 1, "height_std": 1, "albedo": common.albedo.shape[-1]}
    last = list(models.values())[-1].about if models else common
    about = replace(common.described(), grid=whole, softness=last.softness)
    colours = {name: getattr(common, name).numpy() for name in COLOURS}
    return StreamedModel(about, colours, bands["albedo"], tuple(sorted(images)), maps_of, _strip_rows(whole))


def _strip_rows(whole: Grid) -> int:
    return min(STRIP_ROWS, max(LEAST_ROWS, STRIP_CELLS // whole.width))


def _resampled(model: FittedModel, grid: Grid) -> CellMaps:
    """The maps of a model on another grid, without those of single images."""
    height, std, albedo = (sample_map(getattr(model, name).numpy(), model.grid, grid) for name in CELL_MAPS)
    return CellMaps(height, std, albedo, {})


def _mosaic_priors(plan: Plan, names: list[str]) -> None:
    """The tiles' matched surfaces as the scene's own; where a tile has none, the coarse one without confidence."""
    from sattools.prior.files import CONFIDENCE, DSM, SURROUNDINGS, WATER, MapFiles

    whole = plan.scene.require_grid()
    rough, rough_grid = read_raster(plan.root(COARSE) / DSM)

    def water_of(name: str, part: Grid) -> np.ndarray:
        path = plan.root(name) / WATER  # tiles of an earlier version have none
        return read_on(path, part)[0] if path.exists() else np.zeros(part.shape, np.float32)

    def piece(tile: Tile) -> Piece:
        folder = plan.root(tile.name)
        grid = raster_grid(folder / DSM) if tile.name in names else tile.grid

        def read(rows: slice) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
            part = grid.part(rows, slice(0, grid.width))
            if tile.name in names:
                height, confidence = (read_raster(folder / href, part)[0][0] for href in (DSM, CONFIDENCE))
                return height, confidence, water_of(tile.name, part)
            height = sample_map(rough[0], rough_grid, part)
            return height, np.zeros_like(height), water_of(COARSE, part)

        return Piece(tile, grid, read)

    pieces = [piece(tile) for tile in plan.tiles]
    with MapFiles(plan.scene, whole) as files:
        strip = _strip_rows(whole)
        for first in range(0, whole.height, strip):
            last = min(first + strip, whole.height)
            rows = files.around(slice(first, last))
            mosaics = [FeatheredMosaic(whole, rows, 1) for _ in range(3)]
            for one in pieces:
                own = one.rows_within(whole, rows)
                if own is not None:
                    share = one.share()
                    for mosaic, values in zip(mosaics, one.read(own), strict=True):
                        mosaic.add(one.tile, share, values, own)
            height, confidence, water = (mosaic.done()[..., 0] for mosaic in mosaics)
            files.write(height, confidence, slice(first, last), water >= 0.5)  # of its height, at least
    around = plan.root(COARSE) / SURROUNDINGS
    if around.exists():  # coarse ones do for shadows
        write_bytes(plan.scene.output(SURROUNDINGS), around.read_bytes())
        plan.scene.products[AROUND] = SURROUNDINGS


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
