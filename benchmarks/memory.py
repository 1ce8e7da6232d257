"""Does the memory of a command grow with the area? Exported scenes of different size through what reads maps.

    python benchmarks/memory.py SCENE/scene.json LARGER/scene.json ... [--skip prior ...] [--out FOLDER]

The scenes are copied (files are linked) and left alone; the first is looked at twice, as the first commands may
compile kernels. The reference is each scene's own DSM, 1.3 m further east,
0.7 m further south and 2.5 m higher, so that `align` is known to be right too. Printed per command: peak memory [GiB]
and CPU seconds for every scene, and the exponent of memory against area (least squares of the logarithms).
Numbers are of one run each: peaks vary by a hundredth, seconds with whatever else the machine does.
"""

from __future__ import annotations

import argparse
import json
import shutil
import sys
import tempfile
from pathlib import Path

import numpy as np
from launched import command

from sattools.scene import Scene
from sattools.scene.cog import CogWriter
from sattools.scene.raster import raster_grid, read_raster
from sattools.scene.stored import cut

MOVED_M = (1.3, -0.7, 2.5)


def linked(scene: Path, folder: Path) -> Path:
    """A copy of a scene whose files are links; its document is its own."""
    shutil.copytree(scene.parent, folder, copy_function=lambda a, b: Path(b).hardlink_to(a), dirs_exist_ok=True)
    document = folder / scene.name
    text = Scene.from_file(scene).to_json(root=".")
    document.unlink()
    document.write_text(text + "\n")
    return document


def moved(dsm: Path, target: Path) -> Path:
    """The DSM elsewhere."""
    grid = raster_grid(dsm)
    with CogWriter(target, grid.moved(*MOVED_M[:2]), units="m") as out:
        for rows, cols in cut(grid.shape):
            out.write(read_raster(dsm, grid.part(rows, cols))[0][0] + MOVED_M[2], rows, cols)
    return target


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("scenes", nargs="+", type=Path)
    parser.add_argument("--skip", nargs="*", default=[])
    parser.add_argument("--out", type=Path, help="folder for the copies, on the scenes' disk")
    arguments = parser.parse_args()
    table: dict[str, list[tuple[float, float]]] = {}
    areas = []
    for path in [arguments.scenes[0], *arguments.scenes]:
        scene = Scene.from_file(path)
        grid = scene.require_grid()
        areas.append(grid.width * grid.height * grid.cell_size**2 / 1e6)
        with tempfile.TemporaryDirectory(dir=arguments.out) as place:
            reference = moved(scene.path(scene.products["dsm"]), Path(place) / "reference.tif")
            view, sun = scene.train_items()[0].id, ["--sun", "120", "40"]
            commands = {
                "prior": ["prior", "--overwrite"],
                "export": ["export", "--overwrite"],
                "export --view --sun": ["export", "--overwrite", "--view", view, *sun],
                "compare": ["compare", "--dsm", str(reference), "--overwrite"],
                "change": ["change", "--out", str(Path(place) / "change"), str(reference)],
                "align": ["align", "--to", str(reference)],
                "normalise": ["normalise", "--overwrite"],
                "report": ["report", "--out", str(Path(place) / "report.html")],
            }
            for name, (stage, *options) in commands.items():
                if name in arguments.skip:
                    continue
                own = linked(path, Path(place) / "scene")
                done = command(stage, *options, str(own))
                if done.status:
                    sys.exit(f"{name}: exit status {done.status}")
                if name == "align":
                    shift = json.loads(done.output)["sattools"]["history"][-1]["shift"]
                    off = np.array([shift[key] for key in ("east", "north", "up")]) - MOVED_M
                    print(f"align: off by {np.abs(off).max():.3f} m at most")
                table.setdefault(name, []).append((done.peak_gb, done.cpu_s))
                shutil.rmtree(own.parent)
    areas, table = areas[1:], {name: found[1:] for name, found in table.items()}
    print("| | " + " | ".join(f"{area:.3g} km2" for area in areas) + " | exponent |")
    print("|---" * (len(areas) + 2) + "|")
    for name, found in table.items():
        row = [f"{peak:.2f} GiB, {cpu:.0f} CPU s" for peak, cpu in found]
        slope = np.polyfit(np.log(areas), np.log([peak for peak, _ in found]), 1)[0] if len(areas) > 1 else np.nan
        print(f"| `{name}` | " + " | ".join(row) + f" | {slope:.2f} |")


if __name__ == "__main__":
    main()
