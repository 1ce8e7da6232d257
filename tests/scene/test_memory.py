"""Memory that is freed is kept for what is asked for next."""

from __future__ import annotations

import subprocess
import sys

FAULTS = """
import resource
import numpy as np
from sattools.scene.memory import keep_freed

if {keep}:
    keep_freed()
before = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
for _ in range(20):
    [np.ones(3_000_000, np.uint8) for _ in range(4)]
print(resource.getrusage(resource.RUSAGE_SELF).ru_minflt - before)
"""


def page_faults(keep: bool) -> int:
    """Pages that the system gives for four arrays of 3 MB, made and dropped 20 times, in a process of its own."""
    text = subprocess.run([sys.executable, "-c", FAULTS.format(keep=keep)], check=True, capture_output=True, text=True)
    return int(text.stdout)


def test_arrays_that_come_and_go_are_given_their_memory_once() -> None:
    once = 4 * 3_000_000 / 4096
    assert page_faults(keep=True) < 2 * once
    assert page_faults(keep=False) > 10 * once  # or there is nothing to be gained here
