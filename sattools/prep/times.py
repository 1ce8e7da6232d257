"""Times in vendors' files and in file names, as UTC."""

from __future__ import annotations

import logging
import re
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

from sattools.scene.schema import shown

log = logging.getLogger(__name__)

_SAME_TIME_S = 3.0  # by which images of one acquisition may be apart
FIRST_YEAR = 1960  # before the first photographs from orbit
_LAST_YEAR = 2099

# Without minutes, or after a space, only the end of a text is an offset: what follows a time in a name is a number.
_OFFSET = r"(?:([+-]\d\d):?(\d\d)(?!\d)|\s*([+-]\d\d)(?::?(\d\d))?\s*$)?"
_EXTENDED = re.compile(r"(\d{4})-(\d\d)-(\d\d)[T ](\d\d):(\d\d):(\d\d(?:\.\d+)?)" + _OFFSET)
_BASIC = re.compile(
    r"(?<!\d)((?:19|20)\d\d)(\d\d)(\d\d)[T-](\d\d)(\d\d)(\d\d(?:\.\d+)?)(?!\d)(?:\s*([+-]\d\d)(?::?(\d\d))?\s*$)?"
)
# YYMMMDDhhmmss before the product's level, as DigitalGlobe and Maxar name their files
_MONTHS = ("JAN", "FEB", "MAR", "APR", "MAY", "JUN", "JUL", "AUG", "SEP", "OCT", "NOV", "DEC")
_MAXAR = re.compile(
    rf"(\d\d)({'|'.join(_MONTHS)})(\d\d)(\d\d)(\d\d)(\d\d)-[PMSA]\d[A-Z]{{2}}(?![A-Z0-9])", re.IGNORECASE
)
_DIGITS = re.compile(r"(?<!\d)(\d{4})(\d\d)(\d\d)_?(\d\d)(\d\d)(\d\d)(?!\d{2})")


def parse_time(text: Any, *, of_file: bool = False) -> datetime | None:
    """UTC time wherever it stands in a text; None when there is no valid one.

    ISO text (``2014-10-17T15:48:58``, ``20141017T154858``), which may say how far its clock is from UTC (``+02:00``,
    ``+0200``, ``+02``; without that it is UTC, as vendors' is), or ``YYYYMMDDhhmmss`` and ``YYYYMMDD-hhmmss``; of a
    file's name ``YYMMMDDhhmmss-P1BS`` as well, but no year that no image is of.

    Args:
        text: to look in.
        of_file: the text is a file's name, where ``-01`` at the end is a number.
    """
    if of_file and (named := _MAXAR.search(str(text))):
        year, month, *rest = named.groups()
        text = f"20{year}{_MONTHS.index(month.upper()) + 1:02d}{''.join(rest)}"
    for pattern in (_EXTENDED, _BASIC, _DIGITS):
        for match in pattern.finditer(str(text)):
            year, month, day, hour, minute = (int(n) for n in match.groups()[:5])
            second = float(match[6])
            if of_file and not FIRST_YEAR <= year <= _LAST_YEAR:  # an order's number
                continue
            try:
                local = datetime(year, month, day, hour, minute, int(second), int(1e6 * (second % 1)), tzinfo=UTC)
            except (ValueError, OverflowError):
                continue
            offset = [part for part in match.groups()[6:] if part]
            if of_file and (pattern is _BASIC or len(offset) == 1):
                offset = []
            try:
                return local - _ahead(*offset)
            except (ValueError, OverflowError):
                return None
    return None


def _ahead(hours: str = "+00", minutes: str = "00") -> timedelta:
    """By how much a clock is ahead of UTC; ValueError for more than a day."""
    ahead = timedelta(hours=int(hours), minutes=int(f"{hours[0]}{minutes}"))
    if abs(ahead) >= timedelta(days=1):
        raise ValueError
    return ahead


def time_in_file(text: Any, path: Path) -> datetime | None:
    """The same of a metadata file, where a text that is no time is told: the image would be one of no date.

    Args:
        text: to look in.
        path: of the file.
    """
    found = parse_time(text)
    if found is None and re.search(r"\d", str(text)):
        log.warning(
            "%s: found the time %s, expected YYYY-MM-DDThh:mm:ss or YYYYMMDDhhmmss: taken for unknown",
            path,
            shown(text),
        )
    return found


def date_alone(time: datetime) -> bool:
    """A time of midnight to the second, which is how a date becomes a time where the hour is not known.

    Args:
        time: UTC.
    """
    return time.time() == time.min.time()


def same_moment(first: datetime | None, second: datetime | None) -> bool:
    """Whether two images are of one acquisition by their times; of dates alone nothing is known.

    Args:
        first: UTC; None = unknown.
        second: of the other image.
    """
    if first is None or second is None or date_alone(first) or date_alone(second):
        return False
    return abs((first - second).total_seconds()) <= _SAME_TIME_S


def middle_time(start: datetime | None, end: datetime | None) -> datetime | None:
    """Between two times; the one that is known where the other is not.

    Args:
        start: of taking the image.
        end: of the same.
    """
    return start + (end - start) / 2 if start and end else start or end


__all__ = ["FIRST_YEAR", "date_alone", "middle_time", "parse_time", "same_moment", "time_in_file"]
