"""The stage `prior`: images and cameras become a rough surface with its confidence, by matching alone."""

from __future__ import annotations

import logging
from dataclasses import replace

import numpy as np

from sattools.errors import SceneError
from sattools.prior.brightness import brightness_of_blocks
from sattools.prior.cells import grids
from sattools.prior.files import CONFIDENCE, DATUM, DSM, MapFiles, write_sensor_map, write_surroundings
from sattools.prior.foresight import check_fits, plan_matching, warn_of_tiles
from sattools.prior.gate import (
    NO_STEREO,
    check_count,
    check_step,
    outputs,
    per_image_href,
    warn_of_base,
    warn_of_window,
)
from sattools.prior.matched import Matched, match_area, matching_height
from sattools.prior.options import PriorOptions
from sattools.prior.project import seen_by
from sattools.prior.resume import KeptTiles, remove_tiles
from sattools.prior.surroundings import with_surroundings
from sattools.prior.tiled import match_tiles
from sattools.prior.water import SURE, level_water
from sattools.progress import Progress, silent, subprogress
from sattools.scene import Asset, Grid, Item, Scene
from sattools.scene.dependencies import EARLIER_SECONDS, MADE, begin, record, seen
from sattools.scene.document import GEOTIFF_TYPE
from sattools.scene.jsonio import JsonObject
from sattools.scene.regrid import resize_map
from sattools.scene.runner import at_the_end
from sattools.scene.stored import map_like, pieces
from sattools.views import Opened, Source, load_sources, open_images, warn_of_blank
from sattools.views.check import check_extent

LEAST_TOLD = 0.005  # of the area, which is named
LEAST_SURE = 0.02  # of what two of more images see: less were 0.001 to 0.003, 9 m and more off; right ones from 0.05 on
# of what two of so many images see; before unlike images could differ more in brightness: with less than 0.5 12 of 12
# pairs were 5 to 16 m off, else 15 of 20 below 5; of three images with less than 0.62 13 of 13 sets 3 to 8.4 m, else 26
# of 28 below 4. The same sets now agree about 0.01 to 0.03 (pairs) and 0.06 to 0.11 (three) more.
LEAST_ALIKE = {2: 0.55, 3: 0.7}
COUNTS = 0.9  # of what the others do: an image that counts less is named

log = logging.getLogger(__name__)


def prior(
    scene: Scene,
    options: PriorOptions,
    progress: Progress = silent,
    overwrite: bool = True,
    implicit: bool = False,
    sources: list[Source] | None = None,
    *,
    anew: bool | None = None,
) -> JsonObject:
    """Match the scene's training images; writes height, confidence and what follows below ``prior/`` of the root.

    Of what is matched in tiles every one is kept as soon as it is finished, until the surface is there: another run
    with the same images and options goes on with them.

    Args:
        scene: gets the products.
        options: of the matching.
        progress: share done.
        overwrite: replace products that are there.
        implicit: whether another stage asks for it, which may then make it anew for other images.
        sources: the training images, if they have been read already.
        anew: take up no tiles of an interrupted run; None = where ``overwrite`` is True.

    Returns:
        Notes and figures for the history.

    Raises:
        SceneError: fewer than two usable images, or none from different directions.
        OutputExistsError: a product exists, ``overwrite`` is False, and it was so for the run that goes on here.
    """
    items = scene.train_items()
    if overwrite if anew is None else anew:
        remove_tiles(scene)
    kept = KeptTiles(scene, items, options, overwrite)
    begin(scene, "prior", outputs(items, options), kept.may_replace)
    check_count(scene, items)
    read = seen(scene, "prior", items)
    grid, fine = grids(scene, items, options)
    z_range = scene.require_height_range()
    notes = warn_of_window(scene, fine, options) + warn_of_base(scene, items)
    progress(0.0, "reading images")
    part = subprogress(progress, 0.2, 0.9)
    images = open_images(scene, items)  # which looks at the scene's own grid
    check_extent(grid)
    check_step(scene, options, fine.cell_size)
    shapes = [image.shape for image in images.parts]
    wide = with_surroundings(fine, images.cameras, shapes, matching_height(z_range), scene.surroundings_m)
    if wide != grid:
        sources = None  # the ones given were read for other cells
    plan = plan_matching(scene, items, fine, wide, options, whole=sources is not None, kept=kept)
    check_fits(scene, plan, len(items))
    notes += warn_of_tiles(scene, plan)
    if plan.edge:
        found = match_tiles(scene, items, fine, wide, options, part, edge=plan.edge, kept=kept)
    else:
        sources = load_sources(replace(scene, grid=wide), items, images) if sources is None else sources
        notes += [] if implicit else warn_of_blank(sources)  # the stage that asks for it tells of its images itself
        found = match_area(sources, wide, z_range, options, part, of=fine)
    if found is None:
        raise SceneError(f"scene {scene.id}: {NO_STEREO}")
    if options.water == "level":
        looks = brightness_of_blocks(scene, items, images, wide)
        water = level_water(found.height, found.confidence, wide.cell_size, looks, len(found.pairs))
        found = replace(found, water=water)
    around, everything = _wide_cells(grid, fine, wide, found.height)
    found = _within(fine, wide, found)
    if fine != grid:
        found = replace(
            found,
            height=_on(grid, found.height, fine),
            confidence=_on(grid, found.confidence, fine),
            water=None if found.water is None else _on(grid, found.water, fine) >= 0.5,  # of a cell, at least
        )

    progress(0.9, "writing")
    write_maps(scene, found.height, found.confidence, grid, found.water)
    write_surroundings(scene, everything, around if around not in (fine, grid) else None)
    if options.per_image:
        maps = np.asarray(found.height), np.asarray(found.confidence)
        _per_image(scene, items, images, grid, maps, progress=subprogress(progress, 0.92, 1.0))
    progress(1.0, "matched")
    at_the_end(lambda: remove_tiles(scene))
    return {
        "notes": notes + _notes(scene, found, len(items), grid),
        "prior": {
            "pairs": [list(pair) for pair in found.pairs],
            "seen_by_two": round(found.seen_by_two, 4),
            "consistent_in_two": round(found.consistent_in_two, 4),
            "mean_confidence": round(_mean(found.confidence), 4),
            "left_out_agreement": {
                name: None if value is None else round(value, 4) for name, value in found.agreement.items()
            },
            "image_weights": {name: round(share, 3) for name, share in found.shares.items()},
        },
        MADE: record(scene, "prior", items, read, implicit=implicit),
        **({EARLIER_SECONDS: round(kept.earlier_s, 3)} if kept.earlier_s else {}),
    }


def _wide_cells(grid: Grid, fine: Grid, wide: Grid, height: np.ndarray) -> tuple[Grid, np.ndarray]:
    """What was matched of an area and its surroundings, on cells that are no smaller than the surface's.

    Args:
        grid: of the surface.
        fine: the same area on the cells of the matching.
        wide: the same with its surroundings.
        height: ``[H, W]`` on these [m].
    """
    times = round(grid.cell_size / fine.cell_size)
    if times <= 1:
        return wide, height
    # whole cells of the surface, which it shares its corners with
    whole = []
    for inside, cells in zip(wide.window(fine), wide.shape, strict=True):
        first = inside.start % times
        whole.append(slice(first, cells - (cells - first) % times))
    matched = wide.part(*whole)
    around = matched.resized(grid.cell_size)
    return around, _on(around, height[tuple(whole)], matched)


def _within(grid: Grid, around: Grid, found: Matched) -> Matched:
    """What was found of an area, of that and its surroundings."""
    rows, cols = around.window(grid)

    def cut_out(values: np.ndarray) -> np.ndarray:
        own = map_like(values, grid.shape, values.dtype)
        for part in pieces(grid.shape):
            own[part] = values[rows.start + part.start : rows.start + part.stop, cols]
        return own

    if around == grid:
        return found
    water = None if found.water is None else cut_out(found.water)
    return replace(found, height=cut_out(found.height), confidence=cut_out(found.confidence), water=water)


def _on(grid: Grid, values: np.ndarray, matched: Grid) -> np.ndarray:
    """What was matched on other cells on those of a grid ``[H, W]``: means, or bilinear; some rows at a time."""
    found = np.empty(grid.shape, np.float32)
    finer, wider = (max(1, round(one.cell_size / other.cell_size)) for one, other in ((grid, matched), (matched, grid)))
    for rows in pieces((grid.height, grid.width * finer**2)):
        # rows of the matching, one more on either side for what lies between them
        first = max(0, rows.start // wider - 1) if wider > 1 else rows.start * finer
        last = min(matched.height, -(-rows.stop // wider) + 1) if wider > 1 else rows.stop * finer
        top, bottom = (row * wider // finer for row in (first, last))
        own = grid.part(slice(top, bottom), slice(0, matched.width * wider // finer))
        part = resize_map(values[first:last], matched.part(slice(first, last), slice(0, matched.width)), own)
        found[rows] = part[rows.start - top : rows.stop - top, : grid.width]
    return found


def write_maps(
    scene: Scene, height: np.ndarray, confidence: np.ndarray, grid: Grid, water: np.ndarray | None = None
) -> None:
    """Write height [m] and confidence, both ``[H, W]``, and what follows from them, as the scene's prior.

    That is the probability of a height to be less than 1 m off, how far off it may be, and its normals.

    Args:
        scene: gets the products.
        height: ``[H, W]`` [m].
        confidence: ``[H, W]`` in [0, 1].
        grid: of the maps.
        water: ``[H, W]``, whether it was laid level as such; None = nowhere.
    """
    with MapFiles(scene, grid) as files:
        for rows in pieces(grid.shape):
            around = files.around(rows)
            files.write(height[around], confidence[around], rows, None if water is None else water[around])


def _mean(values: np.ndarray, least: float | None = None) -> float:
    """Of a map, some rows at a time; or the share of its cells that have so much at least."""

    def total(part: np.ndarray) -> float:
        return float(part.sum(dtype=np.float64) if least is None else np.count_nonzero(part >= least))

    return sum(total(values[rows]) for rows in pieces((values.shape[0], values.shape[1]))) / values.size


def _per_image(
    scene: Scene,
    items: list[Item],
    images: Opened,
    grid: Grid,
    maps: tuple[np.ndarray, np.ndarray],
    *,
    progress: Progress,
) -> None:
    """Write the assets `depth` and `confidence` of every matched image, pixel by pixel of the image."""
    height, confidence = maps
    z_range = scene.require_height_range()
    # a parabola may lie half a plane outside the range
    low, high = min(z_range[0], float(np.nanmin(height))) - 1.0, max(z_range[1], float(np.nanmax(height))) + 1.0
    for k, (item, camera, part) in enumerate(zip(items, images.cameras, images.parts, strict=True)):
        progress(k / len(items), f"depth of {item.id}")
        depth, (image_confidence,) = seen_by(camera, part.shape, grid, height, [confidence], (low, high))
        # called depth, as other programs call the map of an image's distances; its numbers are heights
        named = {
            "depth": (depth, "height of what the pixel shows", "m"),
            "confidence": (image_confidence, "confidence", "1"),
        }
        for name, (array, words, unit) in named.items():
            href = per_image_href(name, item.id)
            tags = DATUM if unit == "m" else None
            write_sensor_map(scene.output(href), array, camera, words, unit, tags)
            item.assets[name] = Asset(href, GEOTIFF_TYPE)


def _notes(scene: Scene, found: Matched, images: int, grid: Grid) -> list[str]:
    notes = []
    name, bent = found.bent
    if bent > 0.5 * grid.cell_size:
        notes.append(f"{name}: lines of sight are parallel only to {bent:.2f} m over this area")
    if images == 2:
        notes.append("two images only: what one of them does not show is taken from lower ground around it")
    less = sorted(name for name, share in found.shares.items() if share < COUNTS)
    if less:
        notes.append(f"{', '.join(less)}: less weight in the matching, being less sharp than other images")
    notes += _disagreement(found, images)
    water = 0.0 if found.water is None else _mean(found.water)
    if water > LEAST_TOLD:
        notes.append(f"{100 * water:.0f} % of the area looks like water with waves, laid level with its shore")
    if found.seen_by_two < 0.9:
        notes.append(f"{100 * (1 - found.seen_by_two):.0f} % of the area is seen by fewer than two images")
    for text in notes:
        log.warning("scene %s: %s", scene.id, text)  # which may be one of many tiles
    return notes


def _disagreement(found: Matched, images: int) -> list[str]:
    """Says so where many heights are guesses: few images have to agree with each other, more of them surely."""
    agreed, least = _mean(found.confidence, SURE), LEAST_SURE
    if images in LEAST_ALIKE:
        agreed, least = found.consistent_in_two, LEAST_ALIKE[images]
    if not agreed < least * found.seen_by_two:
        return []
    return [
        f"images agree about {100 * agreed / found.seen_by_two:.1f} % of what two of them see: elsewhere heights are "
        "guesses; more images, or some of more alike directions and dates, would agree about more"
    ]


__all__ = ["CONFIDENCE", "DSM", "prior", "write_maps"]
