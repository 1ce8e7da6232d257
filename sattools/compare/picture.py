"""Picture of a signed difference map."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np

from sattools.scene.files import write_figure
from sattools.scene.grid import Grid

MOST_CELLS = 1200  # along an edge, half as many again as the picture has pixels: more would take memory unseen
LIMIT_M = 5.0  # difference at the ends of the colours
PREDICTION = "prediction minus reference"


def difference_picture(difference: np.ndarray, grid: Grid, title: str, path: Path, what: str = PREDICTION) -> None:
    """PNG of `difference_figure`.

    Args:
        difference: ``[H, W]`` [m].
        grid: ground grid.
        title: of the picture.
        path: file to write.
        what: is subtracted from what.
    """
    write_figure(path, difference_figure(difference, grid, title, what))


def difference_figure(difference: np.ndarray, grid: Grid, title: str, what: str = PREDICTION) -> Any:
    """Matplotlib figure of `difference` [H, W] in metres: blue too low, red too high, grey not known; ±`LIMIT_M`.

    Args:
        difference: ``[H, W]`` [m].
        grid: ground grid.
        title: of the picture.
        what: is subtracted from what.
    """
    from matplotlib import colormaps
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    # matplotlib's pyplot would keep global state and could open a window
    figure = Figure(figsize=(7.2, 6.2), dpi=110, layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.add_subplot()
    west, south, east, north = grid.bounds
    step = math.ceil(max(difference.shape) / MOST_CELLS)
    colours = colormaps["RdBu_r"].with_extremes(bad="0.75")
    shown = axes.imshow(
        np.ma.masked_invalid(difference[::step, ::step]),
        cmap=colours,
        vmin=-LIMIT_M,
        vmax=LIMIT_M,
        extent=(0.0, east - west, 0.0, north - south),
        interpolation="nearest",
    )
    axes.set_title(_plain(title))
    axes.set_xlabel(f"metres east of {west:.0f}")
    axes.set_ylabel(f"metres north of {south:.0f} ({_plain(grid.crs)})")
    figure.colorbar(shown, ax=axes, extend="both", label=f"{what} [m]")
    return figure


def line_styles(count: int) -> list[dict[str, Any]]:
    """Keywords of `plot` for so many lines that can be told apart: colours first, dashes beside them beyond ten.

    Ten colours of matplotlib's own cycle; more are spread over a wide ramp, and neighbours differ in their dashes.
    """
    from matplotlib import colormaps

    if count <= 10:
        return [{"color": f"C{number}"} for number in range(count)]
    ramp, dashes = colormaps["turbo"], ("-", "--", ":", "-.")
    return [
        {"color": ramp(0.04 + 0.92 * number / (count - 1)), "linestyle": dashes[number % len(dashes)]}
        for number in range(count)
    ]


def _plain(text: str) -> str:
    """Text that matplotlib shows as it is: what stands between two dollars would be taken for a formula."""
    return text.replace("$", r"\$")


def scatter_picture(predicted: np.ndarray, reference: np.ndarray, name: str, path: Path) -> None:
    """PNG of values of a parameter map against their references: density of cells, line of equality.

    Args:
        predicted: ``[N]`` of the parameter; NaN = none.
        reference: ``[N]`` of the parameter; NaN = none.
        name: of the parameter.
        path: file to write.
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    both = np.isfinite(predicted) & np.isfinite(reference)
    p, r = predicted[both], reference[both]
    low, high = (float(f(np.concatenate([np.percentile(a, [0.5, 99.5]) for a in (p, r)]))) for f in (np.min, np.max))
    pad = 0.05 * (high - low) + 1e-6
    figure = Figure(figsize=(5.2, 4.8), dpi=110, layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.add_subplot()
    extent = (low - pad, high + pad, low - pad, high + pad)
    shown = axes.hexbin(r, p, gridsize=60, extent=extent, bins="log", mincnt=1, cmap="viridis")
    axes.plot(extent[:2], extent[:2], color="0.3", linewidth=1)
    axes.set(xlabel=f"{_plain(name)}, reference", ylabel=f"{_plain(name)}, found", xlim=extent[:2], ylim=extent[2:])
    figure.colorbar(shown, ax=axes, label="cells")
    write_figure(path, figure)
