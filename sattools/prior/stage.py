"""The stage `prior`: images and cameras become a rough surface with its confidence, by matching alone."""

from __future__ import annotations

import logging

import numpy as np

from sattools.errors import SceneError
from sattools.prior.confidence import match_confidence
from sattools.prior.files import CONFIDENCE, DSM, MAPS, MapFiles, write_sensor_map
from sattools.prior.frame import Frame
from sattools.prior.leftout import left_out_agreement
from sattools.prior.matching.match import Match, margin_for, match
from sattools.prior.matching.pairs import choose_pairs
from sattools.prior.normals import normals
from sattools.prior.options import PriorOptions
from sattools.prior.project import seen_by
from sattools.progress import Progress, silent, subprogress
from sattools.scene import Asset, Grid, Scene
from sattools.scene.dependencies import MADE, begin, record
from sattools.scene.document import GEOTIFF_TYPE
from sattools.scene.jsonio import JsonObject
from sattools.scene.regrid import nearest_cells, resize_map
from sattools.views import (
    RadiometricBalance,
    Source,
    View,
    check_seen,
    line_of_sight,
    load_sources,
    match_colours,
    views_on,
)
from sattools.views.check import check_extent

log = logging.getLogger(__name__)
Z_REF_SHARE = 0.3  # share of the height range below the reference height: most of a scene is near the ground

REFERENCE_CONTRAST = 0.8322  # from dark to bright (2 ... 98 %) in an 8-bit image of a city


def prior(
    scene: Scene,
    options: PriorOptions,
    progress: Progress = silent,
    overwrite: bool = True,
    implicit: bool = False,
    sources: list[Source] | None = None,
) -> JsonObject:
    """Match the scene's training images; writes height, confidence, probability, normals below ``prior/`` of the root.

    Args:
        scene: gets the products.
        options: of the matching.
        progress: share done.
        overwrite: replace products that are there.
        implicit: whether another stage asks for it, which may then make it anew for other images.
        sources: the training images, if they have been read already.

    Returns:
        Notes and figures for the history.

    Raises:
        SceneError: fewer than two usable images, or none from different directions.
        OutputExistsError: a product exists and ``overwrite`` is False.
    """
    items = scene.train_items()
    outputs = list(MAPS.values())
    if options.per_image:
        outputs += [_per_image_href(name, item.id) for item in items for name in ("depth", "confidence")]
    begin(scene, "prior", outputs, overwrite)
    if len(items) < 2:
        raise SceneError(f"scene {scene.id}: found {len(items)} training image, expected at least 2")
    whole = scene.require_grid()
    grid = whole.resized(options.resolution or whole.cell_size)
    z_range = scene.require_height_range()
    progress(0.0, "reading images")
    sources = load_sources(scene, items) if sources is None else sources
    check_extent(grid)
    found = match_sources(sources, grid, z_range, options, subprogress(progress, 0.2, 0.9))
    if found is None:
        raise SceneError(f"scene {scene.id}: found no two images from different directions, expected stereo images")
    matched, views, pairs, agreement = found
    confidence = match_confidence(matched)
    # a height without two consistent views is a guess: it stays, without confidence, for the fit to judge
    height = matched.height

    progress(0.9, "writing")
    write_maps(scene, height, confidence, grid)
    if options.per_image:
        _per_image(scene, sources, grid, height, confidence, z_range, progress=subprogress(progress, 0.92, 1.0))
    progress(1.0, "matched")
    completeness = float((matched.views >= 2).mean())
    return {
        "notes": _notes(scene, views, grid, completeness),
        "prior": {
            "pairs": [[views[a].id, views[b].id] for a, b in pairs],
            "seen_by_two": round(completeness, 4),
            "consistent_in_two": round(float((matched.consistent_views >= 2).mean()), 4),
            "mean_confidence": round(float(confidence.mean()), 4),
            "left_out_agreement": {
                view.id: None if value is None else round(value, 4)
                for view, value in zip(views, agreement, strict=True)
            },
        },
        MADE: record(scene, "prior", items, implicit=implicit),
    }


def match_sources(
    sources: list[Source],
    grid: Grid,
    z_range: tuple[float, float],
    options: PriorOptions,
    progress: Progress = silent,
) -> tuple[Match, list[View], np.ndarray, list[float | None]] | None:
    """Match images on cells finer than a grid's, and take the means over its cells.

    Args:
        sources: the images.
        grid: of the result.
        z_range: lowest and highest height [m].
        options: of the matching.
        progress: share done.

    Returns:
        What was found on the grid, the views, the pairs ``[P, 2]`` of their indices that were correlated, and how every
        view agrees with the others; None where no two of them look from different directions.
    """
    fine = grid.resized(grid.cell_size * options.detail)
    frame, views = make_frame(sources, fine, z_range, options.window)
    limits = (options.min_angle, options.max_angle)
    pairs = choose_pairs([v.slope for v in views], [v.sun for v in views], options.pairs, limits, options.ideal_angle)
    if not len(pairs):
        return None
    matched = match(frame, pairs, z_range, options, progress, finer=1 / options.detail)
    agreement = left_out_agreement(frame, matched.height)
    maps = {name: crop(array, fine.shape) for name, array in vars(matched).items()}
    resized = {
        name: nearest_cells(array, fine, grid) if array.dtype == np.uint8 else resize_map(array, fine, grid)
        for name, array in maps.items()
    }
    return Match(**resized), views, pairs, agreement


def write_maps(scene: Scene, height: np.ndarray, confidence: np.ndarray, grid: Grid) -> None:
    """Write height [m] and confidence, both ``[H, W]``, and what follows from them, as the scene's prior.

    That is the probability of a height to be less than 1 m off, how far off it may be, and its normals.

    Args:
        scene: gets the products.
        height: ``[H, W]`` [m].
        confidence: ``[H, W]`` in [0, 1].
        grid: of the maps.
    """
    with MapFiles(scene, grid) as files:
        files.write(height, confidence, normals(height, grid.cell_size))


def crop(array: np.ndarray, shape: tuple[int, int]) -> np.ndarray:
    """The upper left part of that shape [cells] (a frame may have a row or column more than the grid)."""
    return array[: shape[0], : shape[1]]


def gamma_encode(images: np.ndarray, masks: np.ndarray, linear: bool, contrast: float | None = None) -> np.ndarray:
    """Grey images with a tone curve, scaled to a usual contrast, so that thresholds mean the same for every sensor.

    Linear radiance hides the texture of shadows in a sliver of its range; 8-bit images bring their tone curve along.
    ``contrast``: of all images before, where it is known; else that of these.

    Args:
        images: ``[V, H, W]`` radiance.
        masks: ``[V, H, W]`` 1 = valid.
        linear: whether they are linear radiance.
        contrast: see above.
    """
    curve = gamma_encoded(images, linear)
    scale = REFERENCE_CONTRAST / (contrast or contrast_of(curve, masks))
    return np.multiply(curve, np.float32(scale), dtype=np.float32)


def gamma_encoded(images: np.ndarray, linear: bool) -> np.ndarray:
    """The images (radiance) with a tone curve, if they have none yet."""
    return np.maximum(images, 0.0) ** (1 / 2.2) if linear else images


def contrast_of(images: np.ndarray, masks: np.ndarray) -> float:
    """From dark to bright (2 ... 98 %) of the radiance where the mask is 1."""
    some, valid = images.ravel()[::7], masks.ravel()[::7] > 0
    low, high = np.percentile(some[valid], [2, 98])
    return max(high - low, 1e-6)


def common_balance(sources: list[Source], views: list[View]) -> list[RadiometricBalance]:
    """How each view becomes grey as the others are, from all that they show; for parts of an area to agree on."""
    gain, offset = match_colours(views)
    grey = np.stack([_grey(v, a, b) for v, a, b in zip(views, gain, offset, strict=True)])
    masks = np.stack([view.mask for view in views])
    contrast = float(contrast_of(gamma_encoded(grey, all(s.linear for s in sources)), masks))
    return [RadiometricBalance(a.tolist(), b.tolist(), contrast) for a, b in zip(gain, offset, strict=True)]


def _grey(view: View, gain: np.ndarray, offset: np.ndarray) -> np.ndarray:
    """Mean of a view's bands as the first view shows them, ``[H, W]`` float32."""
    weight = (1 / (len(gain) * gain)).astype(np.float32)
    return view.target @ weight - np.float32(offset @ weight)


def make_frame(
    sources: list[Source], grid: Grid, z_range: tuple[float, float], window: int
) -> tuple[Frame, list[View]]:
    """Resample all images to the grid and a margin around it, so that high and low points at its border are seen too.

    Rows and columns are made even, as matching halves them.

    Args:
        sources: the images.
        grid: ground grid.
        z_range: lowest and highest height [m].
        window: half width of the matching window [cells].
    """
    z_ref = z_range[0] + Z_REF_SHARE * (z_range[1] - z_range[0])
    cell = grid.cell_size
    directions = [line_of_sight(s.rpc, grid, z_ref, z_range)[0] for s in sources]
    for source, direction in zip(sources, directions, strict=True):
        check_seen(source.id, np.isfinite(direction))  # a camera of another place has no line of sight here
    margin = margin_for(np.array([direction.parallax(cell) for direction in directions]), z_ref, z_range, window)
    wide = Grid(
        grid.crs,
        grid.left - margin * cell,
        grid.top + margin * cell,
        cell,
        grid.width + grid.width % 2 + 2 * margin,
        grid.height + grid.height % 2 + 2 * margin,
    )
    views = views_on(sources, wide, z_ref, z_range)
    parallax = np.array([view.slope.parallax(cell) for view in views])
    balances = [s.balance for s in sources if s.balance]
    if len(balances) == len(sources):
        gain, offset = (
            np.array([t.gain for t in balances], np.float32),
            np.array([t.offset for t in balances], np.float32),
        )
    else:
        gain, offset = match_colours(views)
    images = np.stack([_grey(v, a, b) for v, a, b in zip(views, gain, offset, strict=True)])
    masks = np.stack([view.mask for view in views])
    inside = slice(margin, -margin or None)
    for view, mask in zip(views, masks, strict=True):
        check_seen(view.id, mask[inside, inside])
    images = gamma_encode(images, masks, all(s.linear for s in sources), balances[0].contrast if balances else None)
    return Frame(images, masks, parallax, z_ref, cell, margin, tuple(v.sun for v in views)), views


def _per_image(
    scene: Scene,
    sources: list[Source],
    grid: Grid,
    height: np.ndarray,
    confidence: np.ndarray,
    z_range: tuple[float, float],
    *,
    progress: Progress,
) -> None:
    """Write the assets `depth` and `confidence` of every matched image, pixel by pixel of the image."""
    items = {item.id: item for item in scene.items}
    # a parabola may lie half a plane outside the range
    low, high = min(z_range[0], float(np.nanmin(height))) - 1.0, max(z_range[1], float(np.nanmax(height))) + 1.0
    for k, source in enumerate(sources):
        progress(k / len(sources), f"depth of {source.id}")
        depth, (image_confidence,) = seen_by(
            source.rpc, source.radiance.shape[1:], grid, height, [confidence], (low, high)
        )
        for name, array, unit in (("depth", depth, "m"), ("confidence", image_confidence, "1")):
            href = _per_image_href(name, source.id)
            write_sensor_map(scene.output(href), array, source.rpc, name, unit)
            items[source.id].assets[name] = Asset(href, GEOTIFF_TYPE)


def _per_image_href(name: str, item_id: str) -> str:
    return f"prior/{name}/{item_id}.tif"


def _notes(scene: Scene, views: list[View], grid: Grid, completeness: float) -> list[str]:
    notes = []
    worst = max(views, key=lambda v: v.parallel_ray_error_m)
    if worst.parallel_ray_error_m > 0.5 * grid.cell_size:
        notes.append(
            f"{worst.id}: lines of sight are parallel only to {worst.parallel_ray_error_m:.2f} m over this area"
        )
    if len(views) == 2:
        notes.append("two images only: what one of them does not show is taken from lower ground around it")
    if completeness < 0.9:
        notes.append(f"{100 * (1 - completeness):.0f} % of the area is seen by fewer than two images")
    for text in notes:
        log.warning("scene %s: %s", scene.id, text)  # which may be one of many tiles
    return notes


__all__ = ["CONFIDENCE", "DSM", "common_balance", "make_frame", "prior", "write_maps"]
