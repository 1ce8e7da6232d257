"""The `sattools` command: Unix-style steps joined by scene documents on stdin and stdout."""

from __future__ import annotations

import importlib
import importlib.util
import logging
import os
import signal
import sys
import threading

import click

from sattools import __version__

# name -> first line of help; a command's module is imported only when it is called, so that --help stays fast
COMMANDS = {
    "prep": "Images with RPC cameras -> scene with bundle-adjusted RPCs.",
    "normalise": "Digital numbers -> linear radiance in [0, 1].",
    "prior": "Multi-view matching -> rough surface, confidence, normals.",
    "fit": "Fit a volumetric scene by differentiable rendering.",
    "export": "Fitted scene -> DSM, albedo, shadows as georeferenced files.",
    "compare": "Compare a DSM with lidar and print the error table.",
    "simulate": "Make a ray-traced scene with known truth.",
    "batch": "Many scenes in many configurations -> one table, error against seconds.",
    "report": "Scene or batch -> one self-contained HTML page.",
    "info": "Print a summary of a scene.",
}


class LazyGroup(click.Group):
    """A group that imports a command's module when it is called."""

    def list_commands(self, ctx: click.Context) -> list[str]:
        return [name for name in COMMANDS if importlib.util.find_spec(f"sattools.cli.{name}")]

    def get_command(self, ctx: click.Context, name: str) -> click.Command | None:
        if name not in COMMANDS:
            return None
        try:
            return importlib.import_module(f"sattools.cli.{name}").command
        except ModuleNotFoundError as error:
            if error.name == f"sattools.cli.{name}":
                return None
            raise

    def format_commands(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        with formatter.section("Commands"):
            formatter.write_dl([(name, COMMANDS[name]) for name in self.list_commands(ctx)])


@click.group(cls=LazyGroup, context_settings={"help_option_names": ["-h", "--help"]})
@click.version_option(__version__, prog_name="sattools")
@click.option("-v", "--verbose", count=True, help="Say more on stderr (twice: debugging).")
@click.option("-q", "--quiet", is_flag=True, help="Say only errors on stderr.")
@click.option(
    "--progress",
    type=click.Choice(["auto", "bar", "json", "none"]),
    default="auto",
    help="Progress on stderr: a bar on a terminal (auto), JSON lines, or none.",
)
@click.option("--threads", type=click.IntRange(min=1), help="CPU threads (default: all that this process may use).")
@click.option(
    "--json-usage",
    is_flag=True,
    is_eager=True,
    expose_value=False,
    callback=lambda c, p, v: _json_usage(c, v),
    help="Print every command with its options as JSON and stop.",
)
@click.pass_context
def main(ctx: click.Context, verbose: int, quiet: bool, progress: str, threads: int | None) -> None:
    """Satellite images with RPC cameras to surface models and reflectance maps.

    Each command does one step and hands a scene document to the next:

        sattools prep *.tif --out work | sattools fit | sattools export
    """
    level = logging.ERROR if quiet else (logging.WARNING, logging.INFO, logging.DEBUG)[min(verbose, 2)]
    logging.basicConfig(stream=sys.stderr, format="sattools: %(message)s")
    logging.getLogger("sattools").setLevel(level)
    ctx.obj = {"progress": "none" if quiet and progress == "auto" else progress}
    set_threads(threads)
    if threading.current_thread() is threading.main_thread():
        for number in (signal.SIGTERM, signal.SIGINT):
            before = signal.signal(number, _terminate)
            ctx.call_on_close(lambda number=number, before=before: signal.signal(number, before))


def _json_usage(ctx: click.Context, wanted: bool) -> None:
    if wanted:
        from sattools.cli.usage import usage

        click.echo(usage(main))
        ctx.exit()


def set_threads(threads: int | None) -> None:
    """Settle the number of threads before any numerical library starts its pool.

    Waiting threads must sleep: spinning ones were measured to slow a shared machine down fifteen-fold.
    """
    count = str(threads or len(os.sched_getaffinity(0)))
    os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
    for name in ("OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS", "NUMBA_NUM_THREADS"):
        if threads or name not in os.environ:
            os.environ[name] = count


def _terminate(signum: int, frame: object) -> None:
    # an exception, so that temporary files are removed on the way out
    raise SystemExit(128 + signum)


__all__ = ["main"]
