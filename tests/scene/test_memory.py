"""Memory that is freed is kept for what is asked for next."""

from __future__ import annotations

import subprocess
import sys

import pytest

from sattools.errors import SattoolsError
from sattools.scene import memory

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


def test_what_is_missing_is_told_in_numbers_that_say_something(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(memory, "available", lambda: 2**20)
    with memory.limited(200.0), pytest.raises(SattoolsError) as found:
        memory.check_memory(45e6, "a.tif", "crop it")
    expected = "expected at most the 1 MiB that --max-memory 200 MB leaves (crop it)"
    assert str(found.value) == f"a.tif: found a need of 43 MiB of memory, {expected}"
    monkeypatch.delenv(memory.LIMIT, raising=False)
    with pytest.raises(SattoolsError, match=r"need of 4291\.6 MiB of memory, expected at most the 1 MiB that are free"):
        memory.check_memory(4.5e9, "a.tif", "crop it")


@pytest.mark.parametrize(
    ("need", "there", "told"),
    [
        (1.1 * 2**20, 0, r"need of 1\.1 MiB of memory, expected at most the 0 MiB that --max-memory 100 MB leaves"),
        (3.2 * 2**30, 2 * 2**30, r"need of 3\.2 GiB of memory, expected at most the 2 GiB that --max-memory"),
        (2**31 + 1, 2**31, r"need of 2\.1 GiB of memory, expected at most the 2 GiB that"),  # never the same number
    ],
)
def test_a_need_and_what_there_is_have_one_unit(
    monkeypatch: pytest.MonkeyPatch, need: float, there: int, told: str
) -> None:
    monkeypatch.setattr(memory, "available", lambda: there)
    with memory.limited(100.0), pytest.raises(SattoolsError, match=told):
        memory.check_memory(need, "a.tif", "crop it")
