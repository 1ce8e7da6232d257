"""SIGINT and SIGTERM as an exception, so that temporary files are removed and locks are freed on the way out.

The exception of a handler can get lost: raised in a callback of C code (a finaliser, the kernel compiler) it is
reported as ignored and work goes on, and the import of an extension module makes an ImportError of it. A lost one is
raised again, at once where Python tells of it, else with the next sign of progress.
"""

from __future__ import annotations

import logging
import os
import signal
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

from sattools.progress import Progress
from sattools.system import send

log = logging.getLogger(__name__)
SIGNALS = (signal.SIGTERM, signal.SIGINT)
_AGAIN_S = 0.05
_received: int | None = None
_report_ignored: Callable[[Any], object] = sys.__unraisablehook__


def listen() -> None:
    """Let signals end the work from now on. Only the main thread can."""
    global _received, _report_ignored
    _received = None
    if sys.unraisablehook is not _ignored:
        _report_ignored, sys.unraisablehook = sys.unraisablehook, _ignored
    for number in SIGNALS:
        signal.signal(number, _raise)


@contextmanager
def listening() -> Iterator[None]:
    """`listen` for a while, unless the program does anyway or this is not the main thread."""
    before = [signal.getsignal(number) for number in SIGNALS]
    if _raise in before or threading.current_thread() is not threading.main_thread():
        yield
        return
    listen()
    try:
        yield
    finally:
        sys.unraisablehook = _report_ignored
        for number, handler in zip(SIGNALS, before, strict=True):
            signal.signal(number, handler)


def status() -> int | None:
    """The exit status that belongs to the signal that came, None where none did."""
    return None if _received is None else 128 + _received


def checked(progress: Progress) -> Progress:
    """The callback, which also stops work that has lost an interrupt."""

    def call(fraction: float, message: str) -> None:
        if _received is not None and threading.current_thread() is threading.main_thread():
            raise SystemExit(128 + _received)
        progress(fraction, message)

    return call


def _raise(number: int, frame: object) -> None:
    global _received
    _received = number
    raise SystemExit(128 + number)


def _ignored(told: Any) -> None:
    """Called by Python with an exception that goes no further."""
    if _received is None or not isinstance(told.exc_value, SystemExit):
        if log.isEnabledFor(logging.DEBUG):
            _report_ignored(told)
        else:  # as the message handlers of libraries raise, where a damaged file makes them say what is no text
            log.warning("ignored in %s: %s: %s", told.object, told.exc_type.__name__, told.exc_value)
        return
    # not from here: what is raised in this hook is lost as well
    again = threading.Timer(_AGAIN_S, _send, (os.getpid(), _received))
    again.daemon = True
    again.start()


def _send(process: int, number: int) -> None:
    if os.getpid() == process and signal.getsignal(number) is _raise:
        send(number)


__all__ = ["SIGNALS", "checked", "listen", "listening", "status"]
