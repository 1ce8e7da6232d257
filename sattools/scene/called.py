"""What is different where a program calls a function of the suite, and no shell a command."""

from __future__ import annotations

import re
import sys
import threading
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from typing import Any

from sattools.errors import SattoolsError
from sattools.processors import imported

# flags that errors advise to give, as words of their own; not those within a command line, which stands in `...`
_ADVICE = re.compile(r"(`[^`]*`)|(?<![^\s(])--(overwrite|resume)\b(?!-)")


@contextmanager
def by_a_program() -> Iterator[None]:
    """Errors name flags as Python gives them, images without a place are not warned of, PyTorch is as it comes.

    That is so from the beginning of a call to its end, not only while a file is open: rasterio and others change the
    filters of warnings for a while as well, and what they put back, with threads side by side, has to have ours.

    Raises:
        SattoolsError: what the suite raises inside.
    """
    from sattools.scene.gdal import not_georeferenced

    try:
        with not_georeferenced, _torch_as_it_comes():
            yield
    except SattoolsError as error:
        error.args = tuple(for_python(part) if isinstance(part, str) else part for part in error.args)
        raise


@contextmanager
def _torch_as_it_comes() -> Iterator[None]:
    """What a program has asked of PyTorch for its own work, such as no gradients, holds for that alone.

    A fit needs gradients, float32 and the device that it is told. Where PyTorch is not imported yet, nobody has asked.
    """
    torch = imported("torch")
    with ExitStack() as modes:
        if torch is not None:
            modes.enter_context(_float32)
            for mode in (torch.inference_mode(False), torch.enable_grad()):
                modes.enter_context(mode)
            for kind in ("cpu", "cuda"):
                if torch.is_autocast_enabled(kind):
                    modes.enter_context(torch.autocast(kind, enabled=False))
            if torch.get_default_device().type != "cpu":  # only then: it is asked at every call of PyTorch
                modes.enter_context(torch.device("cpu"))
        yield


class _Float32:
    """PyTorch's numbers are float32, which belongs to the process: the last thread to go puts back what was before."""

    def __init__(self) -> None:
        self._lock, self._inside, self._before = threading.Lock(), 0, None

    def __enter__(self) -> None:
        torch: Any = sys.modules["torch"]
        with self._lock:
            self._inside += 1
            if self._inside == 1:
                self._before = torch.get_default_dtype()
                torch.set_default_dtype(torch.float32)

    def __exit__(self, *error: object) -> None:
        with self._lock:
            self._inside -= 1
            if not self._inside:
                sys.modules["torch"].set_default_dtype(self._before)


_float32 = _Float32()


def for_python(text: str) -> str:
    """A message whose advice is for Python: ``overwrite=True`` in place of ``--overwrite``.

    Args:
        text: as the command line has it.
    """
    return _ADVICE.sub(lambda found: found[1] or f"{found[2]}=True", text)


__all__ = ["by_a_program", "for_python"]
