"""Figure of an input's histogram beside its output's."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from textwrap import fill

import numpy as np

from sattools.scene.files import write_figure

COLOURS = ("tab:red", "tab:green", "tab:blue", "tab:purple", "tab:brown", "tab:pink", "tab:olive", "tab:cyan")
_LETTERS = 48  # of an axis' label in a line: a longer one would be cut off at the picture's edge


def histogram_figure(
    numbers: Sequence[np.ndarray], radiance: Sequence[np.ndarray], labels: tuple[str, str], title: str, path: Path
) -> None:
    """PNG with one line per band: left the digital numbers ``[N]`` per band, right the radiance ``[N]`` per band.

    Args:
        numbers: digital numbers of each band.
        radiance: of each band.
        labels: of the two axes.
        title: of the picture.
        path: file to write.
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(9, 3.6), dpi=110, layout="constrained")
    FigureCanvasAgg(figure)
    for axes, bands, label in zip(figure.subplots(1, 2), (numbers, radiance), labels, strict=True):
        known = [band[np.isfinite(band)] for band in bands]
        pooled = np.concatenate(known) if known else np.zeros(0)
        if not pooled.size:
            continue
        # the brightest thousandth would squeeze all the rest into one bar
        low, high = float(pooled.min()), float(np.quantile(pooled, 0.999))
        edges = np.linspace(low, max(high, low + 1e-6), 128)
        for k, band in enumerate(known):
            share = np.histogram(band, edges)[0] / max(1, band.size)
            axes.stairs(share, edges, color=COLOURS[k % len(COLOURS)], label=f"band {k + 1}")
        axes.set(xlabel=fill(label, _LETTERS), ylabel="share of the pixels", ylim=(0, None))
        axes.legend()
    figure.suptitle(title)
    write_figure(path, figure)


__all__ = ["histogram_figure"]
