"""Options of `sattools prior`."""

from __future__ import annotations

from dataclasses import dataclass

from sattools.settings import option


@dataclass(frozen=True)
class PriorOptions:
    """What `prior` does; the field's help texts are the command's help."""

    resolution: float | None = option(None, "Cell of the surface [m] (default: the scene grid's).", minimum=0.01)
    step: float | None = option(None, "Distance of the height planes [m] (default: two cells).", minimum=0.01)
    pairs: int = option(25, "Largest number of image pairs that are correlated.", minimum=1)
    min_angle: float = option(12.0, "Smallest intersection angle of a pair [degrees].", minimum=0, maximum=90)
    max_angle: float = option(40.0, "Largest intersection angle of a pair [degrees].", minimum=0, maximum=90)
    ideal_angle: float = option(25.0, "Intersection angle that is preferred [degrees].", minimum=0, maximum=90)
    window: int = option(2, "Half width of the correlation window in cells (2: 5 x 5 cells).", minimum=1, maximum=16)
    noise: float = option(0.003, "Radiance below which contrast is not trusted.", minimum=1e-6)
    small_jump: float = option(0.3, "Semi-global penalty for a height change of one plane (a correlation).", minimum=0)
    large_jump: float = option(1.5, "Semi-global penalty for any larger height change (a correlation).", minimum=0)
    rough_passes: int = option(2, "Passes at twice the cell that find what hides what; 0 = ignore hiding.", minimum=0)
    erode: float = option(3.0, "Radius by which the surface is thinned before it hides anything [m].", minimum=0)
    tolerance: float = option(1.5, "Depth below the visible surface from which a point is hidden [m].", minimum=0)
    memory: float = option(1500.0, "Cost volume above which the area is matched in strips [MB].", minimum=10)
    per_image: bool = option(False, "Also write the depth and confidence that every image sees, on its own pixels.")


__all__ = ["PriorOptions"]
