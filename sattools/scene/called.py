"""What is different where a program calls a function of the suite, and no shell a command."""

from __future__ import annotations

import re
from collections.abc import Iterator
from contextlib import contextmanager

from sattools.errors import SattoolsError

# flags that errors advise to give, as words of their own; not those within a command line, which stands in `...`
_ADVICE = re.compile(r"(`[^`]*`)|(?<![^\s(])--(overwrite|resume)\b(?!-)")


@contextmanager
def by_a_program() -> Iterator[None]:
    """Errors name flags as Python gives them.

    Raises:
        SattoolsError: what the suite raises inside.
    """
    try:
        yield
    except SattoolsError as error:
        error.args = tuple(for_python(part) if isinstance(part, str) else part for part in error.args)
        raise


def for_python(text: str) -> str:
    """A message whose advice is for Python: ``overwrite=True`` in place of ``--overwrite``.

    Args:
        text: as the command line has it.
    """
    return _ADVICE.sub(lambda found: found[1] or f"{found[2]}=True", text)


__all__ = ["by_a_program", "for_python"]
