"""Options of `sattools compare`."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from sattools.errors import InputError
from sattools.settings import option

HALVES = ("west", "east", "south", "north")


@dataclass
class CompareOptions:
    """Options of `sattools compare`."""

    truth: str | None = option(None, "Folder of reference files in the layout that --protocol names.", path="folder")
    protocol: Literal["dfc2019"] = option("dfc2019", "Layout of --truth.")
    dsm: str | None = option(None, "Reference DSM (any georeferenced raster), instead of --truth.", path="file")
    classes: str | None = option(None, "Class map beside --dsm: 2 ground, 5 trees, 6 building, 9 water.", path="file")
    predicted: str | None = option(None, "DSM to score, instead of the scene's; then no scene is read.", path="file")
    aoi: str | None = option(None, "Name of the tile in --truth [default: the scene's id].")
    register: Literal["ncc", "nuth-kaab", "z", "none"] = option(
        "ncc",
        "ncc: whole cells, then mean height; nuth-kaab: parts of cells, for open ground; z: mean height only; none. "
        "But for none, heights count to 10 m beyond the reference's range.",
    )
    region: str | None = option(
        None,
        "Part to score: west, east, north, south or W,S,E,N in the reference's CRS (the scene's for one in degrees or "
        "feet).",
    )
    map: list[str] = option(
        [], "Parameter map to score, NAME=REFERENCE, NAME a product of the scene; repeatable.", path="NAME=FILE"
    )
    points: str | None = option(
        None,
        "Samples (CSV with name, x, y or lon, lat; GeoPackage) of reflectance_1 ..., theta or any product.",
        path="file",
    )
    views: bool = option(False, "Also score the rendered images of held-out views.")
    lpips_weights: list[str] = option(
        [],
        "With --views: safetensors file of LPIPS's weights (AlexNet's and its own may be two files); repeatable.",
        path="file",
    )
    fit: list[str] = option(
        [],
        "Exported scene to score beside others, NAME=SCENE.json (NAME such as Lam, RPV, Hpk); repeatable. No other "
        "scene is read, and tables and figures of all go to --out.",
    )
    out: str | None = option(
        None, "With --predicted: folder for the difference map; with --fit: for everything.", path="new folder"
    )

    def __post_init__(self) -> None:
        name_and_file(self.map, "--map")
        name_and_file(self.fit, "--fit")
        if self.classes is not None and self.dsm is None:
            raise InputError(
                f"--classes: found {self.classes} without --dsm, expected both: the reference of --truth, and that of "
                "a simulated scene, has a class map of its own"
            )
        if self.region is not None:
            parse_region(self.region)


def name_and_file(texts: Sequence[str], option: str) -> dict[str, Path]:
    """Files by name, of texts NAME=FILE.

    Args:
        texts: of the option.
        option: its name, for messages.

    Raises:
        InputError: another text, or a name twice.
    """
    files: dict[str, Path] = {}
    for text in texts:
        name, separator, file = text.partition("=")
        if not (separator and name and file):
            raise InputError(f"{option}: found {text!r}, expected NAME=FILE")
        if name in files:
            raise InputError(f"{option}: found {name!r} twice, expected every name once")
        files[name] = Path(file)
    return files


def without_effect(options: CompareOptions, given: Iterable[str]) -> list[tuple[str, str]]:
    """Those of some options that do nothing beside the others, each with what was expected.

    Args:
        options: of the comparison.
        given: names of options that the user gave.
    """
    idle = {} if options.truth else {"aoi": "expected --truth beside it"}
    idle |= {} if options.views else {"lpips_weights": "expected --views beside it"}
    return [(name, idle[name]) for name in given if name in idle]


def parse_region(text: str) -> str | tuple[float, float, float, float]:
    """A half, ``west`` and so on, or west, south, east, north. Raises InputError for another text."""
    if text in HALVES:
        return text
    try:
        west, south, east, north = (float(value) for value in text.replace(",", " ").split())
    except ValueError:
        raise InputError(
            f"--region: found {text!r}, expected west, east, north, south or four numbers W,S,E,N"
        ) from None
    return west, south, east, north


__all__ = ["HALVES", "CompareOptions", "name_and_file", "parse_region", "without_effect"]
