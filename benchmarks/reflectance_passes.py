"""What suns of several dates buy: b and c of one pass against those of several passes with as many images.

    python benchmarks/reflectance_passes.py [--seeds 40 41] [--passes 1 5] [--slopes 15 30] [--train 15]

For every seed and slope a scene of 256 m is simulated with 21 views up to 45 degrees off nadir, the views dealt out to
the passes, and the most nadir ones train Hapke's model. Prints, per scene, the span of the phase angles, and of every
parameter NRMSE, that over the constant map at the truth's mean, correlation, the share of the cells whose truth lies
within two standard deviations, the share of cells that count as determined, and NRMSE over the constant map there.
"""

from __future__ import annotations

import argparse
import shutil
import tempfile
from pathlib import Path

import numpy as np

from sattools.cli import set_threads

MAPS = ("w", "b", "c", "theta")


def figures(scene, name: str) -> list[float]:
    """NRMSE, that over the constant map, correlation, coverage; of shapes the share determined, and the ratio there."""
    from sattools.compare.metrics import map_errors
    from sattools.fit.illumination import LEAST_KNOWN
    from sattools.scene.raster import read_raster

    found, std, truth = (read_raster(scene.path(scene.products[n]))[0] for n in (name, f"{name}_std", f"truth_{name}"))
    errors = map_errors(found, truth)
    row = [errors["nrmse"], errors["nrmse"] / errors["nrmse_constant"], errors["correlation"]]
    row.append(float((np.abs(found - truth) <= 2 * std).mean()))
    if name == "w":
        return [float(x) for x in row]
    share = read_raster(scene.path(scene.products["identifiable"]))[0][MAPS.index(name) - 1] >= LEAST_KNOWN
    error = np.square(found - truth)[0][share].mean() if share.any() else np.nan
    return [float(x) for x in (*row, share.mean(), np.sqrt(error) / truth.std())]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seeds", type=int, nargs="+", default=[40, 41])
    parser.add_argument("--passes", type=int, nargs="+", default=[1, 5])
    parser.add_argument("--slopes", type=float, nargs="+", default=[15.0, 30.0])
    parser.add_argument("--train", type=int, default=15)
    parser.add_argument("--size", type=float, default=256.0)
    parser.add_argument("--threads", type=int, default=1)
    arguments = parser.parse_args()
    set_threads(arguments.threads)

    from sattools.export.options import ExportOptions
    from sattools.export.stage import export
    from sattools.fit.illumination import phase_angles
    from sattools.fit.options import FitOptions
    from sattools.fit.stage import fit
    from sattools.prior import PriorOptions
    from sattools.prior.stage import prior
    from sattools.simulate import SimulateOptions, simulate

    rows: dict[tuple[float, int], list[list[float]]] = {}
    for slope in arguments.slopes:
        for seed in arguments.seeds:
            for passes in arguments.passes:
                folder = Path(tempfile.mkdtemp(prefix="passes_"))
                options = SimulateOptions(
                    terrain="natural", id="PASS", seed=seed, size=arguments.size, slope=slope, passes=passes,
                    train=arguments.train,
                )  # fmt: skip
                scene = simulate(options, folder / "PASS")
                prior(scene, PriorOptions())
                fit(scene, FitOptions(brdf="hapke", resolution=2.0))
                export(scene, ExportOptions(undetermined="prior"))
                found = [figures(scene, name) for name in MAPS]
                span = float(np.ptp(phase_angles(scene.train_items())))
                rows.setdefault((slope, passes), []).append([x for row in found for x in row])
                print(f"slope {slope:g} seed {seed} passes {passes}: phase angles span {span:.0f} degrees", flush=True)
                print(text(rows[slope, passes][-1]), flush=True)
                shutil.rmtree(folder)
    print("\nmeans")
    for (slope, passes), lines in rows.items():
        print(f"slope {slope:g} passes {passes}\n" + text(np.nanmean(lines, axis=0)))


def text(row) -> str:
    lines, rest = [], list(row)
    for name in MAPS:
        nrmse, ratio, correlation, covered = rest[:4]
        line = f"    {name:6s} {nrmse:.3f} ({ratio:.2f} x) r {correlation:+.2f} within 2 std {100 * covered:.0f} %"
        rest = rest[4:]
        if name != "w":
            line += f"  determined {100 * rest[0]:.0f} %, there {rest[1]:.2f} x"
            rest = rest[2:]
        lines.append(line)
    return "\n".join(lines)


if __name__ == "__main__":
    main()
