"""What a row of a batch's table says of a scene."""

from pathlib import Path
from typing import Any

from sattools.batch.table import make_row
from sattools.scene import Scene


def test_a_row_adds_up_what_the_steps_of_this_run_took(tmp_path: Path) -> None:
    scene = Scene("A", tmp_path)

    def done(command: str, seconds: float, memory_mb: float, **more: Any) -> None:
        about = {"seconds": seconds, "peak_memory_mb": memory_mb, "versions": {"sattools": "1", "torch": command}}
        scene.history.append({"command": command} | about | more)

    done("export", 500.0, 9000.0)  # of a fit that came before
    done("prep", 1.5, 100.0)
    done("fit", 10.0, 300.0, parts={"seconds": 30.25, "peak_memory_mb": 450.0})
    done("export", 2.0, 200.0)
    figures = {"mae": 1.25, "completeness": 0.5, "cells": 40, "classes": {"trees": {"mae": 2.5}}, "protocol": "p"}
    done("compare", 70.0, 8000.0, errors=figures)  # is not part of the work
    scene.write()
    row = make_row("A", "fast", tmp_path / "scene.json")
    took = {name: row.get(name) for name in ("prep_s", "normalise_s", "fit_s", "export_s", "seconds", "peak_memory_mb")}
    assert took == {
        "prep_s": 1.5, "normalise_s": None, "fit_s": 40.25, "export_s": 2.0, "seconds": 43.75, "peak_memory_mb": 450.0,
    }  # fmt: skip
    assert (row["status"], row["mae_m"], row["completeness"], row["cells"]) == ("done", 1.25, 0.5, 40)
    assert (row["trees_mae_m"], row["buildings_mae_m"], row["protocol"]) == (2.5, None, "p")
    assert (row["sattools"], row["torch"]) == ("1", "export")
    # a fit that has come after them is all that counts of the surface, and there is no score of it
    done("fit", 4.0, 50.0)
    scene.write()
    again = make_row("A", "fast", tmp_path / "scene.json")
    assert (again["seconds"], again["peak_memory_mb"], again["mae_m"]) == (5.5, 100.0, None)
