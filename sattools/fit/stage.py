"""The stage `fit`: a scene with images and cameras becomes a fitted model."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from sattools.fit.combinations import check_combination
from sattools.fit.files import MODEL, TRACE
from sattools.fit.foresight import check_tiled, with_tile
from sattools.fit.inputs import (
    forget_left_over,
    holding_out,
    makes_prior,
    may_write,
    saying_why_anew,
    warn_of_prior,
)
from sattools.fit.options import FitOptions
from sattools.fit.rays.precision import check_precision
from sattools.fit.tiles.plan import Plan
from sattools.fit.tiles.shared import PRODUCT
from sattools.fit.tiles.stage import fit_tiled
from sattools.fit.whole import choose_device, fit_whole, set_up, set_up_whole
from sattools.prior import PriorOptions
from sattools.prior.gate import check_start as check_prior_start
from sattools.progress import Progress, silent
from sattools.scene import Scene
from sattools.scene.dependencies import begin, may_begin
from sattools.scene.jsonio import JsonObject


def fit(scene: Scene, options: FitOptions, progress: Progress = silent, overwrite: bool = True) -> JsonObject:
    """Fit a surface to the scene's training images; writes the model and the trace below the root.

    Args:
        scene: the scene.
        options: of the fit.
        progress: told the share done and what is being done.
        overwrite: replace outputs that are there.

    Returns:
        Remarks and figures for the history.

    Raises:
        SceneError: fewer than two usable images, or unknown held-out ids.
        OutputExistsError: there is a model and ``overwrite`` is False, or ``resume`` finds a finished fit.
    """
    options = with_tile(scene, options)
    # a tile is fitted as a whole, a pilot tile too, although each is larger than --tile by what it shares
    if not options.tile or scene.is_part or PRODUCT in scene.products:
        return fit_whole(scene, options, progress, overwrite)
    begin(scene, "fit", [MODEL, TRACE], may_write(scene, options, overwrite))
    with holding_out(scene, options.holdout, options.views):
        set_up(scene, options)
        return fit_tiled(scene, options, progress)  # a tile's fit sets the weights that go with the images itself


def check_start(scene: Scene, options: FitOptions, overwrite: bool = True) -> None:
    """What `fit` looks at before its work, for a dry run; arguments and errors as of `fit`.

    Args:
        scene: is changed.
        options: of the fit.
        overwrite: replace outputs that are there.
    """
    options = with_tile(scene, options)
    may = may_write(scene, options, overwrite)
    may_begin(scene, "fit", [MODEL, TRACE], may)
    left_over = False
    with holding_out(scene, options.holdout, options.views):
        if options.tile and not scene.is_part and PRODUCT not in scene.products:
            set_up(scene, options)
            check_tiled(options)
            left_over = options.prior_weight > 0 and forget_left_over(scene)
            plan = Plan.make(scene, options)
            if len(plan.tiles) > 1 and options.part != "mosaic":
                plan.begun()
            if len(plan.tiles) > 1 and options.part in ("all", "coarse"):
                warn_of_prior(scene, options)
            if len(plan.tiles) > 1 or options.part in ("coarse", "split"):
                return
            options = replace(options, tile=None, part="all")
        set_up_whole(scene, options)
        if makes_prior(scene, options):
            with saying_why_anew(scene):
                check_prior_start(scene, PriorOptions(), may or left_over or "prior_dsm" in scene.products)


def check_options(options: FitOptions) -> None:
    """What `check_start` can tell without a scene.

    Args:
        options: of the fit; its reference, if it has one, is there.

    Raises:
        SceneError: options that do not go with each other, or with this machine.
        InputError: a reference without heights.
    """
    device = choose_device(options.device)
    check_combination(options, None)
    check_precision(options, device)
    if options.tile and options.tile != "auto":
        check_tiled(options)
    if options.reference:
        from sattools.compare.doubts import check_heights

        check_heights(Path(options.reference), one_band=False)


__all__ = ["check_options", "check_start", "choose_device", "fit"]
