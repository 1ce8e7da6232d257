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
    """Errors name flags as Python gives them, and images without a place on the ground are not warned of.

    That is so from the beginning of a call to its end, not only while a file is open: rasterio and others change the
    filters of warnings for a while as well, and what they put back, with threads side by side, has to have ours.

    Raises:
        SattoolsError: what the suite raises inside.
    """
    from sattools.scene.gdal import not_georeferenced

    try:
        with not_georeferenced:
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
