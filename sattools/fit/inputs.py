"""What a fit begins with: which images it may see, the depth prior, and whether it continues an interrupted one."""

from __future__ import annotations

import hashlib
import json
import logging
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from sattools import __version__
from sattools.camera.rpc import RPC
from sattools.errors import InputError, OutputExistsError, SceneError
from sattools.fit.depth_prior import DepthPrior
from sattools.fit.files import CHECKPOINT, MODEL
from sattools.fit.illumination import views_left_out
from sattools.fit.options import FitOptions
from sattools.fit.resume import check_nothing_begun
from sattools.fit.tiles.clearing import check_clear
from sattools.fit.tiles.shared import PRODUCT
from sattools.fit.tiles.state import COARSE, begun
from sattools.progress import Progress
from sattools.render.around import PRODUCT as AROUND
from sattools.scene import Grid, Scene
from sattools.scene.dependencies import MADE, check_current, drop, latest, outdated_by, stale
from sattools.scene.document import FIT_ROLE, PARTS
from sattools.scene.files import check_outputs, digest, written
from sattools.scene.jsonio import JsonObject
from sattools.scene.opening import opened
from sattools.scene.placement import crs_of, place_at
from sattools.scene.raster import raster_grid
from sattools.scene.regrid import bounds_in
from sattools.views import Source

log = logging.getLogger(__name__)
FINER = 1.1  # times that a prior's cells may be as wide as the fit's
# of an option, what does not change the result
_HOUSEKEEPING = ("resume", "budget", "reference")


@contextmanager
def holding_out(scene: Scene, holdout: Sequence[str], views: str) -> Iterator[None]:
    """Images that this fit must not see are of the role ``test`` inside; afterwards `FIT_ROLE` names them.

    Args:
        scene: the scene.
        holdout: ids of images.
        views: option of that name.

    Raises:
        SceneError: an unknown id, or a ``views`` that cannot be followed.
    """
    unknown = sorted(set(holdout) - {item.id for item in scene.items})
    if unknown:
        raise SceneError(f"scene {scene.id}: found no item {unknown[0]!r} to hold out")
    before = {item.id: item.properties.get("sattools:role") for item in scene.items}
    out: list[str] = []
    try:
        for ids in (holdout, views):
            named = views_left_out(scene, ids) if isinstance(ids, str) else list(ids)
            out += named
            for item in scene.items:
                if item.id in named:
                    item.properties["sattools:role"] = "test"
        yield
    finally:
        for item in scene.items:
            if before[item.id] is None:
                item.properties.pop("sattools:role", None)
            else:
                item.properties["sattools:role"] = before[item.id]
    for item in scene.items:
        if item.id in out:
            item.properties[FIT_ROLE] = "test"


def may_write(scene: Scene, options: FitOptions, overwrite: bool) -> bool:
    """Whether the fit may replace a model that is there: asked for, or the end of what was interrupted.

    What was interrupted is as much work as what was finished: to begin anew has to be asked for, too.

    Args:
        scene: of the fit.
        options: of the fit.
        overwrite: what the user said.

    Raises:
        OutputExistsError: ``resume`` on a fit that is finished; a checkpoint or finished tiles without ``resume``;
            other files in the place of tiles.
        SceneError: a damaged list of tiles.
    """
    if overwrite:
        return True
    if options.tile and options.part != "mosaic":
        check_clear(scene.root)
    if not options.resume:
        _check_nothing_begun(scene, options)
        return False
    if scene.path(CHECKPOINT).exists() or begun(scene.root):
        return True
    if "model" in scene.products:
        raise OutputExistsError(
            f"{scene.path(scene.products['model'])}: found a finished fit, expected an interrupted one for --resume; "
            "give --overwrite to fit anew"
        )
    # without a model in the document the fit was stopped before its end was noted, unless the history knows the file:
    # then it is of a finished fit that another command has put out of date since
    noted = {(entry.get(MADE) or {}).get("fit", {}).get("outputs", {}).get("model") for entry in scene.history}
    return digest(scene.path(MODEL)) not in noted - {None}


def _check_nothing_begun(scene: Scene, options: FitOptions) -> None:
    """Raise OutputExistsError where a fit that begins anew would give up what an interrupted one has done."""
    check_nothing_begun(scene.path(CHECKPOINT))
    if options.part == "mosaic":  # it joins what there is
        return
    state = begun(scene.root)
    if state is None:
        return
    names = [*(name for part in ("tiles", "pilots") for name in state.get(part) or ()), COARSE]
    for root in (scene.root / PARTS / name for name in names):
        if (root / MODEL).exists():
            what = "a coarse fit of the whole" if root.name == COARSE else "a finished tile"
            raise OutputExistsError(
                f"{root}: found {what} of an interrupted fit; give --resume to go on, or --overwrite to fit anew"
            )
        check_nothing_begun(root / CHECKPOINT)


def load_prior(
    scene: Scene,
    options: FitOptions,
    progress: Progress,
    overwrite: bool = True,
    sources: list[Source] | None = None,
) -> tuple[DepthPrior | None, JsonObject]:
    """The scene's depth prior, and a record of it if it is made here.

    It is made with its defaults where it is missing, or where an earlier fit has made it of other images.

    Args:
        scene: of the fit.
        options: of the fit.
        progress: told the share done.
        overwrite: replace a prior's files that are there.
        sources: the training images, if they have been read already.

    Raises:
        StaleError: a prior that the user asked for is out of date.
    """
    if options.prior_weight == 0:
        return None, {}
    anew = overwrite and not options.resume
    overwrite = forget_left_over(scene) or overwrite
    check_prior(scene, options)
    from sattools.prior.files import read_prior

    new: JsonObject = {}
    if "prior_dsm" not in scene.products:
        from sattools.prior import PriorOptions
        from sattools.prior.stage import prior

        with saying_why_anew(scene):
            given = scene, PriorOptions(), progress, overwrite
            new = prior(*given, implicit=True, sources=sources, anew=anew)[MADE]
    return DepthPrior.from_arrays(*read_prior(scene, _part_of_prior(scene))), new


@contextmanager
def saying_why_anew(scene: Scene) -> Iterator[None]:
    """Where a prior is in the way of the fit's own, say what has put it out of date: the user has just made it.

    Args:
        scene: of the fit.
    """
    by = outdated_by(scene, "prior")
    try:
        yield
    except OutputExistsError as error:
        if by is None:
            raise
        raise OutputExistsError(
            f"{error} (this prior is from before `sattools {by}`, which has put it out of date: run "
            f"`sattools prior --overwrite` after it, or let the fit replace it)"
        ) from error


def check_prior(scene: Scene, options: FitOptions) -> None:
    """What of the prior is in the way of a fit.

    Args:
        scene: of the fit.
        options: of the fit.

    Raises:
        StaleError: the fit would take a prior that the user asked for and that is out of date.
        OutputIsInputError: it would make one in place of that which it is to be scored by.
    """
    if makes_prior(scene, options):
        from sattools.prior.files import MAPS

        if options.reference:
            check_outputs([scene.path(href) for href in MAPS.values()], [Path(options.reference)], overwrite=True)
    elif options.prior_weight > 0:
        check_current(scene, "prior")


def check_reference(scene: Scene, reference: str | None) -> None:
    """Raise InputError where a reference lies elsewhere than the scene, or nowhere, or has no heights.

    A fit would end with it later, or be watched by nonsense.

    Args:
        scene: of the fit.
        reference: file of heights, or None.
    """
    if reference is None:
        return
    grid = scene.require_grid()
    from sattools.compare.doubts import check_heights

    path = Path(reference)
    check_heights(path, one_band=False)
    with opened(path) as data:
        if data.crs is None and path.with_suffix(".txt").exists():  # a tile of the contest, whose place is in that
            return
        west, south, east, north = bounds = bounds_in(crs_of(data, path), grid.widened(max(grid.shape)))
        left, bottom, right, top = data.bounds
        turned = place_at(data, bounds).c - data.transform.c
        left, right = left + turned, right + turned
    across = min(left, right) < east and west < max(left, right)
    if not (across and min(bottom, top) < north and south < max(bottom, top)):
        raise InputError(f"{path}: found no ground of scene {scene.id}, expected a --reference of its area")


def makes_prior(scene: Scene, options: FitOptions) -> bool:
    """Whether the fit will make the prior itself, as none is there or an earlier fit made it of something else."""
    return options.prior_weight > 0 and ("prior_dsm" not in scene.products or _is_left_over(scene))


def warn_of_prior(scene: Scene, options: FitOptions) -> None:
    """Warn of a prior that has seen held-out images, or whose walls ``resolution`` would keep on finer cells.

    Args:
        scene: of the fit; its prior, if it has one, is readable.
        options: of the fit.
    """
    made = makes_prior(scene, options)
    seen = latest(scene, "prior") if options.prior_weight > 0 and not made else None
    if seen is not None and (leaked := sorted(set(seen["items"]) - {item.id for item in scene.train_items()})):
        log.warning("scene %s: the prior was matched with %s, which this fit holds out", scene.id, leaked[0])
    if options.resolution is None or options.field != "surface" or options.prior_weight == 0 or scene.is_part:
        return
    cell = (scene.require_grid() if made else raster_grid(scene.path(scene.products["prior_dsm"]))).cell_size
    if cell > FINER * options.resolution:
        log.warning(
            "scene %s: --resolution %g is finer than the prior, which has cells of %.3g m: with `sattools prior "
            "--resolution %g` before the fit its heights are better", scene.id, options.resolution, cell,
            options.resolution,
        )  # fmt: skip


def forget_left_over(scene: Scene) -> bool:
    """Drop the prior that an earlier fit has made of other images, or of images as they are no more, if it is that.

    Args:
        scene: of the fit, which has set the roles of the images; is changed.

    Returns:
        Whether it was.
    """
    if not _is_left_over(scene):
        return False
    log.info("scene %s: the prior is made anew, for %d images", scene.id, len(scene.train_items()))
    drop(scene, "prior")
    return True


def _is_left_over(scene: Scene) -> bool:
    """Whether an earlier fit has made the prior of other images, or of images as they are no more."""
    made = latest(scene, "prior")
    if made is None or "prior_dsm" not in scene.products or not made.get("implicit"):
        return False
    return made["items"] != [item.id for item in scene.train_items()] or stale(scene, "prior") is not None


def _part_of_prior(scene: Scene) -> Grid | None:
    """The scene's grid where its prior is that of the whole area of which it is a tile; None where it is its own."""
    own, prior = scene.require_grid(), raster_grid(written(scene.path(scene.products["prior_dsm"])))
    edges = zip(own.shape, prior.shape, strict=True)
    larger = any(n * prior.cell_size > m * own.cell_size + prior.cell_size for m, n in edges)
    return own if larger else None


def fingerprint(scene: Scene, options: FitOptions, sources: Sequence[Source], prior: DepthPrior | None) -> str:
    """Hash of everything that a continued fit must share with the interrupted one.

    These are options, version, images with cameras and suns, prior, grid, heights, and what tiles share.

    Args:
        scene: the scene.
        options: of the fit.
        sources: the images.
        prior: depth supervision, or None.
    """
    plain = {name: value for name, value in asdict(options).items() if name not in _HOUSEKEEPING}
    what: list[Any] = [__version__, plain, scene.require_grid().to_dict(), scene.require_height_range()]
    what += [
        [s.id, _hash(s.radiance), s.rpc.to_rpc_txt(), s.sun, s.linear, asdict(s.balance) if s.balance else None]
        for s in sources
    ]
    what += [[item.id, item.properties.get("sattools:radiance")] for item in scene.train_items()]
    what.append([_hash(prior.height.numpy()), _hash(prior.confidence.numpy()), prior.grid.to_dict()] if prior else None)
    for product in (PRODUCT, AROUND):
        what.append(digest(scene.path(scene.products[product])) if product in scene.products else None)
    return hashlib.sha256(json.dumps(what, sort_keys=True, default=str).encode()).hexdigest()


def basis_of(scene: Scene, options: FitOptions, cameras: Sequence[RPC]) -> JsonObject:
    """What of `fingerprint` is known before an image is read, for people: options as ``--name``, the rest in words.

    Args:
        scene: the scene.
        options: as asked for.
        cameras: of the training images.
    """
    items = scene.train_items()
    found: JsonObject = {
        f"--{name.replace('_', '-')}": value for name, value in asdict(options).items() if name not in _HOUSEKEEPING
    }
    found |= {
        "versions of sattools": __version__,
        "images": [item.id for item in items],
        "ground cells": scene.require_grid().to_dict(),
        "height ranges": scene.require_height_range(),
        "cameras": [hashlib.sha256(camera.to_rpc_txt().encode()).hexdigest() for camera in cameras],
        "suns": [item.sun for item in items],
        "kinds of radiance": [item.properties.get("sattools:radiance") for item in items],
    }
    return dict(json.loads(json.dumps(found, default=str)))  # as a checkpoint gives it back


def _hash(array: np.ndarray) -> str:
    return hashlib.sha256(np.ascontiguousarray(array).tobytes()).hexdigest()


__all__ = [
    "basis_of", "check_prior", "check_reference", "fingerprint", "forget_left_over", "holding_out", "load_prior",
    "makes_prior", "may_write", "saying_why_anew", "warn_of_prior",
]  # fmt: skip
