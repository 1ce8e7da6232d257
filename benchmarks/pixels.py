"""Which cells suit which pixels? Towns and hills simulated with pixels of several sizes, fitted on cells of several.

    python benchmarks/pixels.py [--out FOLDER] [--terrain city] [--seed N] [--gsd METRES ...] [--cells METRES ...]

Every scene goes through `prep --bounds` of its truth, `prior --resolution` and `fit` on such cells, `export` and
`compare --protocol dfc2019`, by cells of the truth, which are as wide as the pixels. Columns: pixel and cell; mean
absolute error; each error at most 5 m; CPU seconds of `prior` and `fit` (the first row's include compiling). `*` marks
the default.
"""

from __future__ import annotations

import argparse
import resource
from pathlib import Path

from clouds import errors, prepared, sattools

from sattools.scene.grid import default_cell_size


def spent() -> float:
    """CPU seconds of all commands so far."""
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime


def row(town: Path, gsd: float, cell: float, out: Path) -> None:
    """Print a row of the table."""
    out /= f"cells_{cell:g}"
    text, _ = prepared(town, out, "--cell-size", str(cell))
    before = spent()
    text, _ = sattools("prior", "--resolution", str(cell), "--overwrite", text=text)
    text, _ = sattools("fit", "--overwrite", text=text)
    seconds = spent() - before
    figures = errors(text, town, out)
    mark = "*" if cell == default_cell_size(gsd) else " "
    print(
        f"{gsd:5.2f} {cell:5.2f}{mark} {figures['mae']:7.3f} {figures['mae_capped_5m']:7.3f} {seconds:6.1f} s",
        flush=True,
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--out", type=Path, default=Path("pixels"))
    parser.add_argument("--terrain", choices=["city", "downtown", "natural"], default="city")
    parser.add_argument("--seed", type=int, default=2030)
    parser.add_argument("--size", type=float, default=128.0, help="edge of a scene [m]")
    parser.add_argument("--gsd", type=float, nargs="+", default=[0.6, 0.75], help="edges of pixels [m]")
    parser.add_argument("--cells", type=float, nargs="+", default=[1.0, 0.5], help="edges of cells [m]")
    options = parser.parse_args()
    print("pixel  cell    MAE  at 5 m  prior and fit")
    for gsd in options.gsd:
        name = f"{options.terrain}_{options.seed}_{100 * gsd:.0f}"
        about = [
            "--terrain",
            options.terrain,
            "--seed",
            str(options.seed),
            "--gsd",
            str(gsd),
            "--size",
            str(options.size),
        ]
        sattools("simulate", "--id", name, "--out", str(options.out), *about, "--overwrite")
        for cell in options.cells:
            row(options.out / name, gsd, cell, options.out)


if __name__ == "__main__":
    main()
