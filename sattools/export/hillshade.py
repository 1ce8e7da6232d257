"""Pictures of a height map."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from sattools.scene.files import write_figure
from sattools.scene.grid import Grid

_STRIP_ROWS = 64  # that are coloured at a time: colours of a whole picture are some hundred megabytes


def hillshade(
    height: np.ndarray, cell_size: float, azimuth_deg: float = 315.0, elevation_deg: float = 40.0
) -> np.ndarray:
    """Lambertian shading ``[H, W]`` in [0, 1] of a height map lit from an azimuth (from north) and elevation.

    Args:
        height: ``[H, W]`` [m].
        cell_size: edge of a cell [m].
        azimuth_deg: from north, clockwise [degrees].
        elevation_deg: above the horizon [degrees].
    """
    south, east = np.gradient(height, cell_size)
    normal = np.stack([-east, south, np.ones_like(height)])
    normal /= np.linalg.norm(normal, axis=0)
    azimuth, elevation = np.radians(azimuth_deg), np.radians(elevation_deg)
    light = (np.sin(azimuth) * np.cos(elevation), np.cos(azimuth) * np.cos(elevation), np.sin(elevation))
    return np.clip(np.tensordot(light, normal, axes=1), 0.0, 1.0)


def write_picture(height: np.ndarray, grid: Grid, title: str, path: Path, above: str = "WGS84 ellipsoid") -> None:
    """PNG of `picture`.

    Args:
        height: ``[H, W]`` [m].
        grid: ground grid.
        title: of the picture.
        path: file to write.
        above: what the heights are above.
    """
    figure = picture(height, grid, title, above)
    write_figure(path, figure, dpi=110, bbox_inches="tight")


def picture(height: np.ndarray, grid: Grid, title: str, above: str = "WGS84 ellipsoid") -> Any:
    """Matplotlib figure of a DSM [H, W] in metres: colour ramp over hillshade, with axes in metres and a colour bar.

    Args:
        height: ``[H, W]`` [m].
        grid: ground grid.
        title: of the picture.
        above: what the heights are above.
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.cm import ScalarMappable
    from matplotlib.colors import Normalize
    from matplotlib.figure import Figure

    known = height[np.isfinite(height)]
    low, high = np.percentile(known, [0.5, 99.5]) if known.size else (0.0, 1.0)
    mappable = ScalarMappable(Normalize(low, max(high, low + 1e-3)), "viridis")
    image = np.empty((*height.shape, 3), np.uint8)
    for first in range(0, len(height), _STRIP_ROWS):
        inner = slice(first, min(first + _STRIP_ROWS, len(height)))
        outer = slice(max(0, first - 1), inner.stop + 1)  # slopes of its border rows
        shade = hillshade(np.nan_to_num(height[outer], nan=low), grid.cell_size)[first - outer.start :][
            : inner.stop - first
        ]
        colours = mappable.to_rgba(height[inner])[..., :3] * (0.45 + 0.75 * shade[..., None])
        colours[~np.isfinite(height[inner])] = 1.0
        image[inner] = np.round(255 * np.clip(colours, 0, 1))
    figure = Figure(figsize=(7, 7 * grid.height / grid.width + 0.6), layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.subplots()
    extent = (0.0, grid.width * grid.cell_size, 0.0, grid.height * grid.cell_size)
    axes.imshow(image, extent=extent)
    axes.set(title=title, xlabel=f"east of {grid.left:.1f} [m]", ylabel=f"north of {grid.bounds[1]:.1f} [m]")
    figure.colorbar(mappable, ax=axes, label=f"height above the {above} [m]", shrink=0.8)
    return figure


__all__ = ["hillshade", "picture", "write_picture"]
