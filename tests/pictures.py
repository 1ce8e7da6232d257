"""Pictures of one pixel, for tests that do not look at them: drawing one takes half of a small scene's `export`."""

import io
import os
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

UNDRAWN = "PICTURES_OF_ONE_PIXEL"  # in the environment of programs that `forked` makes of this process


@contextmanager
def undrawn() -> Iterator[None]:
    """All that is drawn meanwhile has one pixel, here and in what `forked` starts."""
    from matplotlib.figure import Figure
    from PIL import Image

    stream = io.BytesIO()
    Image.new("RGB", (1, 1)).save(stream, "png")

    def save(figure: Any, file: Any, **options: Any) -> None:
        file.write(stream.getvalue())

    before, Figure.savefig = Figure.savefig, save
    os.environ[UNDRAWN] = "1"
    try:
        yield
    finally:
        Figure.savefig = before
        os.environ.pop(UNDRAWN, None)
