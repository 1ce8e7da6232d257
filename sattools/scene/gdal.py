"""What GDAL and libtiff say: of a full disk in errors of several kinds, and where there is nothing to be said."""

from __future__ import annotations

import ctypes
import functools
import logging
import os
import shutil
import threading
import warnings
from contextlib import ExitStack, suppress
from pathlib import Path

from rasterio._err import CPLE_BaseError
from rasterio.errors import NotGeoreferencedWarning, RasterioError
from rasterio.io import DatasetReader

from sattools.scene.chips import camera_of_chip

log = logging.getLogger(__name__)

ERRORS = (RasterioError, CPLE_BaseError)  # the second is what closing a file raises, and is not one of the first
_PIECE = 4 << 20  # bytes: more than may be left where GDAL found too little


def why_not_written(path: Path, error: Exception) -> OSError:
    """What is wrong with a file that GDAL could not write, which goes afterwards.

    Args:
        path: the file, or what there is of it.
        error: what GDAL said, often "see previous exception".

    Returns: the system's own error where there still is one.
    """
    try:
        with open(path, "ab") as file:  # what the system says of a few bytes more
            file.write(bytes(_PIECE))
            file.flush()
            os.fsync(file.fileno())
    except OSError as found:
        return found
    # GDAL may have removed the file, and there is room again
    left = shutil.disk_usage(path.parent).free >> 20
    return OSError(5, f"{' '.join(str(error).split())[:200]}; {left} MiB are free now")


def rpc_tags(data: DatasetReader) -> dict[str, str]:
    """The RPC that GDAL finds in an image or in a file beside it, of the image if it is part of a whole; empty = none.

    What it has against a file beside the image waits in its state for the next call, of whatever: it is taken out.

    Args:
        data: an image.

    Raises:
        InputError: see `sattools.scene.chips.camera_of_chip`.
    """
    tags = dict(data.tags(ns="RPC"))
    for _ in range(2):  # it may have something against several
        try:
            data.colorinterp  # noqa: B018  # any call that looks at the state
        except CPLE_BaseError as error:
            log.debug("%s: %s", data.name, error)
    return camera_of_chip(tags, data.tags(), data.name) if tags else tags


class _Quiet:
    """No warning of images without a place on the ground, which is how sensors see; by threads side by side, too.

    The filters of warnings belong to the process: the first thread to come sets them, the last to go puts them back.
    """

    def __init__(self) -> None:
        self._lock, self._inside, self._before = threading.Lock(), 0, ExitStack()

    def __enter__(self) -> None:
        with self._lock:
            self._inside += 1
            if self._inside == 1:
                self._before.enter_context(warnings.catch_warnings())
                warnings.simplefilter("ignore", NotGeoreferencedWarning)

    def __exit__(self, *error: object) -> None:
        with self._lock:
            self._inside -= 1
            if not self._inside:
                self._before.close()


not_georeferenced = _Quiet()


@functools.cache
def quiet_libtiff() -> None:
    """Keep libtiff from printing on its own, as it does on a full disk; what it finds is an error of GDAL all the same.

    GDAL asks it not to, but for the functions that read and write.
    """
    with suppress(OSError, AttributeError):
        for line in Path("/proc/self/maps").read_text().splitlines():
            path = "/" + line.partition("/")[2]
            if os.path.basename(path).startswith("libtiff"):
                ctypes.CDLL(path).TIFFSetErrorHandler(None)


__all__ = ["ERRORS", "not_georeferenced", "quiet_libtiff", "rpc_tags", "why_not_written"]
