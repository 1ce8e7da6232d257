"""Options of `sattools prior`."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from sattools.errors import InputError
from sattools.settings import option


@dataclass(frozen=True)
class PriorOptions:
    """What `prior` does; the field's help texts are the command's help."""

    resolution: float | None = option(
        None, "Cell of the surface [m] (default: the scene grid's).", minimum=0.01, maximum=1e4
    )
    detail: float = option(
        0.7,
        "Cell of the matching, as a share of the surface's: windows of few finer cells lie on one side of a step.",
        minimum=0.2,
        maximum=1.0,
    )
    step: float | None = option(
        None,
        "Distance of the height planes [m] (default: two cells of the matching, more for nearly parallel views).",
        minimum=0.01,
        maximum=100.0,
    )
    pairs: int = option(
        60,
        "Largest number of image pairs that are correlated, besides a few narrow ones; of 30 or more, those whose "
        "images are alike and whose angle is wide count most in the last pass.",
        minimum=1,
    )
    min_angle: float = option(
        12.0,
        "Smallest intersection angle of a pair [degrees]; a few narrower ones look into courtyards.",
        minimum=0,
        maximum=90,
    )
    max_angle: float = option(40.0, "Largest intersection angle of a pair [degrees].", minimum=0, maximum=90)
    ideal_angle: float = option(25.0, "Intersection angle that is preferred [degrees].", minimum=0, maximum=90)
    window: int = option(
        1, "Half width of the window in cells that are compared (1: 3 x 3 cells).", minimum=1, maximum=16
    )
    noise: float = option(0.005, "Contrast below which no structure is asked for (radiance).", minimum=1e-6)
    brightness: float = option(
        0.1,
        "Difference of radiance at which two images agree by half; three times as much on hills, up to twice where "
        "few images agree about little.",
        minimum=1e-6,
    )
    unseen: float = option(
        0.35,
        "Agreement assumed where no pair of images sees a point, 0 to 1; of three or more pairs 0.6 times that above "
        "all that they show: less keeps the surface away from such points, more lets it pass through them.",
        minimum=0,
        maximum=1,
    )
    weak: float = option(
        0.05,
        "Weight of an image from which the surface hides a point, in place of --unseen; with 4 pairs or more, on hills "
        "30.",
        minimum=0,
        maximum=1,
    )
    water: Literal["level", "keep"] = option(
        "level",
        "Wide water with waves, of which no two images show the same: laid level with its shore, without confidence, "
        "or kept as it is matched, in lumps.",
    )
    mixed: float = option(
        0.1,
        "Factor of a pair's weight where one image shows sun and the other shadow; with 4 pairs or more, on hills 30.",
        minimum=0,
        maximum=1,
    )
    blurred: float = option(
        0.2,
        "What an image counts, at least, that is much less sharp than others, or has pixels more than twice as wide: "
        "so little with 12 images or more, the fewer there are the more, with 4 as much as any; 1 = all count alike.",
        minimum=0.01,
        maximum=1,
    )
    small_jump: float = option(
        0.2,
        "Semi-global penalty for a height change of one plane (an agreement); half on hills, else up to 1.5 x with "
        "fewer than 30 pairs.",
        minimum=0,
    )
    large_jump: float = option(
        0.4,
        "Semi-global penalty for any larger height change (an agreement); 0.4 times that where the images' mean shows "
        "an edge at the upper height, 1.4 times where it shows none; up to 4 x with fewer than 60 pairs.",
        minimum=0,
    )
    rough_passes: int = option(
        5, "Passes, at most, at twice the cell that find the occlusions; 0 = ignore occlusion.", minimum=0, maximum=100
    )
    erode: float = option(
        2.0,
        "Radius by which the surface is eroded before its occlusions are computed [m], at least a cell of the rough "
        "passes; 0 = not at all.",
        minimum=0,
        maximum=50.0,
    )
    tolerance: float = option(
        2.0, "Depth below the visible surface from which a point is hidden [m]; at least two planes.", minimum=0
    )
    edges: float = option(
        0.03,
        "Spread of brightness on one material, three times as much on hills: where the images change by more, height "
        "changes are cheaper and, on level ground, walls are put; 0 = not.",
        minimum=0,
    )
    memory: float = option(1500.0, "Cost volume above which the area is matched in blocks [MB].", minimum=10)
    per_image: bool = option(False, "Also write the depth and confidence that every image sees, on its own pixels.")

    def __post_init__(self) -> None:
        if self.min_angle > self.max_angle:
            raise InputError(
                f"--min-angle: found {self.min_angle:g}, expected at most {self.max_angle:g} (--max-angle)"
            )


__all__ = ["PriorOptions"]
