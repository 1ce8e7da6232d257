"""Error of a fit at each second, as CSV and picture.

    python benchmarks/speed_error.py SCENE.json DSM [--out FOLDER] [--threads N] [-- OPTIONS OF FIT]
    python benchmarks/speed_error.py --simulate

The error is the mean absolute one after registration, as `sattools compare` would print it at this moment; seconds are
those of the fit, without the time for scoring. With --simulate the scene is a simulated city, the reference its truth.
"""

from __future__ import annotations

import argparse
import csv
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

from sattools.scene.copies import in_another_root


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("scene", nargs="?", type=Path, help="scene.json")
    parser.add_argument("dsm", nargs="?", type=Path, help="reference DSM")
    parser.add_argument("--simulate", action="store_true", help="a simulated city instead")
    parser.add_argument("--out", type=Path, default=Path("speed_error"), help="folder of the results")
    parser.add_argument("--threads", type=int)
    own = sys.argv[1 : sys.argv.index("--")] if "--" in sys.argv else sys.argv[1:]
    options = parser.parse_args(own)
    if not options.simulate and (options.scene is None or options.dsm is None):
        parser.error("expected SCENE.json and DSM, or --simulate")
    options.out.mkdir(parents=True, exist_ok=True)
    extra = sys.argv[len(own) + 2 :]

    with tempfile.TemporaryDirectory() as folder:
        path, dsm = options.scene, options.dsm
        if options.simulate:
            run(options.threads, "simulate", "--out", folder)
            path = Path(folder) / "SIM_001/scene.json"
            dsm = Path(folder) / "SIM_001/truth/SIM_001_DSM.tif"
        scene = in_another_root(path, Path(folder) / "fit")
        line = run(options.threads, "fit", "--reference", str(dsm.resolve()), *extra, str(scene))
        rows = read_trace(line)
    name = path.parent.name
    write_csv(options.out / f"{name}.csv", rows)
    draw(options.out / f"{name}.png", rows, name)
    last = rows[-1]
    print(f"{name}: MAE {last['mae_m']:.3f} m after {last['seconds']:.1f} s; {options.out}/{name}.csv, .png")


def run(threads: int | None, *arguments: str) -> str:
    """Run a command of the suite; its stdout."""
    command = [sys.executable, "-m", "sattools", *(["--threads", str(threads)] if threads else []), *arguments]
    return subprocess.run(command, stdout=subprocess.PIPE, text=True, check=True).stdout


def read_trace(line: str) -> list[dict[str, float]]:
    """Rows of the trace of the scene in `line`."""
    from sattools.scene import Scene

    scene = Scene.from_json(line)
    with open(scene.path(scene.products["trace"]), newline="", encoding="utf-8") as file:
        return [{k: float(v) for k, v in row.items()} for row in csv.DictReader(file)]


def write_csv(path: Path, rows: list[dict[str, float]]) -> None:
    """seconds, mae_m, cell_m, loss: one row per epoch."""
    with open(path, "w", newline="", encoding="utf-8") as file:
        names = ["seconds", "mae_m", "cell_m", "loss"]
        writer = csv.DictWriter(file, names, extrasaction="ignore", lineterminator="\n")
        writer.writeheader()
        writer.writerows(rows)


def draw(path: Path, rows: list[dict[str, Any]], title: str) -> None:
    """Error over seconds; one colour per stage."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(7, 4.2), layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.subplots()
    cells = list(dict.fromkeys(row["cell_m"] for row in rows))
    before: list[dict[str, Any]] = []
    for cell in cells:
        own = [row for row in rows if row["cell_m"] == cell]
        joined = before[-1:] + own
        axes.plot([r["seconds"] for r in joined], [r["mae_m"] for r in joined], ".-", label=f"cells of {cell:g} m")
        before = own
    last = rows[-1]
    axes.annotate(
        f"{last['mae_m']:.2f} m after {last['seconds']:.0f} s",
        (last["seconds"], last["mae_m"]),
        xytext=(-6, 10),
        textcoords="offset points",
        ha="right",
    )
    axes.set(title=title, xlabel="seconds of fit", ylabel="mean absolute error [m]", xlim=(0, None))
    axes.set_ylim(0, 1.15 * max(row["mae_m"] for row in rows))
    axes.grid(alpha=0.3)
    axes.legend()
    figure.savefig(path, dpi=110)


if __name__ == "__main__":
    main()
