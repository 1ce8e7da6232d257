"""A small, seeded slice of the campaigns in `benchmarks/`: damaged inputs, kills at random moments, full disks."""

import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

pytestmark = pytest.mark.slow
BENCHMARKS = Path(__file__).parents[1] / "benchmarks"


def campaign(tmp_path: Path, name: Any, *options: Any) -> Any:
    command = [sys.executable, str(BENCHMARKS / f"{name}.py"), "--out", str(tmp_path / name), *options]
    done = subprocess.run(command, capture_output=True, text=True, check=False, cwd=tmp_path)
    record = tmp_path / name / f"{name}.json"
    assert record.exists(), done.stdout[-2000:] + done.stderr[-2000:]
    found = json.loads(record.read_text())
    assert found["found"] == []
    assert done.returncode == 0
    return found["table" if name == "fuzz" else "jobs"]


def test_damaged_inputs_break_nothing(tmp_path: Path) -> None:
    table = campaign(tmp_path, "fuzz", "--count", "24", "--seed", "1")
    assert sum(sum(results.values()) for results in table.values()) == 24


def test_killed_commands_and_full_disks_leave_nothing_damaged(tmp_path: Path) -> None:
    jobs = campaign(tmp_path, "faults", "--kills", "4", "--clusters", "0", "--jobs", "normalise", "export")
    assert sum(row["full_disks"] for row in jobs.values()) > 10


def test_a_batch_survives_a_cluster_that_dies(tmp_path: Path) -> None:
    campaign(tmp_path, "faults", "--kills", "0", "--clusters", "2", "--jobs", "batch")
