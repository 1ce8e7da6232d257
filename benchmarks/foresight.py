"""What `fit --dry-run` foresees beside what `fit` takes: CPU seconds and memory, on one thread.

    python benchmarks/foresight.py [SCENE.json ...] [--sizes 64 128 256] [--views 6]

Simulated cities of these edges [m], and scenes of `sattools prep` (which stay as they are). A first run on the smallest
city compiles and does not count. The exit status is 1 where memory is foreseen too small by a third, or CPU seconds
are off by more than a factor of 2.5.
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
import tempfile
from pathlib import Path

from sattools.fit.foresight import foresee
from sattools.fit.options import FitOptions
from sattools.scene import Scene
from sattools.scene.copies import in_another_root
from sattools.simulate import SimulateOptions, simulate


def measured(document: Path) -> tuple[float, float]:
    """CPU seconds and peak memory [bytes] of a fit at the defaults."""
    command = [sys.executable, "-m", "sattools", "--threads", "1", "-q", "fit", "--overwrite", str(document)]
    process = subprocess.Popen(command, stdout=subprocess.DEVNULL)
    _, status, usage = os.wait4(process.pid, 0)
    if os.waitstatus_to_exitcode(status):
        raise SystemExit(f"{document}: fit failed")
    return usage.ru_utime + usage.ru_stime, usage.ru_maxrss * 1024.0


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("scenes", nargs="*", type=Path)
    parser.add_argument("--sizes", nargs="*", type=float, default=[64.0, 128.0, 256.0])
    parser.add_argument("--views", type=int, default=6)
    options = parser.parse_args()

    worst = 0
    print(f"{'scene':12s} {'km2':>7s} {'images':>6s} {'CPU s':>7s} {'foreseen':>8s} {'GiB':>6s} {'foreseen':>8s}")
    with tempfile.TemporaryDirectory() as folder:
        documents = []
        for size in options.sizes:
            root = Path(folder) / f"city_{size:g}"
            documents.append(simulate(SimulateOptions(id=root.name, size=size, views=options.views), root).write())
        documents += [in_another_root(path, Path(folder) / path.parent.name) for path in options.scenes]
        measured(documents[0])
        for document in documents:
            scene = Scene.from_file(document)
            told = foresee(scene, FitOptions())
            cpu, memory = measured(document)
            print(
                f"{scene.id:12s} {told.area_km2:7.4f} {told.images:6d} {cpu:7.1f} {told.cpu_s:8.1f} "
                f"{memory / 2**30:6.2f} {told.memory / 2**30:8.2f}",
                flush=True,
            )
            ratio = cpu / told.cpu_s
            worst |= memory > 1.33 * told.memory or not 1 / 2.5 < ratio < 2.5
    return int(worst)


if __name__ == "__main__":
    sys.exit(main())
