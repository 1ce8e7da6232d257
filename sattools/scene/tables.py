"""Tables of places in CSV files, as spreadsheets of all languages write them."""

from __future__ import annotations

import csv
import io
import re
from collections.abc import Collection
from pathlib import Path

from sattools.errors import InputError
from sattools.scene.jsonio import read_text

DELIMITERS = (",", ";", "\t")  # of columns; the first where a heading has none
_COMMA = re.compile(r"[+-]?\d*,\d+([eE][+-]?\d+)?")  # a number whose decimals begin with a comma


def read_table(path: Path, what: str, texts: Collection[str] = ()) -> list[dict[str, str]]:
    """Rows of a CSV by its headings, in small letters and without blanks around them.

    Columns are parted by commas, semicolons or tabs; but for commas, decimals may begin with a comma, too.

    Args:
        path: the file.
        what: it should hold, for messages.
        texts: columns that hold no numbers, and stay as they are.

    Raises:
        InputError: it cannot be read.
    """
    text = read_text(path).lstrip("\r\n")
    delimiter = max(DELIMITERS, key=text.split("\n", 1)[0].count)
    try:
        rows = list(csv.DictReader(io.StringIO(text), delimiter=delimiter, skipinitialspace=True))
    except csv.Error as error:
        raise InputError(f"{path}: cannot be read ({error}), expected a CSV of {what}") from None
    named = [{k.strip().lower(): v.strip() for k, v in row.items() if k is not None and v is not None} for row in rows]
    if delimiter == ",":
        return named
    return [{k: v if k in texts else _with_point(v) for k, v in row.items()} for row in named]


def _with_point(text: str) -> str:
    """A number with a point before its decimals; what is no number stays as it is."""
    return text.replace(",", ".") if _COMMA.fullmatch(text) else text


__all__ = ["read_table"]
