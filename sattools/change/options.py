"""Options of `sattools change`."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from sattools.settings import option


@dataclass(frozen=True)
class ChangeOptions:
    """How two surfaces are compared."""

    out: str = option("change", "Folder for the maps, polygons and the table.", path="new folder")
    register: Literal["ncc", "nuth-kaab", "z", "none"] = option(
        "ncc",
        "How the later surface is brought onto the earlier one: whole cells by correlation, below a cell by slopes, in "
        "height only, or not.",
    )
    min_height: float = option(
        2.0,
        "Smallest change of height of a region, in the mean and in each of its cells [m]: its volume is without the "
        "foot of a heap that is lower than that (--polygons counts all of it).",
        minimum=0.0,
    )
    min_area: float = option(25.0, "Smallest area of a region [m2].", minimum=0.0)
    rim: float = option(
        1.5,
        "Regions narrower than twice that are the edges of things that have not changed [m].",
        minimum=0.0,
        maximum=100.0,
    )
    noise: float | None = option(
        None,
        "Standard deviation of the difference where nothing has changed, beside what surfaces state themselves [m] "
        "(default: the scatter of all of it, as most of an area has not changed; where most has, it is to be given, "
        "and --register none).",
        minimum=0.0,
        maximum=1000.0,
    )
    correlation: float = option(5.0, "Distance over which errors of heights go together [m].", minimum=0.0)
    confidence: float = option(
        0.95,
        "Probability with which a surface without changes shows no region at all, by its noise; of scenes, places "
        "where matching failed are left out, too, which rasters of heights do not tell.",
        minimum=0.5,
        maximum=0.999999,
    )
    min_confidence: float = option(
        0.25,
        "Least confidence of both dates' matching within a region of up to 50 m2, its median; larger ones need less.",
        minimum=0.0,
        maximum=1.0,
    )
    polygons: str | None = option(None, "Vector file: change and volume within each of its polygons, too.", path="file")


__all__ = ["ChangeOptions"]
