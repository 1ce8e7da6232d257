"""The prior of a large area: its tiles are matched one after the other, so that memory does not grow with the area."""

from __future__ import annotations

import logging
import math
import time
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from sattools.prior.matched import Matched, make_frame, match_area, matching_height
from sattools.prior.options import PriorOptions
from sattools.prior.resume import KeptTiles, MatchedTile
from sattools.prior.tones import common_balance
from sattools.progress import Progress, subprogress
from sattools.scene import Grid, Item, Scene
from sattools.scene.regrid import sample_map
from sattools.scene.stored import new_map, pieces
from sattools.scene.tiles import Tile, make_tiles
from sattools.views import RadiometricBalance, Source, load_sources, views_on

AT_ONCE = 1 << 20  # cells of an area that is matched as a whole
TILE_CELLS = 512  # about so many along an edge of a tile, without its overlap
SMALLER_CELLS = (256, 128)  # the same where memory is scarce: small tiles match worse
OVERLAP_M = 32.0  # by which a tile reaches into its neighbours, at least
OVERLAP_CELLS = 32
MOST_OVERLAP = 0.4  # of a tile's edge: cells of less than 0.14 m would have more in common than of their own
LEAST_SHOWN = 0.1  # of a tile that an image must show to be used there
SAMPLES = 4  # tiles that tell the images' contrast

log = logging.getLogger(__name__)


class _Means:
    """Means over the tiles' cells."""

    def __init__(self) -> None:
        self._cells, self._seen, self._consistent = 0, 0.0, 0.0
        self._agreement: dict[str, list[float]] = {}
        self._shares: dict[str, list[float]] = {}
        self._pairs: set[tuple[str, str]] = set()
        self._bent = ("", 0.0)

    def add(self, found: Matched | None, cells: int) -> None:
        """Count a tile of so many cells; None: nothing was found there."""
        self._cells += cells
        if found is None:
            return
        self._seen += found.seen_by_two * cells
        self._consistent += found.consistent_in_two * cells
        self._pairs.update(found.pairs)
        self._bent = max(self._bent, found.bent, key=lambda bent: bent[1])
        for name, value in found.agreement.items():
            if value is not None:
                self._agreement.setdefault(name, []).append(value)
        for name, share in found.shares.items():
            self._shares.setdefault(name, []).append(share)

    def of(self, height: np.ndarray, confidence: np.ndarray, ids: Sequence[str]) -> Matched:
        """What was found of all tiles together."""
        agreement = {name: float(np.mean(self._agreement[name])) if name in self._agreement else None for name in ids}
        seen, consistent = self._seen / self._cells, self._consistent / self._cells
        shares = {name: float(np.mean(self._shares[name])) for name in ids if name in self._shares}
        return Matched(height, confidence, sorted(self._pairs), agreement, seen, consistent, self._bent, shares)


def match_tiles(
    scene: Scene,
    items: Sequence[Item],
    grid: Grid,
    around: Grid,
    options: PriorOptions,
    progress: Progress,
    *,
    edge: int | None = None,
    kept: KeptTiles | None = None,
) -> Matched | None:
    """Match an area tile by tile.

    What brings the images to one brightness is found once, on large cells, so that tiles agree on it. Where fewer than
    two images show a tile, heights are those of a coarse match of all, without confidence.

    Args:
        scene: of the images.
        items: the images.
        grid: of the area, which the figures are of.
        around: the same with what stands around it, which is matched.
        options: of the matching.
        progress: share done.
        edge: about so many cells along that of a tile, without its overlap; None = `TILE_CELLS`.
        kept: tiles that are finished, which are taken as they are; gets those that are matched.

    Returns:
        The maps of ``around``, to be read by rows (`sattools.scene.stored`); None where no two images look from
        different directions.

    Raises:
        SceneError: an image that shows nothing of the area.
    """
    edge = edge or TILE_CELLS
    tiles = tiles_of(around, edge)
    z_range = scene.require_height_range()
    coarse = coarse_of(around, tiles)
    sources = _sources(scene, items, coarse)
    unseen = _unseen(sources, coarse, tiles, z_range)
    balances = _balances(scene, sources, coarse, tiles, unseen, options)
    maps = tuple(new_map(around.shape, np.float32, scene.root) for _ in range(3))
    means, rough = _Means(), None
    if kept and (count := kept.count(edge)):
        log.warning("scene %s: goes on with %d of %d tiles that are matched", scene.id, count, len(tiles))
    for k, tile in enumerate(tiles):
        part = subprogress(progress, k / len(tiles), (k + 1) / len(tiles))
        part(0.0, f"tile {k + 1} of {len(tiles)}")
        done, started = (kept.read(tile, edge) if kept else None), time.perf_counter()
        if done is None:
            own = [item for item in items if item.id not in unseen[tile.name]]
            found = None
            if len(own) >= 2:
                shown = [replace(source, balance=balances[source.id]) for source in _sources(scene, own, tile.grid)]
                found = match_area(shown, tile.grid, z_range, options, part, of=grid)
            if found is not None:
                done = MatchedTile.of(found)
            else:
                rough = rough or match_area(sources, coarse, z_range, options)
                if rough is None:
                    return None
                there = sample_map(rough.height, coarse, tile.grid)
                done = MatchedTile(there, np.zeros_like(there), None)
            if kept:
                kept.keep(tile, edge, replace(done, seconds=time.perf_counter() - started))
        rows, cols = tile.grid.window(grid)
        means.add(done.match(), (rows.stop - rows.start) * (cols.stop - cols.start))
        _add(tile, around, maps, done.height, done.confidence)
    height, confidence, weight = maps
    for rows in pieces(around.shape):
        share = weight[rows]
        height[rows], confidence[rows] = height[rows] / share, confidence[rows] / share
    return means.of(height, confidence, [item.id for item in items])


def tiles_of(around: Grid, edge: int) -> list[Tile]:
    """Tiles into which an area is cut evenly.

    Args:
        around: the area with what stands around it.
        edge: about so many cells along that of a tile, without its overlap.
    """
    cell = around.cell_size
    edges = _edge(around.height, edge) * cell, _edge(around.width, edge) * cell
    overlap = min(max(OVERLAP_M, OVERLAP_CELLS * cell), MOST_OVERLAP * min(edges))
    return make_tiles(around, edges, overlap, cell)


def coarse_of(around: Grid, tiles: Sequence[Tile]) -> Grid:
    """Cells of all tiles together, about as many as those of one of them."""
    return around.resized(around.cell_size * math.ceil(math.sqrt(len(tiles))))


def _edge(cells: int, wanted: int) -> int:
    """Cells along an edge of the tiles into which an axis is cut evenly: short ones at the border match worse."""
    count = round(cells / wanted)
    return math.ceil(cells / count) if count > 1 else max(cells, wanted)


def _add(tile: Tile, grid: Grid, maps: tuple[np.ndarray, ...], height: np.ndarray, confidence: np.ndarray) -> None:
    """Add a tile's heights and confidence with its weights to the sums of the whole, and these to the last of them."""
    share = tile.weights(height.shape, grid.cell_size)
    where, inside = grid.window(tile.grid), tile.grid.window(grid)
    for total, values in zip(maps, (share * height, share * confidence, share), strict=True):
        total[where] = total[where] + values[inside]


def _sources(scene: Scene, items: Sequence[Item], grid: Grid) -> list[Source]:
    """The images as far as they show a grid, reduced to its cells."""
    return load_sources(replace(scene, grid=grid), items)


def _unseen(
    sources: list[Source], coarse: Grid, tiles: Sequence[Tile], z_range: tuple[float, float]
) -> dict[str, set[str]]:
    """Images that show less than `LEAST_SHOWN` of a tile, by its name."""
    views = views_on(sources, coarse, matching_height(z_range), z_range)
    return {tile.name: {v.id for v in views if v.mask[coarse.window(tile.grid)].mean() < LEAST_SHOWN} for tile in tiles}


def _balances(
    scene: Scene,
    sources: list[Source],
    coarse: Grid,
    tiles: Sequence[Tile],
    unseen: dict[str, set[str]],
    options: PriorOptions,
) -> dict[str, RadiometricBalance]:
    """How every image becomes grey as the others are, by its id; with the contrast that it has in tiles."""

    def of(own: list[Source], grid: Grid, tone: float | None = None) -> list[RadiometricBalance]:
        return common_balance(*make_frame(own, grid, scene.require_height_range(), options.window, tone))

    found = of(sources, coarse)
    tone = found[0].tone
    complete = [tile for tile in tiles if not unseen[tile.name]] or list(tiles)
    some = [complete[round(k)] for k in np.linspace(0, len(complete) - 1, min(SAMPLES, len(complete)))]
    contrast = [
        of(_sources(scene, [item for item in scene.items if item.id in shown], tile.grid), tile.grid, tone)[0].contrast
        for tile in some
        if len(shown := {source.id for source in sources} - unseen[tile.name]) >= 2
    ]
    if contrast:
        found = [replace(balance, contrast=float(np.mean(contrast))) for balance in found]
    return {source.id: balance for source, balance in zip(sources, found, strict=True)}


__all__ = ["AT_ONCE", "SMALLER_CELLS", "TILE_CELLS", "coarse_of", "match_tiles", "tiles_of"]
