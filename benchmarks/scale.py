"""Seconds, memory and cost of large areas in tiles, from measured rates; and what breaks first.

    python benchmarks/scale.py [--measured tiles/memory.csv] [--tile 512] [--price 0.05] [--out FOLDER]

Measurements are those of `benchmarks/tiles.py --memory` (given, or made here at 384 and 640 m): the same tile in two
areas. What grows with the area (joining, disk) is a line through the two. A tile's own CPU seconds and memory are those
of a fit of its size, measured here at three sizes up to the default tile with its overlap, the exponent only serving
for another --tile. The coarse pass and the pilots have at most a tile's cells each.
"""

from __future__ import annotations

import argparse
import csv
import math
import sys
import tempfile
from dataclasses import dataclass
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent))
import growth
import tiles

AREAS_KM2 = (1.0, 100.0, 10_000.0)
DASK_TASK_S = 0.001  # of the scheduler, per task: what Dask's documentation speaks of
DASK_TASKS = 1_000_000  # of one batch, from which a single scheduler is taken to be too slow


@dataclass
class Rates:
    """What was measured, on one thread.

    Attributes:
        edge: of the largest piece fitted alone [m]; overlap: by which a tile reaches into its neighbours [m].
        tile_s, tile_mb: CPU seconds and memory of that piece; their exponents over its area.
        join_s, join_mb, disk_mb: intercept and slope per km2.
        tile_mb_growth: exponent of a tile's memory over the area that it is a part of.
    """

    edge: float
    overlap: float
    tile_s: float
    tile_s_exponent: float
    tile_mb: float
    tile_mb_exponent: float
    join_s: tuple[float, float]
    join_mb: tuple[float, float]
    disk_mb: tuple[float, float]
    tile_mb_growth: float


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--measured", type=Path, help="memory.csv of benchmarks/tiles.py")
    parser.add_argument("--sizes", nargs=3, type=int, default=[192, 384, 576], help="edges of the tile alone [m]")
    parser.add_argument("--tile", type=float, default=512.0, help="of the table [m]")
    parser.add_argument("--cores", type=int, default=64, help="of the cluster, for the hours that pass")
    parser.add_argument("--memory", type=float, default=64.0, help="of one machine [GB]")
    parser.add_argument("--price", type=float, default=0.05, help="of a core-hour, in any currency")
    parser.add_argument("--out", type=Path, default=Path("scale"))
    options = parser.parse_args()
    options.out.mkdir(parents=True, exist_ok=True)
    if options.measured:
        with open(options.measured, newline="", encoding="utf-8") as file:
            areas = [{name: float(value) for name, value in row.items()} for row in csv.DictReader(file)]
    else:
        areas = [tiles.memory(size, 6, ["--tile", "128", "--overlap", "32"]) for size in (384, 640)]
        tiles.write(options.out / "memory.csv", areas)
    alone = [single(size, round(areas[0]["views"])) for size in options.sizes]
    rates = rates_of(areas, alone)
    print(rates)
    text = table(rates, options.tile, options.cores, options.memory, options.price)
    (options.out / "scale.md").write_text(text, encoding="utf-8")
    print(text)


def single(size: int, views: int) -> dict[str, float]:
    """Seconds and peak memory of one fit, prior included, of a city of that edge: what a tile of that size takes."""
    with tempfile.TemporaryDirectory() as folder:
        scene = tiles.simulate(folder, size, views, 1)
        _, seconds, peak = tiles.run("fit", scene.root / "scene.json")
    print({"size_m": size, "fit_s": round(seconds, 1), "fit_mb": round(peak)}, flush=True)
    return {"size_m": float(size), "fit_s": seconds, "fit_mb": peak}


def rates_of(areas: list[dict[str, float]], alone: list[dict[str, float]]) -> Rates:
    """Rates from the same tile in areas of two sizes, and from tiles of several sizes."""
    first, last = areas[0], areas[-1]
    km2 = [(row["size_m"] / 1000) ** 2 for row in (first, last)]

    def line(name: str) -> tuple[float, float]:
        slope = (last[name] - first[name]) / (km2[1] - km2[0])
        return first[name] - slope * km2[0], slope

    cells = [row["size_m"] ** 2 for row in alone]
    return Rates(
        edge=alone[-1]["size_m"],
        overlap=first["overlap_m"],
        tile_s=alone[-1]["fit_s"],
        tile_s_exponent=growth.exponent(cells, [row["fit_s"] for row in alone]),
        tile_mb=alone[-1]["fit_mb"],
        tile_mb_exponent=growth.exponent(cells, [row["fit_mb"] for row in alone]),
        join_s=line("join_s"),
        join_mb=line("join_mb"),
        disk_mb=line("tiles_disk_mb"),
        tile_mb_growth=growth.exponent(km2, [first["tile_mb"], last["tile_mb"]]),
    )


def table(rates: Rates, tile: float, cores: int, memory_gb: float, price: float) -> str:
    """The table as Markdown."""
    larger = ((tile + 2 * rates.overlap) / rates.edge) ** 2
    tile_s, tile_mb = rates.tile_s * larger**rates.tile_s_exponent, rates.tile_mb * larger**rates.tile_mb_exponent
    lines = [
        "| area [km2] | tiles | core-hours | price | hours on "
        f"{cores} cores | memory of a task [GB] | memory of the joining [GB] | disk [GB] | what breaks first |",
        "|" + "---|" * 9,
    ]
    for area in AREAS_KM2:
        count = math.ceil(math.sqrt(area) * 1000 / tile) ** 2
        pilots = 4 if math.sqrt(area) * 1000 > 4 * (tile + 2 * rates.overlap) else 0
        coarse_s = (1 + pilots) * tile_s
        join_s, join_mb, disk_mb = (
            max(0.0, start + slope * area) for start, slope in (rates.join_s, rates.join_mb, rates.disk_mb)
        )
        join_gb, disk_gb = join_mb / 1024, disk_mb / 1024
        core_s = count * tile_s + coarse_s + join_s
        wall = coarse_s + math.ceil(count / cores) * tile_s + join_s + count * DASK_TASK_S
        breaks = []
        if join_gb > memory_gb:
            breaks.append((join_gb / memory_gb, f"memory of the joining: {memory_gb:g} GB end at "
                           f"{(memory_gb * 1024 - rates.join_mb[0]) / rates.join_mb[1]:.0f} km2"))  # fmt: skip
        if count > DASK_TASKS:
            breaks.append((count / DASK_TASKS, f"number of tasks: one scheduler is taken to manage {DASK_TASKS}"))
        if (join_s + coarse_s) > wall / 2:
            breaks.append((1.0, "what is not spread: coarse pass and joining take half of the time"))
        first = max(breaks)[1] if breaks else "nothing"
        lines.append(
            f"| {area:g} | {count} | {core_s / 3600:.2f} | {core_s / 3600 * price:.2f} | {wall / 3600:.2f} | "
            f"{tile_mb / 1024:.1f} | {join_gb:.1f} | {disk_gb:.1f} | {first} |"
        )
    return "\n".join(lines) + "\n"


if __name__ == "__main__":
    main()
