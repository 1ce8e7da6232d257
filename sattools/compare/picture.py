"""Picture of a signed difference map."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from sattools.scene.grid import Grid
from sattools.scene.raster import atomic


def difference_picture(difference: np.ndarray, grid: Grid, title: str, path: Path, limit_m: float = 5.0) -> None:
    """PNG of `difference` [H, W] in metres: blue too low, red too high, grey not scored; scale ±`limit_m`."""
    from matplotlib import colormaps
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    # matplotlib's pyplot would keep global state and could open a window
    figure = Figure(figsize=(7.2, 6.2), dpi=110, layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.add_subplot()
    west, south, east, north = grid.bounds
    colours = colormaps["RdBu_r"].with_extremes(bad="0.75")
    shown = axes.imshow(
        np.ma.masked_invalid(difference),
        cmap=colours,
        vmin=-limit_m,
        vmax=limit_m,
        extent=(0.0, east - west, 0.0, north - south),
        interpolation="nearest",
    )
    axes.set_title(title)
    axes.set_xlabel(f"metres east of {west:.0f}")
    axes.set_ylabel(f"metres north of {south:.0f} ({grid.crs})")
    figure.colorbar(shown, ax=axes, extend="both", label="prediction minus reference [m]")
    with atomic(path) as temporary:
        figure.savefig(temporary, format="png")
