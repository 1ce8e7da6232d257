"""What `sattools change` finds between simulated dates: one house less and one more, and where nothing has changed.

    python benchmarks/change.py --out change --pairs 10

A city is simulated, its DSM becomes the ground of two further scenes with other cameras, dates, colours and noise
(`simulate --dsm`), each goes through `prior | fit | export`, and `sattools change` compares them at its defaults. Pairs
differ by seed. In the last pair one building of the earlier date is levelled and one of its copies stands on open
ground in the later one. Prints a row a pair and writes change.json.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np

from sattools.scene import Scene
from sattools.scene.raster import read_raster, write_cog

BUILDING, GROUND = 6, 2
LEAST_M2 = 80.0


def sattools(*arguments: str, text: str = "") -> str:
    command = [sys.executable, "-m", "sattools", "-q", *arguments]
    done = subprocess.run(command, input=text, capture_output=True, text=True, check=False)
    if done.returncode:
        raise SystemExit(done.stderr)
    return done.stdout


def dated(folder: Path, name: str, dsm: Path, classes: Path, seed: int, size: float) -> Path:
    """The document of an exported scene over a DSM."""
    document = folder / name / "scene.json"
    if document.exists() and "dsm" in Scene.from_file(document).products:
        return document
    text = sattools(
        "simulate", "--id", name, "--out", str(folder), "--dsm", str(dsm), "--classes", str(classes),
        "--size", str(size), "--views", "8", "--dates", "4", "--seed", str(seed), "--overwrite",
    )  # fmt: skip
    for stage in ("prior", "fit", "export"):
        text = sattools(stage, "--overwrite", text=text)
    return document


def levelled_and_built(
    dsm: np.ndarray, classes: np.ndarray, cell: float
) -> tuple[np.ndarray, np.ndarray, dict[str, Any]]:
    """One building of middle size taken down, and a copy of it put where ground is open.

    Args:
        dsm: ``[H, W]`` [m].
        classes: ``[H, W]``.
        cell: edge of a cell [m].

    Returns:
        Both after the change, and what was changed.
    """
    from scipy.ndimage import find_objects, label

    numbered, _ = label(classes == BUILDING)
    rim = round(15 / cell)
    boxes = [
        (np.ptp(np.r_[b[0].start, b[0].stop]) * np.ptp(np.r_[b[1].start, b[1].stop]), k + 1, b)
        for k, b in enumerate(find_objects(numbered))
        if rim < b[0].start and b[0].stop < len(dsm) - rim and rim < b[1].start and b[1].stop < dsm.shape[1] - rim
    ]
    boxes = sorted((box for box in boxes if box[0] >= LEAST_M2 / cell**2), key=lambda box: box[0])
    ground = float(np.median(dsm[classes == GROUND]))
    for _, number, box in boxes[len(boxes) // 2 :: -1]:
        rows, columns = (part.stop - part.start for part in box)
        for row in range(rim, len(dsm) - rim - rows, 2):
            for column in range(rim, dsm.shape[1] - rim - columns, 2):
                if (classes[row - 2 : row + rows + 2, column - 2 : column + columns + 2] != GROUND).any():
                    continue
                here = numbered == number
                height = float(np.median(dsm[here])) - ground
                new_dsm, new_classes = dsm.copy(), classes.copy()
                new_dsm[here], new_classes[here] = ground, GROUND
                place = (slice(row, row + rows), slice(column, column + columns))
                new_dsm[place], new_classes[place] = ground + height, BUILDING
                about = {"height_m": round(height, 1), "levelled_m2": float(here.sum()) * cell**2}
                return new_dsm, new_classes, about | {"built_m2": rows * columns * cell**2}
    raise SystemExit("no open ground for any building: take another --seed")


def main() -> None:
    """See the module's docstring."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else "")
    parser.add_argument("--out", type=Path, default=Path("change"))
    parser.add_argument("--pairs", type=int, default=10, help="Unchanged pairs.")
    parser.add_argument("--size", type=float, default=128.0)
    parser.add_argument("--seed", type=int, default=500)
    options = parser.parse_args()
    out, rows = options.out, []
    for k in range(options.pairs + 1):
        seed = options.seed + 10 * k
        sattools("simulate", "--id", f"C{k}", "--out", str(out), "--size", str(options.size), "--views", "1",
                 "--dates", "1", "--seed", str(seed), "--overwrite")  # fmt: skip
        dsm, classes = (next((out / f"C{k}" / "truth").glob(f"*{end}.tif")) for end in ("DSM", "CLS"))
        old = dated(out, f"C{k}_old", dsm, classes, seed + 1, options.size)
        about: dict[str, Any] = {}
        if k == options.pairs:
            (heights, grid), (kinds, _) = read_raster(dsm), read_raster(classes)
            new_heights, new_kinds, about = levelled_and_built(heights[0], kinds[0], grid.cell_size)
            dsm, classes = out / "changed_dsm.tif", out / "changed_cls.tif"
            write_cog(dsm, new_heights.astype(np.float32), grid)
            write_cog(classes, new_kinds.astype(np.uint8), grid, nodata=None)
        new = dated(out, f"C{k}_new", dsm, classes, seed + 2, options.size)
        table = json.loads(sattools("change", str(old), str(new), "--out", str(out / f"change{k}"), "--overwrite"))
        rows.append({"pair": k, "changed": about, "nmad_m": table["nmad_m"], "regions": table["regions"]})
        found = ", ".join(f"{r['mean_m']:+.1f} m on {r['area_m2']:.0f} m2" for r in table["regions"])
        print(f"pair {k}: scatter {table['nmad_m']:.2f} m, regions: {found or 'none'} {about or ''}", flush=True)
        (out / "change.json").write_text(json.dumps(rows, indent=1))


if __name__ == "__main__":
    main()
