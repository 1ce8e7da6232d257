"""What earlier calls have left in a batch's folder, and no longer goes with what is done now."""

from __future__ import annotations

import logging
from collections.abc import Collection, Sequence
from pathlib import Path

from sattools.batch.gate import joined_folder, joined_scenes
from sattools.batch.join import FILES
from sattools.batch.plan import Configuration, is_of
from sattools.batch.table import Row, earlier_rows

log = logging.getLogger(__name__)


def comparable_rows(
    out: Path, pairs: Collection[tuple[str, str]], configurations: Sequence[Configuration]
) -> list[Row]:
    """Rows of earlier calls; those of other options under a name that this call has are told and left out.

    Args:
        out: folder of the batch.
        pairs: (scene, configuration) of this call.
        configurations: of this call.
    """
    now = {c.name: c for c in configurations}
    rows = earlier_rows(out, pairs)
    others = [
        r for r in rows if (c := now.get(r["configuration"])) and not is_of(out / "runs" / c.name / r["scene"], c)
    ]
    for name in dict.fromkeys(row["configuration"] for row in others):
        log.warning(
            "%s: has other options than in an earlier call, whose rows are left out of the table: give %s again, too",
            name, ", ".join(row["scene"] for row in others if row["configuration"] == name),
        )  # fmt: skip
    kept = [row for row in rows if row not in others]
    if kept:
        log.info("the table keeps %d rows of earlier calls", len(kept))
    return kept


def tell_of_joined(out: Path, anew: Collection[tuple[str, str]], configurations: Sequence[Configuration]) -> None:
    """Say which joined surfaces are not of what has been done anew.

    Args:
        out: folder of the batch.
        anew: (scene, configuration).
        configurations: of this call.
    """
    for c in configurations:
        folder = joined_folder(out, c.name)
        if changed := sorted(joined_scenes(folder) & {scene for scene, name in anew if name == c.name}):
            log.warning(
                "%s: is still of what %s had before this call; --join makes it anew",
                folder / FILES[0], ", ".join(changed),
            )  # fmt: skip


__all__ = ["comparable_rows", "tell_of_joined"]
