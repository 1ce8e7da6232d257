"""Error against seconds, and which configurations nothing else beats in both."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from sattools.compare.picture import line_styles
from sattools.scene.files import write_figure
from sattools.scene.jsonio import JsonObject

Point = tuple[str, float, float]


def means(rows: Sequence[JsonObject]) -> list[Point]:
    """(configuration, seconds, MAE [m]), means over the scenes that all configurations have scored."""
    scored = [row for row in rows if row.get("mae_m") is not None]
    names = list(dict.fromkeys(row["configuration"] for row in scored))
    scenes = [{row["scene"] for row in scored if row["configuration"] == name} for name in names]
    common = set.intersection(*scenes) if scenes else set()
    points = []
    for name in names:
        own = [row for row in scored if row["configuration"] == name and row["scene"] in common]
        if own:
            points.append(
                (name, sum(row["seconds"] for row in own) / len(own), sum(row["mae_m"] for row in own) / len(own))
            )
    return points


def pareto_front(points: Sequence[Point]) -> list[Point]:
    """The points that no other one beats in seconds without losing in error, by seconds."""
    front: list[Point] = []
    for point in sorted(points, key=lambda p: (p[1], p[2])):
        if not front or point[2] < front[-1][2]:
            front.append(point)
    return front


def speed_error_figure(rows: Sequence[JsonObject]) -> Any | None:
    """Matplotlib figure: small dots are scenes, large ones means, ringed where on the front; None without any error."""
    points = means(rows)
    if not points:
        return None
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(7, 4.4), dpi=110, layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.subplots()
    styles = line_styles(len(points))
    for style, (name, seconds, error) in zip(styles, points, strict=True):
        own = [row for row in rows if row["configuration"] == name and row.get("mae_m") is not None]
        colour = style["color"]
        axes.plot([r["seconds"] for r in own], [r["mae_m"] for r in own], ".", color=colour, alpha=0.5)
        axes.plot(seconds, error, "o", color=colour, label=name, markersize=8)
    draw_front(axes, points, "Pareto front of the means")
    axes.set(xlabel="seconds from images to surface model", ylabel="mean absolute error [m]")
    scored = [row for row in rows if row.get("mae_m") is not None]
    scenes, all_scenes = ({row["scene"] for row in some} for some in (scored, rows))
    limits = (1.15 * max(float(row[name]) for row in scored) for name in ("seconds", "mae_m"))
    title = f"{len(scenes)} of {len(all_scenes)} scenes scored"
    axes.set(**{name: (0, limit) for name, limit in zip(("xlim", "ylim"), limits, strict=True)}, title=title)
    axes.grid(alpha=0.3)
    # errors of a batch lie within a factor of two or so, and so above it
    axes.legend(loc="lower right")
    return figure


def draw_front(axes: Any, points: Sequence[Point], label: str = "Pareto front") -> None:
    """Ring the points that nothing else is both faster and better than, and join them.

    Args:
        axes: of matplotlib.
        points: (name, seconds, error).
        label: in the legend.
    """
    front = pareto_front(points)
    seconds, errors = [p[1] for p in front], [p[2] for p in front]
    axes.plot(seconds, errors, "o--", color="black", markerfacecolor="none", markersize=14, linewidth=1, label=label)


def draw(rows: Sequence[JsonObject], path: Path) -> bool:
    """Write `speed_error_figure` as PNG; False where there is nothing to show."""
    figure = speed_error_figure(rows)
    if figure is None:
        return False
    write_figure(path, figure)
    return True


__all__ = ["draw", "draw_front", "means", "pareto_front", "speed_error_figure"]
