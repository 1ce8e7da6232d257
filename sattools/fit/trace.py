"""What happened during a fit, one row per epoch."""

from __future__ import annotations

import csv
import io
import time
from dataclasses import dataclass, field

Row = dict[str, float | int | str]  # by column


@dataclass
class Trace:
    """What happened when; one row per epoch."""

    rows: list[Row] = field(default_factory=list)
    offset: float = 0.0  # seconds spent before an interruption
    started: float = field(default_factory=time.perf_counter)

    def seconds(self) -> float:
        """Time spent on the fit, earlier runs of a resumed one included."""
        return self.offset + time.perf_counter() - self.started

    def go_on(self, rows: list[Row], seconds: float = 0.0) -> None:
        """Continue an interrupted run.

        Args:
            rows: of it; none where it was interrupted before the first.
            seconds: spent on it [s]; where they are not known, those of its last row count.
        """
        self.rows = rows
        self.offset = max(seconds, float(rows[-1]["seconds"]) if rows else 0.0)

    def to_csv(self) -> str:
        """The rows as CSV text."""
        text = io.StringIO()
        names = list(dict.fromkeys(name for row in self.rows for name in row))
        writer = csv.DictWriter(text, names, lineterminator="\n")
        writer.writeheader()
        writer.writerows(self.rows)
        return text.getvalue()


__all__ = ["Row", "Trace"]
