"""Commands of a batch begin without importing, and are processes of their own nevertheless."""

import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from patience import HANGING_S

from sattools.batch import cluster
from sattools.batch.cluster import Shares
from sattools.batch.launch import Launcher, end
from sattools.batch.options import BatchOptions
from sattools.batch.plan import Task
from sattools.batch.task import _watch, perform

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="on Linux only; elsewhere Python starts every time")
HANGS = ["info", "-"]  # waits for a document, were its input not empty


@pytest.fixture(scope="module")
def launcher() -> Iterator[Launcher]:
    made = Launcher()
    yield made
    made.close()


def run(launcher: Launcher, *arguments: str) -> tuple[int, list[str], int]:
    """Number of the process, lines, and exit status."""
    began: list[int] = []
    *lines, status = launcher.run(list(arguments), 1, None, began.append)
    assert isinstance(status, int)
    return began[0], [str(line) for line in lines], status


def test_each_command_is_a_process_with_its_own_lines_and_exit_status(launcher: Launcher) -> None:
    first, lines, status = run(launcher, "info", "/nowhere.json")
    assert (len(lines), status) == (1, 1)
    assert lines[0].startswith("sattools info: error: /nowhere.json: found")
    second, lines, status = run(launcher, "--version")
    assert (lines, status) == ([], 0)  # stdout goes nowhere
    third, lines, status = run(launcher, "fit", "--no-such-option")
    assert status == 2
    assert "No such option" in "".join(lines)
    assert len({first, second, third}) == 3


def test_nothing_of_a_command_is_left_for_the_next(launcher: Launcher, make_town: Any) -> None:
    document = str(make_town().root / "scene.json")
    _, lines, _ = run(launcher, "--max-memory", "1000", "-vv", "fit", "--dry-run", document)
    before = "".join(lines)
    assert "would fit" in before
    _, lines, _ = run(launcher, "--quiet", "fit", "--dry-run", document)
    assert [line for line in lines if "would fit" not in line] == []  # neither -vv nor the log of the one before


def test_a_command_reads_nothing_of_what_is_meant_for_the_next(launcher: Launcher) -> None:
    _, lines, status = run(launcher, *HANGS)
    assert status == 1
    assert "stdin: found nothing" in "".join(lines)
    assert run(launcher, "--version")[2] == 0


def test_a_killed_command_is_told_and_the_next_one_starts(launcher: Launcher, make_town: Any) -> None:
    document = str(make_town().root / "scene.json")
    began: list[int] = []
    lines = launcher.run(["--progress", "json", "fit", document], 1, None, began.append)
    assert str(next(lines)).startswith('{"progress"')
    end(began[0])
    assert list(lines)[-1] == -9
    assert run(launcher, "--version")[2] == 0


def test_a_command_that_is_not_heard_to_its_end_is_ended(launcher: Launcher, make_town: Any) -> None:
    psutil = pytest.importorskip("psutil", reason="needs the extra `batch`")
    document = str(make_town().root / "scene.json")
    began: list[int] = []
    lines = launcher.run(["--progress", "json", "fit", document], 1, None, began.append)
    next(lines)
    process = psutil.Process(began[0])
    assert process.name() == "sattools fit"
    lines.close()
    assert psutil.wait_procs([process], timeout=HANGING_S)[1] == []
    assert run(launcher, "--version")[2] == 0


def test_a_command_that_needs_too_much_memory_is_stopped_and_named(
    launcher: Launcher, make_town: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    pytest.importorskip("psutil", reason="needs the extra `batch`")
    source, folder = str(make_town().root / "scene.json"), str(tmp_path / "big")
    task = Task("TOWN/big", folder, "key", "TOWN", "big", str(tmp_path), [["fit", "{scene}"]], "", source)
    # Python with numpy and torch takes more than 100 MB before it does anything; looked at 200 times a second, as a
    # fast machine has the command itself say that its images need more, before it is looked at for the first time
    monkeypatch.setattr("sattools.batch.task._WATCH_S", 0.005)
    result = perform(task, 1, 100.0, lambda *_: None, launcher=launcher)
    assert result["status"] == "failed"
    assert result["error"] == "sattools fit: needed more than 100 MB of memory and was stopped"
    assert not (tmp_path / "big/task.json").exists()


def test_memory_of_a_task_is_that_of_its_processes_together() -> None:
    pytest.importorskip("psutil", reason="needs the extra `batch`")
    # two processes, each with 60 MB of its own
    code = "import subprocess, sys; a = b'x' * 60_000_000\nsubprocess.run([sys.executable, '-c', {!r}])"
    inner = "import sys; a = b'x' * 60_000_000; print('there', flush=True); sys.stdin.read()"
    for limit, stopped in ((1000.0, False), (100.0, True)):
        command = [sys.executable, "-c", code.format(inner)]
        process = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
        assert process.stdout is not None
        process.stdout.readline()
        too_much, over = threading.Event(), threading.Event()
        watching = threading.Thread(target=_watch, args=(process.pid, limit, too_much, over))
        watching.start()
        if stopped:
            watching.join(HANGING_S)
        else:
            time.sleep(0.5)  # it looks several times
        assert too_much.is_set() == stopped
        over.set()
        watching.join(HANGING_S)
        process.kill()
        process.communicate(timeout=HANGING_S)


def test_another_gpu_is_that_of_another_process(monkeypatch: pytest.MonkeyPatch) -> None:
    seen: list[str] = []

    def popen(module: list[str], environment: dict[str, str], stdin: int) -> subprocess.Popen[str]:
        """One that has nothing to import, and answers all that it is asked."""
        seen.append(environment["CUDA_VISIBLE_DEVICES"])
        answers = "import sys\nfor line in sys.stdin: print('{\"ended\": 0}', file=sys.stderr, flush=True)"
        return subprocess.Popen([sys.executable, "-c", answers], stdin=stdin, stderr=subprocess.PIPE, text=True)

    monkeypatch.setattr("sattools.batch.launch._popen", popen)
    launcher = Launcher()
    try:
        for gpu, processes in (("0", ["0"]), ("0", ["0"]), ("1", ["0", "1"])):
            assert list(launcher.run(["--version"], 1, gpu, lambda process: None)) == [0]
            assert seen == processes
    finally:
        launcher.close()


def test_a_python_that_cannot_start_is_a_failed_command(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "executable", "/bin/false")
    launcher = Launcher()
    assert list(launcher.run(["--version"], 1, None, lambda process: None)) == [1]


def test_elsewhere_python_starts_every_time(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("sattools.batch.launch.LINUX", False)
    began: list[int] = []
    lines = list(Launcher().run(["info", "/nowhere.json"], 1, None, began.append))
    assert lines[-1] == 1
    assert "sattools info: error" in str(lines[0])
    assert len(began) == 1


def test_tasks_of_one_worker_at_the_same_time_do_not_hear_each_other(monkeypatch: pytest.MonkeyPatch) -> None:
    """`dask worker` does as many as there are cores unless it is told otherwise."""
    distributed = pytest.importorskip("distributed", reason="needs the extra `batch`")
    worker = SimpleNamespace(name="0", state=SimpleNamespace(nthreads=2))
    monkeypatch.setattr(distributed, "get_worker", lambda: worker)
    both, used = threading.Barrier(2, timeout=HANGING_S), []

    def perform(*given: Any) -> dict[str, Any]:
        both.wait()  # none has ended yet
        used.append((threading.get_ident(), given[-1]))
        return {}

    monkeypatch.setattr(cluster, "perform", perform)
    task = Task("A/c", "/nowhere", "key", "A", "c", "/nowhere", [], "")
    tasks = [
        threading.Thread(target=lambda: [cluster.work(task, [], Shares(0, 1, 1, None)) for _ in "12"]) for _ in "12"
    ]
    for one in tasks:
        one.start()
    for one in tasks:
        one.join(HANGING_S)
    assert len(used) == 4
    of_thread = dict(used)
    assert len(set(map(id, of_thread.values()))) == 2  # each goes on with its own
    assert all(of_thread[thread] is launcher for thread, launcher in used)


@pytest.mark.parametrize(
    ("gpu", "workers", "told"),
    [
        (False, [], ["--scheduler tcp://h:1: found no worker yet, waiting for one"]),
        (False, [{}], []),
        (True, [{}], ["--scheduler tcp://h:1: found no worker with the resource GPU=1 yet, waiting for one"]),
        (True, [{}, {"GPU": 1}], []),
    ],
)
def test_a_cluster_on_which_nothing_can_begin_is_told(
    gpu: bool, workers: list[dict[str, int]], told: list[str], caplog: pytest.LogCaptureFixture
) -> None:
    """Its workers may wait in a queue; or nobody has started any."""
    there = SimpleNamespace(workers={k: SimpleNamespace(resources=one) for k, one in enumerate(workers)})
    client = SimpleNamespace(run_on_scheduler=lambda function: function(dask_scheduler=there))
    cluster._tell_of_workers(client, BatchOptions(scheduler="tcp://h:1", gpu=gpu))
    assert caplog.messages == told
