"""Seconds until `sattools --help` and the QGIS provider's usage answer: `python benchmarks/start.py`."""

from __future__ import annotations

import subprocess
import sys
import time

TARGET_S = 0.3


def seconds(*arguments: str, tries: int = 5) -> float:
    """The best of several runs, as other programs may hold the machine."""
    found = []
    for _ in range(tries):
        start = time.perf_counter()
        subprocess.run([sys.executable, "-m", "sattools", *arguments], check=True, stdout=subprocess.DEVNULL)
        found.append(time.perf_counter() - start)
    return min(found)


if __name__ == "__main__":
    for call in (("--help",), ("fit", "--help"), ("--json-usage",)):
        print(f"sattools {' '.join(call):12s} {seconds(*call):.2f} s (target for --help: {TARGET_S} s)")
