"""The one way in which the suite opens rasters: with known drivers, and no word to the network unasked."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import rasterio
from rasterio.errors import RasterioError
from rasterio.io import DatasetReader

from sattools.errors import InputError
from sattools.scene.gdal import not_georeferenced
from sattools.scene.location import RemotePath, location, needs_network

# GDAL opens by content: a `.tif` may hold the XML of a VRT, WMS or WCS that names any file or host. These are images.
DRIVERS = (
    *("GTiff", "NITF", "JP2OpenJPEG", "JP2KAK", "JP2ECW", "JP2MrSID", "JPEG", "PNG"),
    *("HFA", "ENVI", "EHdr", "AAIGrid", "SRTMHGT"),
)
_FORMATS = "GeoTIFF, NITF, JPEG 2000, JPEG, PNG, HFA (.img), ENVI, EHdr, AAIGrid (.asc) or SRTM"
_LISTS = {  # what names other files
    ".vrt": "a VRT, which names other files: gdal_translate makes a GeoTIFF of it",
    ".til": "a list of the tiles of an image: give the .TIF files that it names",
}
# a sidecar (.aux.xml) may name overviews anywhere: nothing but what the user named is asked for
_NO_NETWORK = {"CPL_VSIL_CURL_ALLOWED_FILENAME": "-", "CPL_VSIL_CURL_NON_CACHED": "/vsicurl/"}
_ALONE = {"GDAL_DISABLE_READDIR_ON_OPEN": "EMPTY_DIR"}
_LARGE = 1 << 29  # bytes of pixels
_MOST_BANDS = 1000  # no imaging spectrometer has more
_MOST_COMPRESSED = 4000  # times; an empty image in DEFLATE reaches 1000
# a host that does not answer must not hold a command for ever
_PATIENCE = {"GDAL_HTTP_CONNECTTIMEOUT": "30", "GDAL_HTTP_LOW_SPEED_LIMIT": "1", "GDAL_HTTP_LOW_SPEED_TIME": "60"}


@contextmanager
def opened(path: Path | str, what: str = "an image", *, alone: bool = False) -> Iterator[DatasetReader]:
    """A raster in any geometry.

    Args:
        path: of the file.
        what: that it should be, for error messages.
        alone: leave out what GDAL finds in files beside it.

    Raises: InputError, one line: missing, not a file, not `what` that one of `DRIVERS` reads, without bands.
    """
    path = location(path)
    # rasterio takes what stands before a colon for a scheme, as in the name of a folder `file:2`
    local = ":" in str(path) and not (isinstance(path, RemotePath) or path.is_absolute() or path.drive)
    name = f"./{path}" if local else str(path)
    settings = (_PATIENCE if needs_network(path) else _NO_NETWORK) | (_ALONE if alone else {})
    with not_georeferenced, rasterio.Env(**settings):
        try:
            data = DatasetReader(name, driver=list(DRIVERS))  # `rasterio.open` takes one driver only
        except (RasterioError, OSError, ValueError, UnicodeError) as error:
            raise InputError(_why_not(path, error, what)) from None
        with data:
            if data.count == 0:
                raise InputError(f"{path}: found a container without bands, expected {what}")
            if data.count > _MOST_BANDS:  # reading them one by one would take hours
                raise InputError(f"{path}: found {data.count} bands, expected at most {_MOST_BANDS} (is it damaged?)")
            _check_size(data, path)
            yield data


def _check_size(data: DatasetReader, path: Path) -> None:
    """Raise InputError where a few bytes claim to be gigabytes of pixels, as in a damaged or hostile header."""
    pixels = data.width * data.height * data.count * np.dtype(data.dtypes[0]).itemsize
    if pixels < _LARGE or isinstance(path, RemotePath) or data.driver in ("ENVI", "EHdr"):  # a header beside the pixels
        return
    stored = path.stat().st_size
    if pixels > _MOST_COMPRESSED * stored:
        raise InputError(
            f"{path}: found {data.width} x {data.height} pixels in a file of {stored} bytes, expected an image with "
            "content (is it sparse or damaged?)"
        )


def _why_not(path: Path, error: Exception, what: str) -> str:
    """What is wrong with a file that cannot be opened, in one line without GDAL's own names of things."""
    name = str(path).encode(errors="backslashreplace").decode()
    try:
        if isinstance(path, RemotePath):
            return f"{name}: cannot be opened ({_gdal(error, path)}), expected {what}"
        if not path.exists():
            return f"{name}: no such file, expected {what}"
        if path.is_dir():
            return f"{name}: found a folder, expected {what}"
        if path.exists() and not path.is_file():
            return f"{name}: found no regular file, expected {what}"
    except (OSError, ValueError) as trouble:
        return f"{name}: found {getattr(trouble, 'strerror', None) or trouble}, expected {what}"
    return f"{name}: found no readable image ({_gdal(error, path)}), expected {what}"


def _gdal(error: Exception, path: Path) -> str:
    """GDAL's reason in words of ours where they are known."""
    text = " ".join(str(error).split()).replace(f"{path}: ", "").replace(f"'{path}' ", "").replace(str(path), "it")
    if "not recognized as" in text:  # which GDAL also says of what is missing in an archive
        if (ending := path.suffix.lower()) in _LISTS:
            return _LISTS[ending]
        why = f"not of a format that is read: {_FORMATS}"
        return f"not there, or {why}" if isinstance(path, RemotePath) else why
    return text[:200]


__all__ = ["DRIVERS", "opened"]
