"""`sattools simulate`: make a scene with known truth."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from sattools.cli.options import build, common_options, dataclass_options, typed
from sattools.cli.pipe import Run, run_source
from sattools.cli.plans import of_simulate
from sattools.progress import Progress
from sattools.settings import tell_without_effect
from sattools.simulate.options import SimulateOptions, without_effect

if TYPE_CHECKING:
    from sattools.scene import Scene
    from sattools.scene.jsonio import JsonObject


@click.command("simulate")
@dataclass_options(SimulateOptions)
@common_options
def command(overwrite: bool, dry_run: bool, print_config: bool, **values: Any) -> None:
    """Make a ray-traced scene with RPC cameras, several dates and suns, and its truth; print the scene document.

    The scene is ready for `sattools fit`, with exact RPCs. To exercise `prep` instead, give it the folder `images`
    (its RPC tags carry --bias-px) and `--metadata` the folder `metadata`.
    """
    options = build(SimulateOptions, values)
    tell_without_effect(without_effect(options, typed(values)).items())

    root = Path(options.out) / options.id
    inputs = tuple(Path(path) for path in (options.dsm, options.classes) if path)

    def make(progress: Progress) -> tuple[Scene, JsonObject | None]:
        from sattools.simulate.stage import simulate

        scene = simulate(options, root, progress, overwrite)
        errors = [item.properties["sattools:simulated"]["rpc_fit_error_px"] for item in scene.items]
        return scene, {"rpc_fit_error_px": max(errors)}

    def check() -> str:
        from sattools.simulate.stage import check_start

        grid = check_start(options, root, overwrite).grid
        size = grid.width * grid.cell_size if grid else options.size
        whole = of_simulate(size, options.gsd, options.views)
        return f"{whole}; writes {root}/"

    run_source(Run("simulate", options, dry_run, print_config, overwrite, inputs), make, f"scene {options.id}", check)
