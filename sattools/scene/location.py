"""Where files lie: paths, and addresses that GDAL reads through its virtual file systems.

`pathlib` folds the `//` of an address, so what the user gives goes through `location` once and keeps its spelling.
"""

from __future__ import annotations

import os
import re
import sys
from collections.abc import Iterable
from contextlib import AbstractContextManager
from pathlib import Path

from sattools.errors import InputError
from sattools.processors import in_environment

if sys.platform == "win32":
    from pathlib import WindowsPath as SystemPath
else:
    from pathlib import PosixPath as SystemPath

IMAGE_SUFFIXES = (".tif", ".tiff", ".ntf", ".nitf", ".jp2", ".img")
# what vendors deliver images in and beside them
_NO_IMAGES = {
    **dict.fromkeys(
        (".zip", ".tar", ".tgz", ".gz", ".7z"), "an archive, expected the images in it (unpacked, with their metadata)"
    ),
    **dict.fromkeys((".xml", ".imd", ".rpb", ".til"), "a metadata file, expected the image that it is about"),
}
_SCHEMES = {
    "http": "/vsicurl/http://",
    "https": "/vsicurl/https://",
    "ftp": "/vsicurl/ftp://",
    "s3": "/vsis3/",
    "gs": "/vsigs/",
    "az": "/vsiaz/",
}
_ADDRESS = re.compile(r"([A-Za-z][A-Za-z0-9+.-]+):/")  # one letter is a drive
_NAMED = 5  # folders
_NETWORK = re.compile(r"/vsi(curl|s3|gs|az|adls|oss|swift|hdfs|webhdfs)|[a-z0-9+.-]+://", re.IGNORECASE)
_SWITCH = "SATTOOLS_ALLOW_REMOTE"


class RemotePath(SystemPath):
    """A file that GDAL reads through a virtual file system; its name, stem and suffix are those of a path."""

    text: str

    def __new__(cls, *parts: str) -> RemotePath:
        """Keep the text as it is: a path would make one slash of two."""
        made = super().__new__(cls, *parts)
        made.text = str(parts[0]) if len(parts) == 1 else "/".join(map(str, parts))
        return made

    def __str__(self) -> str:
        return self.text

    def __fspath__(self) -> str:
        return self.text

    @property
    def parent(self) -> RemotePath:
        """The folder above, in the same spelling."""
        return RemotePath(self.text.rpartition("/")[0])

    def __reduce__(self) -> tuple[type[RemotePath], tuple[str]]:
        return RemotePath, (self.text,)


def is_remote(text: str | Path) -> bool:
    """The text is an address or a path of a virtual file system, not a file of this machine."""
    text = str(text)
    return text.lower().startswith("/vsi") or _ADDRESS.match(text) is not None


def needs_network(text: str | Path) -> bool:
    """Reading it sends requests to other machines; an archive on this one needs none."""
    return _NETWORK.search(str(text)) is not None


def location(text: str | Path) -> Path:
    """The file that the user names: a path, or a `RemotePath` in the form that GDAL reads.

    Raises: InputError (an empty text, or an address of a kind that is not known).
    """
    if isinstance(text, RemotePath):
        return text
    text = str(text)
    if not text:  # `Path` would make the current folder of it
        raise InputError("found an empty text, expected a file or folder")
    if not is_remote(text):
        return Path(text)
    if text.lower().startswith("/vsi"):
        return RemotePath(text)
    scheme, _, rest = text.partition(":")
    prefix = _SCHEMES.get(scheme.lower())
    if scheme.lower() == "file":
        return Path("/" + rest.lstrip("/"))
    if prefix is None:
        known = ", ".join(f"{name}://" for name in _SCHEMES)
        raise InputError(f"{text}: found an address that begins with {scheme}:, expected {known} or /vsi...")
    return RemotePath(prefix + rest.lstrip("/"))


def found_instead(path: str | Path, error: BaseException) -> str:
    """Why a file cannot be opened, in words of the system where it has some: of addresses, that they are no files.

    Args:
        path: as the user names it, or the path made of that.
        error: of opening it.
    """
    if is_remote(path) and not os.path.exists(path):
        return "an address where only files of this machine are read (download it)"
    return getattr(error, "strerror", None) or " ".join(str(error).split()) or type(error).__name__


def remote_allowed() -> AbstractContextManager[None]:
    """Let documents name files on other machines and in archives for a while, as the user has said that they may."""
    return in_environment(_SWITCH, "1")


def check_allowed(text: str) -> None:
    """Raise InputError unless documents may name remote files. Nothing may be sent because a file said so."""
    if os.environ.get(_SWITCH) != "1":
        raise InputError(
            f"found the remote or archived file {text[:200]!r}, expected a path below the scene's root or an absolute "
            "one (--allow-remote lets documents name others)"
        )


def images_in(folder: Path) -> list[Path]:
    """The images that lie in a folder itself, by name."""
    return sorted(path for path in folder.iterdir() if path.suffix.lower() in IMAGE_SUFFIXES)


def image_locations(names: Iterable[str]) -> list[Path]:
    """Images by path or address; a folder stands for the images in it.

    Args:
        names: as the user gives them.

    Raises:
        InputError: an address that is none, an archive, a metadata file, or a folder without images.
    """
    found: list[Path] = []
    for name in names:
        place = location(name)
        if isinstance(place, RemotePath) or not place.is_dir():
            what = _NO_IMAGES.get(place.suffix.lower())
            if what and not isinstance(place, RemotePath) and place.is_file():
                raise InputError(f"{place}: found {what}")
            found.append(place)
            continue
        inside = images_in(place)
        if not inside:
            why = f"found a folder without images, expected some ({' '.join(IMAGE_SUFFIXES)})"
            raise InputError(f"{place}: {why}{_where_images_are(place)}")
        found += inside
    return found


def _where_images_are(folder: Path) -> str:
    """Which folders up to three levels below one have images, as deliveries of several products do; "" where none has.

    Not all of them may be meant: panchromatic and multispectral images lie side by side.
    """
    below = [path for depth in ("*/*", "*/*/*", "*/*/*/*") for path in folder.glob(depth)]
    has = sorted({str(path.parent.relative_to(folder)) for path in below if path.suffix.lower() in IMAGE_SUFFIXES})
    if not has:
        return ""
    named = ", ".join(has[:_NAMED]) + (", ..." if len(has) > _NAMED else "")
    return f"; there are some in its folders {named}: give those that are meant"


__all__ = [
    "RemotePath",
    "check_allowed",
    "found_instead",
    "image_locations",
    "images_in",
    "is_remote",
    "location",
    "needs_network",
    "remote_allowed",
]
