"""`sattools fit`: a scene becomes a fitted model."""

from __future__ import annotations

import logging
import time
from typing import TYPE_CHECKING, Any, ClassVar

import click

from sattools.cli import interrupts
from sattools.cli.help import GroupedCommand
from sattools.cli.options import build, common_options, dataclass_options, scene_argument, typed
from sattools.cli.pipe import Run, run_scenes
from sattools.fit.options import FitOptions
from sattools.progress import Progress
from sattools.settings import tell_without_effect

if TYPE_CHECKING:
    from sattools.scene import Scene

log = logging.getLogger(__name__)


class FitCommand(GroupedCommand):
    """The options of `fit` by what they are about."""

    groups: ClassVar = {
        "Surface": ("preset", "field", "resolution", "coarsest", "epochs", "softness", "smooth", "height_rate",
                    "prior_weight", "pose"),
        "Images": ("bands", "views", "holdout", "reference"),
        "Light": ("loss", "robust", "shadow", "shadow_weight", "shadow_start", "transient"),
        "Reflectance": ("brdf", "brdf_at", "pretrain", "normals", "materials", "material_smooth", "sky", "sky_share",
                        "bounce"),
        "Network": ("start", "network", "width", "rays", "samples", "guided", "steps", "rate", "precision",
                    "depth_weight", "beta", "solar_weight"),
        "Resources": ("device", "tile", "overlap", "part", "budget", "resume", "seed"),
    }  # fmt: skip
    # what `with_preset` may set, without importing it for every help
    by_preset = frozenset(
        ("field", "network", "loss", "robust", "pose", "samples", "guided", "rays", "steps", "rate", "prior_weight",
         "depth_weight", "shadow", "shadow_weight", "transient", "beta", "solar_weight", "brdf", "normals", "pretrain")
    )  # fmt: skip
    expert = frozenset(
        ("coarsest", "epochs", "softness", "smooth", "height_rate", "robust", "shadow_weight", "shadow_start",
         "brdf_at", "pretrain", "normals", "materials", "material_smooth", "bounce", "network", "width", "rays",
         "samples", "guided", "steps", "rate", "precision", "depth_weight", "beta", "solar_weight", "part")
    )  # fmt: skip


def _preset(name: str, start: str, field: str) -> dict[str, Any]:
    """The preset's values, less those that the user gave on the command line or in a file."""
    from sattools.fit.presets import with_preset

    context = click.get_current_context()
    default = (click.core.ParameterSource.DEFAULT, None)
    return {k: v for k, v in with_preset(name, start, field).items() if context.get_parameter_source(k) in default}


def _say_how_to_go_on(scene: Scene, options: FitOptions, began: float) -> None:
    """One line for who has interrupted a fit that left something to go on with; began: [s since 1970]."""
    from sattools.fit.files import CHECKPOINT
    from sattools.fit.resume import how_to_go_on
    from sattools.fit.tiles.state import STATE

    if words := how_to_go_on(scene.path(CHECKPOINT), began, options.steps):
        log.warning("%s", words)
    elif scene.path(STATE).exists() and not scene.is_part:
        log.warning("interrupted: `sattools fit --resume` with the same options goes on with the tiles that are there")


def _refuse_overlap(options: FitOptions, tile: float) -> None:
    """Raise BadParameter, unless no other overlap would help: the fit says what it is that does not go with tiles."""
    from sattools.fit.foresight import why_at_once

    if not why_at_once(options):
        raise click.BadParameter(
            f"found {options.overlap:g} m, expected less than half of --tile {tile:g} m (a smaller --overlap, or tiles "
            f"of more than {2 * options.overlap:g} m)",
            param_hint="--overlap",
        )


@click.command("fit", cls=FitCommand)
@scene_argument
@dataclass_options(FitOptions)
@common_options
def command(scenes: tuple[str, ...], overwrite: bool, dry_run: bool, print_config: bool, **values: Any) -> None:
    """Fit a surface with albedo, or a volume, to the scene's images by differentiable rendering.

    Writes fit/model.safetensors and fit/trace.csv below the scene's root. A fit that was interrupted goes on with
    --resume and ends with the same surface as one that was not; without it, only --overwrite begins anew.
    """
    from sattools.fit.applicable import without_effect

    options = build(FitOptions, {**values, **_preset(values["preset"], values["start"], values["field"])})
    tell_without_effect(without_effect(options, typed(values)))
    if options.tile == "auto" and options.part != "all":
        raise click.BadParameter(f"found auto with --part {options.part}, expected metres", param_hint="--tile")
    if options.tile and options.tile != "auto" and 2 * options.overlap >= options.tile:
        _refuse_overlap(options, options.tile)
    if options.part != "all" and not options.tile:
        raise click.BadParameter(f"found {options.part}, expected --tile beside it", param_hint="--part")

    def work(scene: Scene, progress: Progress) -> dict[str, Any]:
        from sattools.fit.stage import fit

        began = time.time()
        try:
            return fit(scene, options, progress, overwrite)
        except BaseException as error:
            if isinstance(error, KeyboardInterrupt | SystemExit) or interrupts.status():
                _say_how_to_go_on(scene, options, began)
            raise

    def check(scene: Scene) -> None:
        from sattools.fit.stage import check_start

        check_start(scene, options, overwrite)

    def ahead() -> None:
        from sattools.fit.stage import check_options

        check_options(options)

    def foreseen(scene: Scene) -> str:
        from sattools.fit.foresight import foresee

        return f"{foresee(scene, options)}; writes fit/model.safetensors and fit/trace.csv"

    if print_config and options.field == "mlp":
        from sattools.fit.presets import DIFFERENCES

        click.echo("".join(f"# {line}\n" for line in DIFFERENCES.splitlines()), nl=False)
    plan = "fit the surface"
    if dry_run:
        from sattools.fit.foresight import plan_of

        plan = plan_of(options)
    run = Run("fit", options, dry_run, print_config, overwrite)
    run_scenes(run, scenes, work, plan=plan, foreseen=foreseen, check=check, ahead=ahead)
