"""What PyTorch's wheel brings for its own developers, left out: its test programs, `protoc`, its headers.

A wheel cannot be installed in part, and these are a fifth of it. They are taken out as an installer would do it: by the
list of files that came with the wheel, which then says what is there, so that `pip check`, `pip uninstall` and a later
upgrade find an installation that agrees with its list.
"""

from __future__ import annotations

import csv
import importlib.metadata
import io
import os
from pathlib import Path, PurePosixPath

from sattools.errors import SattoolsError

INSTALLERS = ("pip", "uv")
KEPT = "torch_shm_manager"  # which processes that share tensors start


def for_developers(name: PurePosixPath) -> bool:
    """Whether a file of PyTorch is of no use to programs that only import it.

    Headers are for those who compile extensions or call ``torch.compile``, which this suite does not.

    Args:
        name: relative to the folder of packages.
    """
    room = name.parts[:2]
    return room in (("torch", "test"), ("torch", "include")) or (room == ("torch", "bin") and name.name != KEPT)


def leave_out(distribution: importlib.metadata.Distribution) -> int:
    """Remove what is `for_developers` from an installed PyTorch and from its list of files; the bytes removed.

    Args:
        distribution: of PyTorch.

    Raises:
        SattoolsError: it was not installed by pip or uv, or its folder cannot be written.
    """
    installer = (distribution.read_text("INSTALLER") or "").strip()
    record = distribution.read_text("RECORD")
    if installer not in INSTALLERS or record is None:
        raise SattoolsError(f"torch: found it installed by {installer or 'nobody'}, expected {' or '.join(INSTALLERS)}")
    rows = list(csv.reader(io.StringIO(record)))
    wanted = [PurePosixPath(row[0]) for row in rows if row and for_developers(PurePosixPath(row[0]))]
    removed = 0
    try:
        for name in wanted:
            path = Path(str(distribution.locate_file(str(name))))
            if path.is_file():
                removed += path.stat().st_size
                path.unlink()
        _remove_empty({Path(str(distribution.locate_file(str(name)))).parent for name in wanted})
        _rewrite(distribution, [row for row in rows if row and PurePosixPath(row[0]) not in set(wanted)])
    except OSError as error:
        raise SattoolsError(f"{error.filename}: cannot be removed or written ({error.strerror})") from None
    return removed


def _rewrite(distribution: importlib.metadata.Distribution, rows: list[list[str]]) -> None:
    listed = next(file for file in distribution.files or () if file.name == "RECORD")
    path = Path(str(distribution.locate_file(listed)))
    text = io.StringIO()
    csv.writer(text, lineterminator="\n").writerows(rows)
    whole = path.with_name("RECORD.new")
    whole.write_text(text.getvalue(), encoding="utf-8")
    os.replace(whole, path)


def _remove_empty(folders: set[Path]) -> None:
    """Folders without anything in them, and those above that are empty then."""
    for folder in sorted(folders, key=lambda path: -len(path.parts)):
        while folder.is_dir() and not any(folder.iterdir()):
            folder.rmdir()
            folder = folder.parent


__all__ = ["for_developers", "leave_out"]
