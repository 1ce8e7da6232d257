"""What the renderer needs to know of one view: parallel rays over the ground grid."""

from __future__ import annotations

from dataclasses import dataclass

from sattools.camera.view_direction import ViewDirection


@dataclass(frozen=True)
class ParallelRays:
    """Parallel rays of one view, one per cell of the ground grid.

    The ray of cell (row, col) crosses the height `z_ref` at the centre of that cell, moved by `offset`. Over a tile the
    lines of sight of an orbiting camera are parallel to within a few centimetres (see `sattools.views.line_of_sight`).

    Attributes:
        slope: line of sight.
        z_ref: reference height [m].
        offset: (east, north) displacement of all rays at `z_ref` [m] (pose refinement).
    """

    slope: ViewDirection
    z_ref: float
    offset: tuple[float, float] = (0.0, 0.0)


@dataclass(frozen=True)
class Quadrature:
    """How far and how finely the rays are sampled.

    Attributes:
        softness: length s of the surface's logistic density [m].
        step: height between samples [m].
        z_top: height of the first sample [m].
        z_bottom: no sample below this height [m].
    """

    softness: float
    step: float
    z_top: float
    z_bottom: float


__all__ = ["ParallelRays", "Quadrature"]
