"""How an area is cut into tiles, what they share, and what is done of them; see `sattools.fit.tiles.stage`."""

from __future__ import annotations

import hashlib
import json
import logging
import math
import time
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import torch

from sattools import __version__
from sattools.errors import SceneError, counted
from sattools.fit.described import COLOURS
from sattools.fit.files import CHECKPOINT, MODEL
from sattools.fit.foresight import side_by_side
from sattools.fit.model import FittedModel
from sattools.fit.options import FitOptions
from sattools.fit.resume import ANEW, OTHER_FIT
from sattools.fit.surface.schedule import own_cell, schedule
from sattools.fit.tiles.clearing import COMMON, WHOLE, remove_parts
from sattools.fit.tiles.crew import Part, fit_parts
from sattools.fit.tiles.shared import PRODUCT
from sattools.fit.tiles.state import COARSE, STATE, read_state, write_state
from sattools.fit.whole import fit_whole
from sattools.prior.matched import matching_height
from sattools.progress import Progress, subprogress
from sattools.scene import Grid, Scene
from sattools.scene.area import wanted_cells
from sattools.scene.copies import href_of_part, part_copy
from sattools.scene.dependencies import ALBEDO_SECONDS, PRIOR_SECONDS
from sattools.scene.document import PARTS
from sattools.scene.files import write_text
from sattools.scene.jsonio import JsonObject
from sattools.scene.raster import raster_grid
from sattools.scene.tiles import Tile, common_cell, make_tiles, reach_beyond
from sattools.views import BALANCE_PROPERTY, RadiometricBalance, Source, load_sources, used_assets, views_on

log = logging.getLogger(__name__)
FINE_ENOUGH = 4  # times a tile's cells: cells up to which a fit of the whole shows shadows and shifts of the images
LEAST_SHOWN = 0.1  # of a tile that an image must show to be used there
ONLY_COARSE = ("lines of sight are parallel only", "strayed from the prior")  # notes of a coarse fit
PRIOR = ("prior_dsm", "prior_confidence", "prior_normals", "prior_surroundings", "prior_water")
# of an option, what does not change the result
_HOUSEKEEPING = ("resume", "part", "device")


@dataclass
class Plan:
    """A scene with its tiles.

    Attributes:
        scene: the whole.
        options: of the fit.
        tiles: row by row.
        finest: cell of the fitted surface [m].
        factor: cells of the coarse fit per cell of a tile's, along an axis.
    """

    scene: Scene
    options: FitOptions
    tiles: list[Tile]
    finest: float
    factor: int

    @classmethod
    def make(cls, scene: Scene, options: FitOptions) -> Plan:
        """Cut a scene. Raises SceneError where no tiles of that size can be cut."""
        grid = scene.require_grid()
        stages = schedule(options, own_cell(scene), scene.require_height_range(), options.prior_weight > 0)
        cells = [grid.cell_size, stages[0].cell_size, stages[-1].cell_size]
        if PRIOR[0] in scene.products and options.prior_weight > 0:
            cells.append(raster_grid(scene.path(scene.products[PRIOR[0]])).cell_size)
        assert options.tile is not None
        assert options.tile != "auto"  # `sattools.fit.stage.fit` has chosen
        tiles = make_tiles(grid, options.tile, options.overlap, common_cell(cells))
        # as many cells as a tile has without its overlap: the whole is seen by more pixels, which take memory, too
        factor = math.ceil(math.sqrt(len(tiles)))
        return cls(scene, options, tiles, stages[-1].cell_size, factor)

    def root(self, name: str) -> Path:
        """Folder of a tile's scene."""
        return self.scene.root / PARTS / name

    def names(self) -> list[str]:
        """Tiles that enough images show; SceneError before `split` has found them."""
        names = (read_state(self.scene.root) or {}).get("tiles")
        if names is None:
            raise SceneError(f"{self.scene.root / STATE}: found no finished --part split, expected one before mosaic")
        return list(names)

    def pilots(self) -> list[str]:
        """Pilot tiles that `coarse` has chosen."""
        return list((read_state(self.scene.root) or {}).get("pilots") or [])

    def part_scene(self, name: str) -> Scene:
        """The scene of a tile, as `split` left it."""
        return Scene.from_file(self.root(name) / "scene.json")

    # ---- steps ------------------------------------------------------------------------------------------

    def coarse(self, progress: Progress) -> list[str]:
        """Fit the whole coarsely and write the scenes of the pilot tiles, unless an earlier run has; notes."""
        started = time.perf_counter()
        state = self.begun()
        if state is None:
            self.begin(None)
        elif state.get("pilots") is not None or state["tiles"] is not None:
            return list(state["notes"])
        coarse = self._coarse_scene()
        options = replace(self._own_options(), tile=None, resolution=self.finest * self.factor)
        options = replace(options, resume=(coarse.root / CHECKPOINT).exists())
        if options.coarsest:
            options = replace(options, coarsest=options.coarsest * self.factor)
        result = fit_whole(coarse, options, lambda share, message: progress(share, f"whole area, coarsely: {message}"))
        # what is only coarse about the coarse fit is not worth a note
        notes = [text for text in result["notes"] if not any(words in text for words in ONLY_COARSE)]
        names = []
        if self.factor > FINE_ENOUGH:
            unseen = self._unseen(coarse, load_sources(coarse, coarse.train_items()))
            for tile in self._chosen(unseen, [item.id for item in coarse.train_items()]):
                one = self._tile_scene(tile, f"pilot.{tile.name}", unseen)
                one.write()
                names.append(one.root.name)
        self._write_state(None, notes, time.perf_counter() - started, names)
        return notes

    def split(self, progress: Progress) -> list[str]:
        """Find what the tiles share and write their scenes; notes."""
        with_pilots = self.factor > FINE_ENOUGH
        notes = self.coarse(subprogress(progress, 0, 0.4 if with_pilots else 1.0))
        started = time.perf_counter()
        state = read_state(self.scene.root)
        assert state is not None  # `coarse` has written it
        if state["tiles"] is not None:
            return notes
        coarse = self._coarse_scene()
        sources = load_sources(coarse, coarse.train_items())
        unseen = self._unseen(coarse, sources)
        model = FittedModel.load(coarse.root / MODEL)
        pilots, told = self._pilots(state["pilots"], subprogress(progress, 0.4, 1.0))
        notes += told
        if pilots:
            model = override_shared(model, [FittedModel.load(one.root / MODEL) for one in pilots])
        model.save(self.scene.output(COMMON))
        makes_prior = self.options.prior_weight > 0 and PRIOR[0] not in self.scene.products
        balances = self._balances(coarse, sources, pilots) if makes_prior else {}
        names = []
        for tile in self.tiles:
            wanted = wanted_cells(self.scene, tile.grid)
            if wanted is not None and not wanted.any():
                continue  # its surface is the coarse one, which `export` leaves out
            shown = [item.id for item in self.scene.train_items() if item.id not in unseen[tile.name]]
            if len(shown) < 2:
                who = f"{counted(len(shown), 'images')} {'shows' if len(shown) == 1 else 'show'} it"
                notes.append(f"tile {tile.name}: {who}, its surface is the coarse one")
                log.warning(notes[-1])
                continue
            one = self._tile_scene(tile, tile.name, unseen)
            one.products[PRODUCT] = href_of_part(self.scene, one.root, self.scene.root / COMMON)
            for item in one.items:
                if item.id in balances:
                    item.properties[BALANCE_PROPERTY] = asdict(balances[item.id])
            one.write()
            names.append(tile.name)
        write_text(self.scene.output(WHOLE), self.scene.to_json(root="../..") + "\n")
        seconds = state["seconds"] + time.perf_counter() - started
        self._write_state(names, notes, seconds, state["pilots"])
        return notes

    def fit(self, progress: Progress) -> list[str]:
        """Fit the tiles that are not fitted yet, several at a time; notes."""
        names = self.names()
        number = {tile.name: k for k, tile in enumerate(self.tiles)}
        called = {name: f"tile {number[name] + 1} of {len(self.tiles)}" for name in names}
        return self._fit_parts(called, {name: f"tile {name}" for name in names}, self._own_options(), progress)

    def _fit_parts(
        self, called: Mapping[str, str], noted: Mapping[str, str], options: FitOptions, progress: Progress
    ) -> list[str]:
        """Fit scenes of parts by their names, each with what it is called while it is fitted and in notes."""
        left = [name for name in called if not (self.root(name) / MODEL).exists()]
        parts = [Part(called[name], self.root(name), options) for name in left]
        found = fit_parts(parts, side_by_side(self.scene, self.options, len(left)), progress)
        return [f"{noted[name]}: {text}" for name, notes in zip(left, found, strict=True) for text in notes]

    # ---- state ------------------------------------------------------------------------------------------

    def begin(self, names: list[str] | None) -> None:
        """Forget the tiles of an earlier fit."""
        self.scene.output(STATE)  # raises where a link leads elsewhere
        remove_parts(self.scene.root)
        self._write_state(names, [], pilots=names)

    def spent(self) -> JsonObject:
        """Seconds of `split` and of the tiles, those of them for priors and for albedo, and the most memory one took.

        Empty where they were not fitted by commands of their own.
        """
        parts = [*self.names(), *self.pilots()]
        entries = [entry for name in parts for entry in self.part_scene(name).history]
        if not entries:
            return {}
        split = float((read_state(self.scene.root) or {}).get("seconds", 0.0))
        steps = {name: sum(e.get(name, 0.0) for e in entries) for name in (PRIOR_SECONDS, ALBEDO_SECONDS)}
        return {
            "tiles": len(self.names()),
            "seconds": round(split + sum(entry["seconds"] for entry in entries), 3),
            **{name: round(seconds, 3) for name, seconds in steps.items() if seconds},
            "peak_memory_mb": max(entry["peak_memory_mb"] for entry in entries),
        }

    def begun(self) -> JsonObject | None:
        """What an earlier run has left for this one to go on with; SceneError where it is of another fit."""
        if not self.options.resume:
            return None
        state, checkpoint = read_state(self.scene.root), self.scene.path(CHECKPOINT)
        if state is not None and state["key"] != self._key():
            raise SceneError(f"{self.scene.root / STATE}: {OTHER_FIT}")
        if state is None and checkpoint.exists():
            raise SceneError(f"{checkpoint}: found a checkpoint of a fit all at once, expected one in tiles; {ANEW}")
        return state

    def _write_state(
        self, names: list[str] | None, notes: list[str], seconds: float = 0.0, pilots: list[str] | None = None
    ) -> None:
        state = {
            "key": self._key(), "tile": self.options.tile, "tiles": names, "pilots": pilots, "notes": notes,
            "seconds": round(seconds, 3),
        }  # fmt: skip
        write_state(self.scene.output(STATE), state)

    def _key(self) -> str:
        """Hash of everything that the tiles depend on."""
        options = {name: value for name, value in asdict(self.options).items() if name not in _HOUSEKEEPING}
        scene = self.scene
        items = scene.train_items()
        paths = [scene.path(item.assets[name].href) for item in items for name in used_assets(item.assets)]
        paths += [scene.path(scene.products[name]) for name in PRIOR if name in scene.products]
        digests = []
        for path in paths:
            try:
                with open(path, "rb") as file:
                    digests.append(hashlib.file_digest(file, "sha256").hexdigest())
            except OSError as error:
                raise SceneError(f"{path}: cannot be read ({error.strerror}), expected a file of the scene") from error
        what: list[Any] = [__version__, options, scene.require_grid().to_dict(), scene.height_range_m, digests]
        what += [[item.id, item.properties] for item in items]
        return hashlib.sha256(json.dumps(what, sort_keys=True, default=str).encode()).hexdigest()

    # ---- parts ------------------------------------------------------------------------------------------

    def _own_options(self) -> FitOptions:
        """Of what is fitted of the whole: held-out images are left out already."""
        return replace(self.options, holdout=[], views="all", part="all")

    def _scene(self, name: str, grid: Grid) -> Scene:
        one = part_copy(self.scene, self.root(name))
        one.id, one.grid = f"{self.scene.id[:100]}.{name}", grid
        one.products, one.history = {}, []
        return one

    def _coarse_scene(self) -> Scene:
        whole = self.scene.require_grid()
        coarse = self._scene(COARSE, whole.resized(whole.cell_size * self.factor))
        for item in coarse.items:
            if item.properties.get("gsd"):  # their pixels are read as coarsely, and matched on these cells
                item.properties["gsd"] *= self.factor
        return coarse

    def _tile_scene(self, tile: Tile, name: str, unseen: dict[str, set[str]]) -> Scene:
        one = self._scene(name, tile.grid)
        one.surroundings_m = reach_beyond(self.options.overlap)
        for item in one.items:
            if item.id in unseen[tile.name]:
                item.properties["sattools:role"] = "test"
        if self.options.prior_weight > 0:
            given = [product for product in PRIOR if product in self.scene.products]
            paths = {product: self.scene.path(self.scene.products[product]) for product in given}
            one.products = {product: href_of_part(self.scene, one.root, path) for product, path in paths.items()}
        return one

    def _unseen(self, coarse: Scene, sources: list[Source]) -> dict[str, set[str]]:
        """Images that show less than `LEAST_SHOWN` of a tile, by its name.

        They must show it at the height of the coarse surface and at that at which the matching looks at all images, as
        a surface that half of the images do not see may have any height.
        """
        model = FittedModel.load(coarse.root / MODEL)
        grid, z_range = model.grid, coarse.require_height_range()
        unseen: dict[str, set[str]] = {tile.name: set() for tile in self.tiles}
        for z_ref in (model.z_ref, matching_height(z_range)):
            for view in views_on(sources, grid, z_ref, z_range):
                for tile in self.tiles:
                    rows, cols = grid.window(tile.grid)
                    if view.mask[rows, cols].mean() < LEAST_SHOWN:
                        unseen[tile.name].add(view.id)
        return unseen

    def _chosen(self, unseen: dict[str, set[str]], ids: list[str]) -> list[Tile]:
        """One tile of every quarter of the area: that which most images show, next to the middle.

        Only tiles that show the first image, whose colours are the scale of all others, can tell.
        """
        grid = self.scene.require_grid()
        chosen: dict[tuple[bool, bool], tuple[int, float, Tile]] = {}
        for tile in self.tiles:
            row, col = (tile.rows.start + tile.rows.stop) / 2, (tile.cols.start + tile.cols.stop) / 2
            off = math.hypot(abs(row / grid.height - 0.5) - 0.25, abs(col / grid.width - 0.5) - 0.25)
            quarter = (2 * row < grid.height, 2 * col < grid.width)
            best = chosen.get(quarter)
            rank = (len(unseen[tile.name]), off)
            if ids[0] not in unseen[tile.name] and (best is None or rank < best[:2]):
                chosen[quarter] = (*rank, tile)
        return [tile for missing, _, tile in chosen.values() if len(ids) - missing >= 2]

    def _pilots(self, names: list[str], progress: Progress) -> tuple[list[Scene], list[str]]:
        """Fit the pilot tiles by themselves, unless commands of their own have; their scenes, and notes."""
        called = {name: f"pilot tile {k + 1} of {len(names)}" for k, name in enumerate(names)}
        noted = {name: name.replace(".", " tile ") for name in names}
        notes = self._fit_parts(called, noted, replace(self._own_options(), tile=None), progress)
        return [self.part_scene(name) for name in names], notes

    def _balances(self, coarse: Scene, sources: list[Source], pilots: list[Scene]) -> dict[str, RadiometricBalance]:
        """How the images are matched for the priors of the tiles, by item; contrast as it is in tiles."""
        from sattools.prior.matched import make_frame
        from sattools.prior.options import PriorOptions
        from sattools.prior.tones import common_balance

        def balances(scene: Scene, own: list[Source], tone: float | None = None) -> list[RadiometricBalance]:
            area = scene.require_grid(), scene.require_height_range()
            return common_balance(*make_frame(own, *area, PriorOptions().window, tone))

        whole = balances(coarse, sources)
        if pilots:
            shown = [(one, load_sources(one, one.train_items()), whole[0].tone) for one in pilots]
            fine = [balances(*one)[0].contrast for one in shown]
            whole = [replace(balance, contrast=sum(fine) / len(fine)) for balance in whole]
        return dict(zip((s.id for s in sources), whole, strict=True))


def override_shared(model: FittedModel, pilots: Sequence[FittedModel]) -> FittedModel:
    """The coarse fit with the medians of the pilots' colours and poses where they show an image."""
    shared = {name: getattr(model, name).clone() for name in COLOURS}
    for k, name in enumerate(model.items):
        own = [(pilot, pilot.items.index(name)) for pilot in pilots if name in pilot.items]
        for what in COLOURS if own else ():
            shared[what][k] = torch.stack([getattr(pilot, what)[i] for pilot, i in own]).median(dim=0).values
        if not own:
            shared["pose"][k] = 0.0  # cells of the whole are too large to tell
    return replace(model, **shared, shadow=pilots[0].shadow, transient=pilots[0].transient)


__all__ = ["Plan"]
