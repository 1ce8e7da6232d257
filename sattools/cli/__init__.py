"""The `sattools` command: Unix-style steps joined by scene documents on stdin and stdout."""

from __future__ import annotations

import gc
import importlib
import importlib.util
import locale
import os
import re
import signal
import sys
from contextlib import suppress
from typing import Any

import click

from sattools import __version__
from sattools.cli import interrupts
from sattools.cli.commands import COMMANDS
from sattools.cli.logfile import close_log, open_log
from sattools.cli.options import configure_logging, run_options
from sattools.cli.safety import LastResort, check_folder, configure_handler
from sattools.cli.streams import prepare_streams
from sattools.processors import POOLS, cores


class LazyGroup(LastResort):
    """A group that imports a command's module when it is called."""

    def list_commands(self, ctx: click.Context) -> list[str]:
        return [name for name in COMMANDS if importlib.util.find_spec(f"sattools.cli.{name}")]

    def get_command(self, ctx: click.Context, name: str) -> click.Command | None:
        if name not in COMMANDS:
            return None
        try:
            command: click.Command = importlib.import_module(f"sattools.cli.{name}").command
        except ModuleNotFoundError as error:
            if error.name == f"sattools.cli.{name}":
                return None
            raise
        if not any(parameter.name == "threads" for parameter in command.params):
            own = {name for parameter in command.params for name in parameter.opts}
            command.params += [_after_the_command(option, own) for option in run_options()]
        return command

    def resolve_command(
        self, ctx: click.Context, args: list[str]
    ) -> tuple[str | None, click.Command | None, list[str]]:
        if args and args[0] not in COMMANDS and not args[0].startswith("-"):
            from sattools.scene.schema import meant

            ctx.fail(f"No such command {args[0][:100]!r}{meant(args[0], COMMANDS)}.")
        self.running, *_ = args
        return super().resolve_command(ctx, args)

    def format_commands(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        with formatter.section("Commands"):
            formatter.write_dl([(name, COMMANDS[name]) for name in self.list_commands(ctx)])


def _after_the_command(option: click.Option, own: set[str]) -> click.Option:
    """The same option behind a command: what is said there counts, as it is said last.

    Args:
        option: of the program.
        own: names of options that mean something of the command's own.
    """
    option.opts = [name for name in option.opts if name not in own]

    def use(ctx: click.Context, parameter: click.Parameter, value: Any) -> None:
        if ctx.get_parameter_source(str(parameter.name)) in (click.core.ParameterSource.DEFAULT, None):
            return
        root = ctx.find_root()
        if root is not ctx:
            root.params[str(parameter.name)] = value
            _apply(root)

    option.callback, option.expose_value = use, False
    return option


@click.group(cls=LazyGroup, context_settings={"help_option_names": ["-h", "--help"]})
@click.version_option(__version__, prog_name="sattools")
@click.option(
    "--json-usage",
    is_flag=True,
    is_eager=True,
    expose_value=False,
    callback=lambda c, p, v: _json_usage(c, v),
    help="Print every command with its options as JSON and stop.",
)
@click.pass_context
def main(ctx: click.Context, **values: Any) -> None:
    """Satellite images with RPC cameras to surface models and reflectance maps.

    Each command does one step and hands a scene document to the next:

        sattools prep *.tif --out work | sattools fit | sattools export
    """
    check_folder()
    configure_handler()
    _apply(ctx)
    ctx.with_resource(interrupts.listening())


main.params[:0] = run_options()


def _apply(root: click.Context) -> None:
    """Set how the program runs from the options given so far."""
    values = root.params
    configure_logging(values["verbose"], values["quiet"])  # the first line of a log is not for the screen
    if values["log_file"] and root.meta.get("sattools.log") != values["log_file"]:
        open_log(values["log_file"])
        if "sattools.log" not in root.meta:
            root.call_on_close(close_log)
        root.meta["sattools.log"] = values["log_file"]
    progress = values["progress"] or "auto"
    root.obj = {"progress": "none" if values["quiet"] and progress == "auto" else progress}
    set_threads(values["threads"])
    _bound_cache()
    if values["max_memory"]:
        from sattools.scene.memory import limited

        root.with_resource(limited(values["max_memory"]))
    if values["allow_remote"] and not root.meta.get("sattools.remote"):
        from sattools.scene.location import remote_allowed

        root.meta["sattools.remote"] = True
        root.with_resource(remote_allowed())


def _json_usage(ctx: click.Context, wanted: bool) -> None:
    if wanted:
        from sattools.cli.usage import usage

        click.echo(usage(main))
        ctx.exit()


def set_threads(threads: int | None) -> None:
    """Set the number of threads before any numerical library starts its pool.

    Waiting threads must sleep: spinning ones were measured to slow a shared machine down fifteen-fold. numpy's matrices
    are small ones, by the thousand: with as many threads as cores the adjustment of cameras took four times the CPU
    seconds and longer, so OpenBLAS gets one thread unless the environment asks for more.
    """
    count = str(threads or cores())
    os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    for name in POOLS:
        if threads or name not in os.environ:
            os.environ[name] = count
    if threads:
        _tell_loaded(threads)


def _tell_loaded(threads: int) -> None:
    """Libraries that are there already, as in a program that calls the suite, read no environment any more."""
    if torch := sys.modules.get("torch"):
        torch.set_num_threads(threads)
    if cv2 := sys.modules.get("cv2"):
        cv2.setNumThreads(threads)
    if compiled := sys.modules.get("sattools.compiled"):
        compiled.__dict__["MOST_THREADS"] = threads


def _bound_cache() -> None:
    """Keep at most 16 MiB of the pixels that GDAL has read, unless the environment says otherwise.

    It would keep a twentieth of the machine's memory by itself, so that memory grew with the area of a scene.
    """
    os.environ.setdefault("GDAL_CACHEMAX", "16")


def _forget_others() -> None:
    """Drop what the environment says about other programs' libraries and would break ours.

    A notebook names a backend for pictures that may not be installed here. Shells of conda, OSGeo4W and QGIS name the
    data of their PROJ and GDAL, which others refuse; rasterio brings its own, but where conda has built it.
    """
    os.environ.pop("MPLBACKEND", None)
    found = importlib.util.find_spec("rasterio")
    homes = (found and found.submodule_search_locations) or ()
    if any(os.path.isdir(os.path.join(home, "proj_data")) for home in homes):
        for name in ("PROJ_DATA", "PROJ_LIB", "GDAL_DATA"):
            os.environ.pop(name, None)


def compare_letters_plainly() -> None:
    """Take another locale for the kinds of letters where GDAL would not know "tiled" for "TILED", as in Turkish.

    It compares names of options by the C library, whose I is no capital of i there: nothing could be written.
    Processes that are started get it from the environment.
    """
    if sys.getfilesystemencoding() != "utf-8" or re.match(b"i", b"I", re.IGNORECASE | re.LOCALE):
        return
    for name in ("C.UTF-8", "C"):
        with suppress(locale.Error):
            locale.setlocale(locale.LC_CTYPE, name)
            rest = os.environ.pop("LC_ALL", None)  # which would come before LC_CTYPE
            if rest is not None:
                os.environ["LANG"] = rest
            os.environ["LC_CTYPE"] = name
            return


# Libraries make hundreds of thousands of objects that stay, and Python would go through all of them again and again
# while they are imported, and once more at the end: half a second of each command that needs PyTorch.
GARBAGE = (20_000, 20, 100)


def entry() -> None:
    """The program: a signal counts from here until the work is done, and not while the interpreter shuts down."""
    gc.set_threshold(*GARBAGE)
    _forget_others()
    compare_letters_plainly()
    prepare_streams()
    interrupts.listen()
    try:
        main(prog_name="sattools")
    except SystemExit as error:
        # whatever an interrupt became on its way through other people's code
        if error.code and interrupts.status():
            raise SystemExit(interrupts.status()) from None
        raise
    finally:
        for number in interrupts.SIGNALS:
            signal.signal(number, signal.SIG_IGN)
        gc.disable()
        gc.freeze()  # what is left ends with the process


__all__ = ["COMMANDS", "entry", "main"]
