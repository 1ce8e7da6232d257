"""Figures of the report: data in, matplotlib figures out, units on every axis."""

from __future__ import annotations

import textwrap
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from sattools.compare.picture import line_styles
from sattools.scene.grid import Grid
from sattools.scene.validity import CLASSES as VALIDITY

Outline = Sequence[Sequence[float]]
UNKNOWN = "0.75"  # grey of cells without a value
NAME_LETTERS = 32  # as wide as one image's panel


def new_figure(width: float = 6.4, height: float = 4.4) -> Any:
    """An empty figure that belongs to no window."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(width, height), layout="constrained")
    FigureCanvasAgg(figure)
    return figure


def _in_lines(name: str) -> str:
    """The name of an image in lines of `NAME_LETTERS` at most: those of vendors are longer than pictures are wide."""
    return textwrap.fill(name, NAME_LETTERS)


def footprints(outlines: Mapping[str, Outline], area: Outline | None) -> Any:
    """Outlines [(lon, lat), ...] in degrees of images, and of the scene's grid."""
    figure = new_figure()
    axes = figure.subplots()
    for style, (name, outline) in zip(line_styles(len(outlines)), outlines.items(), strict=True):
        axes.plot(*np.asarray(outline, float)[:, :2].T, linewidth=1.2, label=_in_lines(name), **style)
    if area is not None:
        axes.fill(*np.asarray(area, float).T, color="0.5", alpha=0.3, label="ground grid")
    middle = np.mean([lat for outline in outlines.values() for _, lat in outline])
    axes.set_aspect(1 / np.cos(np.radians(middle)))
    axes.set(xlabel="longitude [degrees]", ylabel="latitude [degrees]")
    axes.ticklabel_format(useOffset=False)
    axes.tick_params("x", rotation=30)
    axes.grid(alpha=0.3)
    if len(outlines) <= 20:
        axes.legend(fontsize=7, loc="center left", bbox_to_anchor=(1.0, 0.5))
    return figure


def directions(suns: Sequence[tuple[float, float]], views: Sequence[tuple[float, float]]) -> Any:
    """Suns and sensors as (azimuth from north, angle from the vertical), both in degrees, seen from above."""
    figure = new_figure(5.2, 5.0)
    axes = figure.add_subplot(projection="polar")
    axes.set_theta_zero_location("N")
    axes.set_theta_direction(-1)
    for points, style, label in ((suns, "*", "sun"), (views, "o", "sensor")):
        if points:
            azimuth, zenith = np.asarray(points, float).T
            axes.plot(np.radians(azimuth), zenith, style, label=label, markersize=9 if style == "*" else 6)
    axes.set_rlim(0, 90)
    axes.set_title("azimuth from north, angle from the vertical [degrees]", fontsize=10)
    axes.legend(loc="lower right", bbox_to_anchor=(1.1, -0.1))
    return figure


def residuals(names: Sequence[str], before: Sequence[float], after: Sequence[float]) -> Any:
    """Median residual of every image's tie points before and after the adjustment, in pixels.

    Args:
        names: of the images.
        before: of each image [px].
        after: of each image [px].
    """
    labels = [_in_lines(name) for name in names]
    figure = new_figure(6.4, 1.4 + 0.22 * sum(1 + label.count("\n") for label in labels))
    axes = figure.subplots()
    rows = np.arange(len(names))
    axes.plot(before, rows, "o", color="0.6", label="before")
    axes.plot(after, rows, "o", color="tab:blue", label="after")
    axes.set_yticks(rows, labels, fontsize=7)
    axes.invert_yaxis()
    axes.set_xscale("log")
    axes.tick_params("x", which="both", labelsize=7, rotation=30)
    axes.set(xlabel="median residual of the tie points [pixels]")
    axes.grid(alpha=0.3)
    axes.legend()
    return figure


def residual_vectors(views: Mapping[str, np.ndarray]) -> Any:
    """Where the tie points of the images lie, and by how much each misses its pixel: arrows, all of one scale.

    Args:
        views: of each image ``[N, 4]``: column, row, and the residual's two components [px].
    """
    columns = min(6 if len(views) > 3 else 3, len(views))
    rows = -(-len(views) // columns)
    figure = new_figure(2.4 * columns, 2.4 * rows)
    every = figure.subplots(rows, columns, squeeze=False).ravel()
    lengths = np.concatenate([np.hypot(own[:, 2], own[:, 3]) for own in views.values()])
    unit = max(float(np.quantile(lengths, 0.9)), 1e-3)
    for axes, (name, own) in zip(every, views.items(), strict=False):
        width, height = np.ptp(own[:, 0]) or 1.0, np.ptp(own[:, 1]) or 1.0
        scale = 0.12 * max(width, height) / unit  # pixels of the image by which a residual of one pixel is drawn
        axes.quiver(*own.T, angles="xy", scale_units="xy", scale=1 / scale, width=0.006, color="tab:red")
        axes.set_title(_in_lines(name), fontsize=7)
        axes.set_aspect("equal")
        axes.invert_yaxis()
        axes.tick_params(labelsize=6)
    for axes in every[len(views) :]:
        axes.set_axis_off()
    figure.supxlabel(f"column [px]; the longest tenth of the arrows: more than {unit:.2g} px", fontsize=8)
    figure.supylabel("row [px]", fontsize=8)
    return figure


def errors_by(groups: Mapping[str, Sequence[tuple[str, float, float, int]]]) -> Any:
    """Bars of the mean absolute error and its median, one panel per kind of group.

    Args:
        groups: title -> (name, mean [m], median [m], cells) of each bar.
    """
    figure = new_figure(3.2 * len(groups) + 0.8, 3.6)
    every = figure.subplots(1, len(groups), squeeze=False, sharey=True)[0]
    for axes, (title, bars) in zip(every, groups.items(), strict=True):
        places = np.arange(len(bars))
        axes.bar(places - 0.2, [bar[1] for bar in bars], 0.4, label="mean")
        axes.bar(places + 0.2, [bar[2] for bar in bars], 0.4, label="median")
        axes.set_xticks(places, [f"{bar[0]}\n{_count(bar[3])}" for bar in bars], fontsize=7)
        axes.set_xlabel(title)
        axes.grid(axis="y", alpha=0.3)
    every[0].set_ylabel("absolute error [m]")
    every[0].legend(fontsize=8)
    return figure


def _count(cells: int) -> str:
    return f"{cells / 1e6:.1f} M" if cells >= 1e6 else f"{cells / 1e3:.0f} k" if cells >= 1e4 else str(cells)


def validity_figure(codes: np.ndarray, grid: Grid) -> Any:
    """Map of what was measured, filled, laid level, not seen or not wanted; the legend says how much each is.

    Args:
        codes: ``[H, W]`` of product `validity`.
        grid: ground grid.
    """
    from matplotlib.colors import ListedColormap
    from matplotlib.patches import Patch

    figure = new_figure(5.6, 5.6 * grid.height / grid.width if grid.width else 5.6)
    axes = figure.subplots()
    colours = [colour for colour, _ in VALIDITY.values()]
    extent = (0.0, grid.width * grid.cell_size, 0.0, grid.height * grid.cell_size)
    axes.imshow(
        codes, cmap=ListedColormap(colours), vmin=0, vmax=len(colours) - 1, extent=extent, interpolation="nearest"
    )
    shares = [100 * float((codes == code).mean()) for code in VALIDITY]
    patches = [
        Patch(facecolor=colour, edgecolor="0.5", label=f"{name}, {share:.1f} %")
        for (colour, name), share in zip(VALIDITY.values(), shares, strict=True)
        if share
    ]
    axes.legend(handles=patches, fontsize=8, loc="upper right", framealpha=0.9)
    axes.set(xlabel=f"east of {grid.left:.1f} [m]", ylabel=f"north of {grid.bounds[1]:.1f} [m]")
    return figure


def error_over_time(points: Sequence[tuple[str, float, float]]) -> Any:
    """Error over seconds of one scene, and the front that nothing else is both faster and better than.

    Args:
        points: (name, seconds since the images, mean absolute error [m]); equal names are joined by a line.
    """
    from sattools.batch.figure import draw_front

    figure = new_figure()
    axes = figure.subplots()
    for name in dict.fromkeys(point[0] for point in points):
        own = [point for point in points if point[0] == name]
        axes.plot([p[1] for p in own], [p[2] for p in own], ".-" if len(own) > 1 else "o", label=name)
    draw_front(axes, points)
    axes.set(xlabel="seconds since the images", ylabel="mean absolute error [m]", ylim=(0, None), xlim=(0, None))
    axes.grid(alpha=0.3)
    axes.legend(fontsize=8)
    return figure


def histograms(values: Mapping[str, np.ndarray], label: str) -> Any:
    """One line per image of its pixels' values `[N]`; `label` names them with their unit."""
    figure = new_figure()
    axes = figure.subplots()
    pooled = np.concatenate(list(values.values()))
    low, high = np.quantile(pooled, [0.001, 0.995])
    edges = np.linspace(low, max(high, low + 1e-6), 100)
    for style, (name, own) in zip(line_styles(len(values)), values.items(), strict=True):
        share = np.histogram(own, edges)[0] / max(1, own.size)
        axes.stairs(100 * share, edges, label=_in_lines(name), **style)
    axes.set(xlabel=label, ylabel="share of the pixels [%]", ylim=(0, None))
    if len(values) <= 20:
        axes.legend(fontsize=7)
    return figure


def map_figure(array: np.ndarray, grid: Grid, label: str) -> Any:
    """A map `[B, H, W]`: three bands as colours, one with a ramp; `label` says what it is, with its unit.

    Args:
        array: ``[H, W]`` or ``[B, H, W]``.
        grid: ground grid.
        label: what it is, with its unit.
    """
    from matplotlib import colormaps

    figure = new_figure(5.6, 5.6 * grid.height / grid.width if grid.width else 5.6)
    axes = figure.subplots()
    extent = (0.0, grid.width * grid.cell_size, 0.0, grid.height * grid.cell_size)
    known = array[np.isfinite(array)]
    low, high = np.quantile(known, [0.01, 0.99]) if known.size else (0.0, 1.0)
    if array.shape[0] == 3:
        shown = np.clip((array - low) / max(high - low, 1e-6), 0, 1)
        shown[:, ~np.isfinite(array).all(axis=0)] = float(UNKNOWN)
        axes.imshow(np.moveaxis(shown, 0, -1), extent=extent, interpolation="nearest")
        axes.set_title(f"{label}: black {low:.3g}, white {high:.3g}", fontsize=10)
    else:
        colours = colormaps["viridis"].with_extremes(bad=UNKNOWN)
        image = axes.imshow(
            np.ma.masked_invalid(array[0]),
            cmap=colours,
            vmin=low,
            vmax=max(high, low + 1e-6),
            extent=extent,
            interpolation="nearest",
        )
        figure.colorbar(image, ax=axes, label=label, shrink=0.8, extend="both")
    axes.set(xlabel=f"east of {grid.left:.1f} [m]", ylabel=f"north of {grid.bounds[1]:.1f} [m]")
    return figure


def training(rows: Sequence[Mapping[str, float]]) -> Any:
    """Loss, and error where it was watched, over the seconds of the fit."""
    figure = new_figure()
    axes = figure.subplots()
    seconds = [row["seconds"] for row in rows]
    axes.plot(seconds, [row["loss"] for row in rows], ".-", color="tab:blue")
    axes.set_yscale("log")
    axes.set(xlabel="time of the fit [s]", ylabel="loss [1]")
    axes.grid(alpha=0.3)
    if all("mae_m" in row for row in rows):
        other = axes.twinx()
        other.plot(seconds, [row["mae_m"] for row in rows], ".-", color="tab:red")
        other.set_ylabel("mean absolute error [m]", color="tab:red")
        other.set_ylim(0, None)
    return figure


__all__ = [
    "directions",
    "error_over_time",
    "errors_by",
    "footprints",
    "histograms",
    "map_figure",
    "new_figure",
    "residual_vectors",
    "residuals",
    "training",
    "validity_figure",
]
