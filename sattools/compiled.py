"""How numerical kernels are compiled, and where what was compiled is kept.

Kernels import `njit` from here and not from numba: in a container the package's folder is read-only and there is no
home, where numba would refuse to be used at all.
"""

from __future__ import annotations

import functools
import hashlib
import logging
import os
import stat
import tempfile
from collections.abc import Callable, Iterator
from contextlib import suppress
from pathlib import Path
from types import CodeType
from typing import Any

from sattools import system
from sattools.helpers import together

log = logging.getLogger(__name__)

# What may be assumed of numbers. Sums must not be reordered and products not fused: the compiler would do so
# in one way when a kernel is compiled and used at once and in another when it comes from the cache, and the first run
# after an installation would give other heights than the second. Kernels that meet NaN or infinity must not use these.
FASTMATH = {"nnan", "ninf", "nsz"}


def writable(folder: Path) -> bool:
    """Files can be made in a folder, or the folder below one where they can."""
    try:
        place = next(p for p in (folder, *folder.parents) if p.exists())
        # asking for rights is not enough: root has all of them on a read-only file system too
        with tempfile.TemporaryFile(dir=place):
            return True
    except (OSError, StopIteration):
        return False


def cache_folder(package: Path = Path(__file__).parent) -> Path | None:
    """Where compiled kernels go instead, when neither the package's folder nor the user's cache can be written.

    None = numba finds a place by itself. The folder below the system's temporary one belongs to this user alone, as
    what is loaded from it is run.

    Raises: OSError where no folder at all can be written.
    """
    if os.environ.get("NUMBA_CACHE_DIR") or writable(package / "__pycache__") or writable(_users_cache()):
        return None
    own = system.user()
    folder = Path(tempfile.gettempdir()) / f"sattools-cache-{own or 0}"
    try:
        folder.mkdir(mode=0o700, exist_ok=True)
        status = folder.lstat()
        if own is None or (stat.S_ISDIR(status.st_mode) and status.st_uid == own and not status.st_mode & 0o077):
            return folder
    except OSError:
        pass
    return Path(tempfile.mkdtemp(prefix="sattools-cache-"))


def _users_cache() -> Path:
    home = os.environ.get("XDG_CACHE_HOME")
    return Path(home) if home else Path(os.path.expanduser("~")) / ".cache"


def _settle() -> bool:
    """Choose the caches of numba and matplotlib before either is imported; whether kernels can be kept at all."""
    try:
        folder = cache_folder()
    except OSError:
        return False
    if folder is not None:
        os.environ["NUMBA_CACHE_DIR"] = str(folder)
        os.environ.setdefault("MPLCONFIGDIR", str(folder))
        from numba import config

        config.CACHE_DIR = str(folder)  # type: ignore[attr-defined]  # where something has imported numba before
        log.info("compiled kernels are kept in %s", folder)
    return True


_KEPT = _settle()

import numba  # noqa: E402
import numpy as np  # noqa: E402
from numba.core import event  # noqa: E402
from numba.core.dispatcher import Dispatcher  # noqa: E402


class _FirstRun(event.Listener):
    """Says once why nothing seems to happen: kernels that come from the cache start no compilation."""

    said = False

    def on_start(self, event: Any) -> None:
        """See `numba.core.event.Listener`."""
        if not self.said:
            self.said = True
            log.warning("compiling, first run: this takes up to a minute, once")

    def on_end(self, event: Any) -> None:
        """See `numba.core.event.Listener`."""


event.register("numba:compile", _FirstRun())


def njit(*arguments: Any, **options: Any) -> Callable[..., Any]:
    """`numba.njit`; kept only for this run where there is no folder for the cache.

    Divisions are numpy's: the test for zero that numba puts before each by default keeps loops from being vectorised.
    """
    options.setdefault("error_model", "numpy")
    if options.get("cache") and not _KEPT:
        options["cache"] = False
    compiled: Callable[..., Any] = numba.njit(*arguments, **options)
    if arguments and callable(arguments[0]):
        return _forgiving(compiled)
    return lambda function: _forgiving(compiled(function))


def _forgiving(kernel: Any) -> Any:
    """A kernel that is compiled anew when what it is made of has changed, and runs where it cannot be kept."""
    cache = kernel._cache
    load, save = cache.load_overload, cache.save_overload

    def load_if_fresh(signature: Any, context: Any) -> Any:
        # not before the first call, when all modules are imported
        if isinstance(kept := getattr(cache, "_cache_file", None), numba.core.caching.IndexDataCacheFile):
            kept._source_stamp = (cache._impl.locator.get_source_stamp(), *made_of(kernel))
        return load(signature, context)

    def try_to_save(signature: Any, data: Any) -> None:
        try:
            save(signature, data)
        except OSError as error:
            log.info("%s: compiled, but cannot be kept (%s)", kernel.__name__, error.strerror)

    cache.load_overload, cache.save_overload = load_if_fresh, try_to_save
    return kernel


def made_of(kernel: Dispatcher) -> list[str]:
    """What the machine code of a kernel depends on: options, constants, and the kernels that it calls, with theirs.

    numba looks at the kernel's own file alone, and would go on using what it has compiled when another file has become
    another one: after an update a kernel would call what its helpers were before it.
    """
    found: dict[Dispatcher, list[str]] = {}
    _look_into(kernel, found)
    return [line for lines in found.values() for line in lines]


def _look_into(kernel: Dispatcher, found: dict[Dispatcher, list[str]]) -> None:
    function = kernel.py_func
    # the order of a set differs from run to run
    options = {name: sorted(value) if isinstance(value, set) else value for name, value in kernel.targetoptions.items()}
    lines = found[kernel] = [f"{function.__name__} {sorted(options.items())}"]
    with suppress(OSError):
        lines.append(_content(function.__code__.co_filename))
    for name in sorted(set(_names(function.__code__))):
        value = function.__globals__.get(name)
        if isinstance(value, Dispatcher) and value not in found:
            _look_into(value, found)
        elif isinstance(value, (bool, int, float, complex, str, tuple, np.generic)):
            lines.append(f"{name} {value!r}")


@functools.cache
def _content(path: str) -> str:
    """SHA-256 of a file. Reproducible packages and images give all files one time, and a constant changes no size."""
    with open(path, "rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def _names(code: CodeType) -> Iterator[str]:
    yield from code.co_names
    for constant in code.co_consts:
        if isinstance(constant, CodeType):
            yield from _names(constant)


def get_ready() -> None:
    """Load what numba else loads with its first kernel, about half a second."""
    with suppress(ImportError, AttributeError):  # a head start only, and no public name of numba's
        from numba.core.registry import cpu_target

        cpu_target.target_context.refresh()


PARTS = 4  # of a thread's work: pieces do not all take equally long


def spread(pieces: Callable[..., int]) -> Callable[[Any], Callable[..., None]]:
    """Share the pieces of a kernel's work among threads.

    numba could do that itself (`parallel=True`), but compiles every such kernel twice, which made a first run twice as
    long, and its threads would be another pool beside those of PyTorch and BLAS. The kernel must let go of the
    interpreter (``nogil=True``), and no piece may write where another one reads or writes.

    Args:
        pieces: given the kernel's arguments, how many pieces there are.

    Returns:
        A decorator. The kernel's last two arguments are its first piece and the one after its last; the function that
        it becomes is called without them. ``threads=N`` takes fewer threads than the process has.
    """

    def decorate(kernel: Any) -> Callable[..., None]:
        @functools.wraps(kernel.py_func)
        def run(*arguments: Any, threads: int | None = None) -> None:
            count, used = pieces(*arguments), min(threads or MOST_THREADS, MOST_THREADS)
            if used == 1 or count < 2:
                kernel(*arguments, 0, count)
                return
            parts = min(PARTS * used, count)
            bounds = [count * k // parts for k in range(parts + 1)]
            calls: list[Callable[[], object]] = [
                functools.partial(kernel, *arguments, *bounds[k : k + 2]) for k in range(parts)
            ]
            together(calls, min(used, parts))

        return run

    return decorate


def at_once(*calls: Callable[[], object]) -> None:
    """Run a few calls of compiled kernels, side by side where this process has threads for it."""
    if MOST_THREADS == 1:
        for call in calls:
            call()
    else:
        together(list(calls), min(len(calls), MOST_THREADS))


MOST_THREADS: int = numba.config.NUMBA_NUM_THREADS  # type: ignore[attr-defined]  # what `--threads` has set


def chunk_count(cells: int) -> int:
    """Pieces of work of a kernel: by the size of the map alone, so that sums do not depend on the number of threads."""
    return min(8, max(1, cells // 16384))


__all__ = ["FASTMATH", "at_once", "cache_folder", "chunk_count", "get_ready", "njit", "spread", "writable"]
