"""A batch on a real local cluster: lost workers, resuming, failures."""

import csv
import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import pytest
from done_here import batch_here
from patience import HANGING_S
from towns import copied, matched, northern_half

from sattools.scene import Scene

pytest.importorskip("distributed", reason="needs the extra `batch`")

MEASURED = {"scene", "seconds", "fit_s", "fit_prior_s", "export_s", "peak_memory_mb"}  # differ from run to run


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two scenes with the same images under two names, one of half the area, all matched; two epochs."""
    from sattools.simulate import SimulateOptions, simulate

    root = tmp_path_factory.mktemp("batch")
    made = simulate(SimulateOptions(id="A", size=32.0, views=4, dates=2), root / "made")
    copied(matched(made, root / "A"), root / "B")
    matched(northern_half(made), root / "HALF")
    (root / "quick.toml").write_text("[fit]\nepochs = [2]\n")
    return root


def start(folder: Path, *arguments: str) -> subprocess.Popen:
    command = [sys.executable, "-m", "sattools", "--threads", "1", "--progress", "json", "batch", *arguments]
    return subprocess.Popen(command, cwd=folder, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)


def name_of(process: Any) -> str:
    """What it is called; nothing once it has ended, which it may at any moment."""
    import psutil

    try:
        return process.name()
    except psutil.Error:
        return ""


def table(folder: Path) -> list[dict[str, str]]:
    with open(folder / "out/table.csv", newline="") as file:
        return list(csv.DictReader(file))


def attempts(folder: Path, scene: str) -> list[dict]:
    path = folder / f"out/runs/quick/{scene}/attempts.jsonl"
    return [json.loads(line) for line in path.read_text().splitlines()] if path.exists() else []


@pytest.mark.drawn
def test_a_lost_worker_costs_its_task_only_and_finished_work_is_not_done_again(folder: Any) -> None:
    call = ("A/scene.json", "B/scene.json", "--config", "quick.toml", "--out", "out", "--workers", "1")
    running = start(folder, *call)
    while not attempts(folder, "B"):
        assert running.poll() is None, running.communicate()
        time.sleep(0.05)
    time.sleep(0.3)  # in the middle of the fit
    os.kill(attempts(folder, "B")[0]["pid"], signal.SIGKILL)
    out, said = running.communicate(timeout=HANGING_S)
    assert running.returncode == 0, said
    assert [json.loads(line)["id"] for line in out.splitlines()] == ["A", "B"]
    assert [len(attempts(folder, name)) for name in "AB"] == [1, 2]
    # B shows what A shows: the interrupted task ends as the one that was left in peace
    one, two = ({k: v for k, v in row.items() if k not in MEASURED} for row in table(folder))
    assert one == two
    assert one["status"] == "done"
    assert 0 < float(one["mae_m"]) < 5
    assert (folder / "out/speed_error.png").stat().st_size > 1000
    assert '"message": "batch: 2 of 2 done' in said

    before = (folder / "out/table.csv").read_bytes()
    again = batch_here(folder, *call)
    assert again.exit_code == 0, again.stderr
    assert [json.loads(line)["id"] for line in again.stdout.splitlines()] == ["A", "B"]
    assert [len(attempts(folder, name)) for name in "AB"] == [1, 2]
    assert (folder / "out/table.csv").read_bytes() == before


def test_a_failed_scene_is_named_and_does_not_stop_the_others(folder: Any) -> None:
    broken = Scene.from_file(folder / "B/scene.json")
    broken.id, broken.items[0].assets["image"].href = "C", "images/nowhere.tif"
    (folder / "C.json").write_text(broken.to_json())
    names = [str(folder / name) for name in ("C.json", "A/scene.json")]
    done = batch_here(folder, *names, "--config", "quick.toml", "--out", "out")
    assert done.exit_code == 3, done.stderr
    assert [(row["scene"], row["status"]) for row in table(folder)[:2]] == [("C", "failed"), ("A", "done")]
    assert [row["scene"] for row in table(folder)[2:]] == ["B"]  # of a batch before
    assert "images/nowhere.tif: cannot be read" in table(folder)[0]["error"]


@pytest.mark.slow
def test_of_two_batches_in_a_folder_the_second_waits_and_finds_all_done(folder: Any) -> None:
    (folder / "cut.toml").write_text("[fit]\nepochs = [2]\ntile = 16\noverlap = 4\n")
    call = ("A/scene.json", "--config", "cut.toml", "--out", "twice", "--workers", "1")
    first = start(folder, *call)
    while not (folder / "twice/digests.json").exists():
        assert first.poll() is None
        time.sleep(0.05)
    second = start(folder, *call)
    said = [running.communicate(timeout=HANGING_S) for running in (first, second)]
    assert [running.returncode for running in (first, second)] == [0, 0]
    assert "another sattools process works here, waiting for it" in said[1][1]
    assert said[0][0] == said[1][0] != ""
    attempts = (folder / "twice/runs/cut/A/fit/tiles/r0c0/attempts.jsonl").read_text()
    assert len(attempts.splitlines()) == 1


@pytest.mark.slow
@pytest.mark.skipif(sys.platform != "linux", reason="the commands of a lost worker end by themselves on Linux only")
def test_an_interrupted_batch_leaves_no_process(folder: Any) -> None:
    import psutil

    (folder / "long.toml").write_text("[fit]\nepochs = [5000]\n")
    running = start(folder, "A/scene.json", "--config", "long.toml", "--out", "stopped", "--workers", "1")
    seen = psutil.Process(running.pid)
    while "sattools fit" not in [name_of(process) for process in seen.children(recursive=True)]:
        assert running.poll() is None
        time.sleep(0.05)
    family = seen.children(recursive=True)
    running.terminate()
    running.communicate(timeout=HANGING_S)
    assert running.returncode == 143
    _, left = psutil.wait_procs(family, timeout=HANGING_S)
    assert left == []
    assert not (folder / "stopped/runs/long/A/task.json").exists()


@pytest.mark.skipif(sys.platform != "linux", reason="the commands of a lost worker end by themselves on Linux only")
def test_ctrl_c_at_a_terminal_which_all_processes_hear_is_no_traceback(folder: Any) -> None:
    import psutil

    (folder / "long.toml").write_text("[fit]\nepochs = [5000]\n")
    command = [sys.executable, "-m", "sattools", "batch", "A/scene.json", "--config", "long.toml", "--out", "ctrl_c"]
    pipe = subprocess.PIPE
    running = subprocess.Popen(command, cwd=folder, stdout=pipe, stderr=pipe, text=True, start_new_session=True)
    seen = psutil.Process(running.pid)
    while "sattools fit" not in [name_of(process) for process in seen.children(recursive=True)]:
        assert running.poll() is None
        time.sleep(0.05)
    family = seen.children(recursive=True)
    os.killpg(running.pid, signal.SIGINT)
    assert running.communicate(timeout=HANGING_S) == ("", "")
    assert running.returncode == 130
    _, left = psutil.wait_procs(family, timeout=HANGING_S)
    assert left == []


def test_tiles_are_tasks_of_their_own_and_only_what_is_missing_is_done_again(folder: Any) -> None:
    """One of the two workers dies with its tile of two; the run equals `fit --tile` by hand."""
    from sattools import api

    (folder / "tiled.toml").write_text(
        "[fit]\nepochs = [2]\ntile = 16.0\noverlap = 4.0\n[export]\nvertical = 'ellipsoid'\n"
    )
    call = ("HALF/scene.json", "--config", "tiled.toml", "--out", "cut", "--workers", "2")
    running = start(folder, *call)
    run = folder / "cut/runs/tiled/HALF"

    def begun() -> list[dict]:
        found = [path.read_text().splitlines() for path in run.glob("fit/tiles/*/attempts.jsonl")]
        return [json.loads(lines[-1]) for lines in found if lines]  # none: about to be written

    while not begun():
        assert running.poll() is None, running.communicate()
        time.sleep(0.05)
    os.kill(begun()[0]["pid"], signal.SIGKILL)
    out, said = running.communicate(timeout=HANGING_S)
    assert running.returncode == 0, said
    assert [json.loads(line)["id"] for line in out.splitlines()] == ["HALF"]
    names = ("r0c0", "r0c1")
    assert sorted(path.name for path in (run / "fit/tiles").glob("r*")) == list(names)
    tries = {name: len((run / f"fit/tiles/{name}/attempts.jsonl").read_text().splitlines()) for name in names}
    # the tile of the lost worker, and no other, was begun twice
    assert sorted(tries.values()) == [1, 2]

    hand = copied(Scene.from_file(folder / "HALF/scene.json"), folder / "hand")
    api.fit(hand, {"tile": 16.0, "overlap": 4.0, "epochs": [2]})
    assert (run / "fit/model.safetensors").read_bytes() == (hand.root / "fit/model.safetensors").read_bytes()

    # another way of scoring needs the run, but neither the split nor a tile
    with open(folder / "tiled.toml", "a") as file:
        file.write("[compare]\nregister = 'z'\n")
    again = batch_here(folder, *call)
    assert again.exit_code == 0, again.stderr
    assert tries == {n: len((run / f"fit/tiles/{n}/attempts.jsonl").read_text().splitlines()) for n in names}
    assert len((run / "attempts.jsonl").read_text().splitlines()) == 4  # coarse, split, run, run
    with open(folder / "cut/table.csv", newline="") as file:
        [row] = csv.DictReader(file)
    assert row["status"] == "done", again.stderr
    # the seconds of the split and of the tiles count
    assert float(row["fit_s"]) > sum(
        json.loads((run / f"fit/tiles/{name}/scene.json").read_text())["sattools"]["history"][-1]["seconds"]
        for name in names
    )


def test_scenes_are_aligned_and_joined(folder: Any, caplog: pytest.LogCaptureFixture) -> None:
    """Both scenes show the same area; B is brought onto a reference that stands 3 m higher, and so is A."""
    from sattools.scene.raster import read_raster, write_cog

    scene = Scene.from_file(folder / "A/scene.json")
    heights, grid = read_raster(scene.path(scene.products["truth_dsm"]))
    write_cog(folder / "dem.tif", heights + 3, grid.moved(1.0, -2.0))
    (folder / "onto.toml").write_text('[fit]\nepochs = [2]\n[align]\nto = "dem.tif"\n')
    call = ("A/scene.json", "B/scene.json", "--config", "onto.toml", "--out", "joint", "--join")
    done = batch_here(folder, *call)
    assert done.exit_code == 0, done.stderr
    assert "2 scenes joined; largest step 0.00 m, between A and B" in done.stderr
    shifts = [json.loads(line)["sattools"]["history"] for line in done.stdout.splitlines()]
    for history in shifts:
        (entry,) = [entry for entry in history if entry["command"] == "align"]
        assert entry["shift"]["up"] == pytest.approx(3.0, abs=0.5)
        assert (entry["shift"]["east"], entry["shift"]["north"]) == pytest.approx((1.0, -2.0), abs=0.5)
    joined, there = read_raster(folder / "joint/joined/onto/dsm.tif")
    known = joined[0][abs(joined[0]) < 1000]
    assert known.size > 0.5 * there.width * there.height
    assert json.loads((folder / "joint/joined/onto/seams.json").read_text())["scenes"] == ["A", "B"]
    # joined anew from what is done
    again = batch_here(folder, *call)
    assert again.exit_code == 0, again.stderr
    assert len((folder / "joint/runs/onto/A/attempts.jsonl").read_text().splitlines()) == 1
    # of A by other options now, and not joined again: the row of B and the joined surface are of those of before
    (folder / "onto.toml").write_text('[fit]\nepochs = [1]\n[align]\nto = "dem.tif"\n')
    last = batch_here(folder, "A/scene.json", *call[2:-1])
    assert last.exit_code == 0, last.stderr
    assert "onto: has other options than in an earlier call" in caplog.text
    assert "left out of the table: give B again, too" in caplog.text
    assert "joint/joined/onto/dsm.tif: is still of what A had before this call; --join makes it anew" in caplog.text
    with open(folder / "joint/table.csv", newline="") as file:
        assert [row["scene"] for row in csv.DictReader(file)] == ["A"]
