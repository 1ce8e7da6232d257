"""Threads that help with calls of compiled kernels, and wait for more.

A pool of `concurrent.futures` does the same, but every future has locks of its own: a fit calls a thousand kernels of a
few milliseconds, and where a machine has many cores that took as long as the kernels.
"""

from __future__ import annotations

import atexit
import os
import threading
from collections import deque
from collections.abc import Callable, Iterable
from queue import SimpleQueue

_asked: SimpleQueue[Callable[[], None] | None] = SimpleQueue()
_threads: list[threading.Thread] = []


def together(calls: Iterable[Callable[[], object]], threads: int) -> None:
    """Run calls on so many threads, this one among them.

    The first error is raised when none of them runs any more; what has not begun by then is left alone. Helpers that
    have something else to do are not waited for.

    Args:
        calls: they must let go of the interpreter.
        threads: how many at most.
    """
    waiting, places, done = deque(calls), deque(range(threads - 1)), SimpleQueue[BaseException | None]()

    def work() -> None:
        while waiting:
            try:
                call = waiting.popleft()
            except IndexError:  # another thread was faster
                return
            try:
                call()
            except BaseException:  # or Ctrl-C
                waiting.clear()
                raise

    def helped() -> None:
        try:
            places.pop()
        except IndexError:  # all is done
            return
        error = None
        try:
            work()
        except BaseException as met:  # raised where it was called for
            error = met
        done.put(error)

    _begin(len(places))
    for _ in range(threads - 1):
        _asked.put(helped)
    try:
        work()
    finally:
        taken = threads - 1 - _left(places)
        errors = [done.get() for _ in range(taken)]
    for error in errors:
        if error is not None:
            raise error


def _left(places: deque[int]) -> int:
    """How many places nobody has taken, and nobody will."""
    left = 0
    while places:
        try:
            places.pop()
        except IndexError:
            return left
        left += 1
    return left


def _serve() -> None:
    while call := _asked.get():
        call()
        del call  # and the arrays that it works on


def _begin(threads: int) -> None:
    """Have so many threads."""
    while len(_threads) < threads:
        # At the end of the program daemons are not waited for, but they are stopped before (`_stop`).
        thread = threading.Thread(target=_serve, name=f"sattools-{len(_threads)}", daemon=True)
        _threads.append(thread)
        thread.start()


def _stop() -> None:
    """Wait for kernels that an interrupt has left running: the memory that they write to must not go before them."""
    for _ in _threads:
        _asked.put(None)
    for thread in _threads:
        thread.join()


def _forget() -> None:
    """A forked child has none of its parent's threads."""
    global _asked
    _asked = SimpleQueue()
    _threads.clear()


atexit.register(_stop)
os.register_at_fork(after_in_child=_forget)

__all__ = ["together"]
