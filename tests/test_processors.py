"""A process knows what its container allows it."""

import contextvars
import importlib
import os
import sys
import threading
from pathlib import Path
from typing import Any

import pytest
from patience import HANGING_S

from sattools import processors
from sattools.scene import memory


@pytest.fixture
def groups(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Any:
    """Makes control groups: what /proc says, and files below /sys/fs/cgroup; 64 processors, and no other limit."""
    monkeypatch.setattr(os, "sched_getaffinity", lambda process: set(range(64)))
    monkeypatch.setattr(processors, "_OWN_GROUPS", tmp_path / "own")
    monkeypatch.setattr(processors, "_GROUPS", tmp_path / "groups")

    def make(own: str, **files: str) -> None:
        (tmp_path / "own").write_text(own)
        for name, text in files.items():
            path = tmp_path / "groups" / name.replace("__", "/").replace("_dot_", ".")
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_text(text)

    return make


V1 = "4:memory:/pod/a\n2:cpu,cpuacct:/pod/a\n0::/\n"


@pytest.mark.parametrize(
    ("own", "files", "expected"),
    [
        ("0::/\n", {}, 64),
        ("0::/\n", {"cpu_dot_max": "max 100000\n"}, 64),
        ("0::/\n", {"cpu_dot_max": "200000 100000\n"}, 2),
        ("0::/\n", {"cpu_dot_max": "150000 100000\n"}, 2),  # one and a half: a second thread has half a processor
        ("0::/\n", {"cpu_dot_max": "20000 100000\n"}, 1),
        ("0::/a/b\n", {"a__cpu_dot_max": "300000 100000\n", "a__b__cpu_dot_max": "max 100000\n"}, 3),  # of the parent
        (V1, {"cpu__pod__a__cpu_dot_cfs_quota_us": "400000", "cpu__pod__a__cpu_dot_cfs_period_us": "100000"}, 4),
        (
            V1,
            {"cpu__cpu_dot_cfs_quota_us": "400000", "cpu__cpu_dot_cfs_period_us": "100000"},
            4,
        ),  # as containers see it
        (V1, {"cpu__cpu_dot_cfs_quota_us": "-1", "cpu__cpu_dot_cfs_period_us": "100000"}, 64),
        ("nonsense\n", {"cpu_dot_max": "200000 100000\n"}, 64),
        ("0::/\n", {"cpu_dot_max": "what"}, 64),
        ("0::/\n", {"cpu_dot_max": "100000 0"}, 64),
    ],
)
def test_the_quota_of_a_container_counts_as_its_processors(groups: Any, own: str, files: Any, expected: int) -> None:
    groups(own, **files)
    assert processors.cores() == expected


def test_without_control_groups_it_is_the_machine(groups: Any) -> None:
    assert processors.cores() == 64  # not even /proc


@pytest.mark.parametrize(
    ("own", "name"),
    [
        ("0::/a\n", "a__memory_dot_max"),
        ("0::/a\n", "memory_dot_max"),
        (V1, "memory__pod__a__memory_dot_limit_in_bytes"),
    ],
)
def test_memory_of_a_container_is_what_is_free(groups: Any, own: str, name: str) -> None:
    groups(own, **{name: "123456789\n"})
    assert memory.available() == 123456789
    groups(own, **{name: "max\n"})
    assert memory.available() != 123456789


def test_a_variable_of_the_environment_is_as_before_afterwards() -> None:
    for before in (None, "old"):
        os.environ.pop("SATTOOLS_X", None)
        if before:
            os.environ["SATTOOLS_X"] = before
        with processors.in_environment("SATTOOLS_X", "new"):
            assert os.environ["SATTOOLS_X"] == "new"
        assert os.environ.pop("SATTOOLS_X", None) == before


@pytest.fixture
def four_threads(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("NUMBA_NUM_THREADS", "4")


def test_side_by_side_sees_what_its_caller_sees(four_threads: None) -> None:
    seen: contextvars.ContextVar[str] = contextvars.ContextVar("seen", default="nothing")
    seen.set("files are held back")
    assert set(processors.side_by_side(lambda _: seen.get(), range(5))) == {"files are held back"}


def test_side_by_side_leaves_opencv_the_threads_that_are_over(four_threads: None) -> None:
    """Or four images at a time would have sixteen threads on four processors; it counts for the whole process."""
    cv2 = pytest.importorskip("cv2")
    before = cv2.getNumThreads()
    cv2.setNumThreads(4)
    try:
        assert set(processors.side_by_side(lambda _: cv2.getNumThreads(), range(4))) == {1}
        assert set(processors.side_by_side(lambda _: cv2.getNumThreads(), range(4), 2)) == {2}
        assert cv2.getNumThreads() == 4
        with pytest.raises(ZeroDivisionError):
            list(processors.side_by_side(lambda k: 1 // k, range(4)))
        assert cv2.getNumThreads() == 4
    finally:
        cv2.setNumThreads(before)


def test_side_by_side_keeps_the_order_of_the_items(four_threads: None) -> None:
    third_is_done = threading.Event()

    def first_waits_for_third(k: int) -> int:
        assert k != 0 or third_is_done.wait(60)  # would never end with one after the other
        if k == 2:
            third_is_done.set()
        return 10 * k

    assert list(processors.side_by_side(first_waits_for_third, range(5))) == [0, 10, 20, 30, 40]


@pytest.mark.parametrize(("threads", "most"), [("1", None), ("4", 1)])
def test_with_one_thread_or_memory_for_one_nothing_is_begun_before_it_is_asked_for(
    monkeypatch: pytest.MonkeyPatch, threads: str, most: int | None
) -> None:
    monkeypatch.setenv("NUMBA_NUM_THREADS", threads)
    begun: list[int] = []
    results = processors.side_by_side(begun.append, range(3), most)
    next(results)
    assert begun == [0]


def test_no_more_than_most_are_made_at_a_time(four_threads: None) -> None:
    lock, now, most = threading.Lock(), [0], [0]

    def count(item: int) -> None:
        with lock:
            now[0] += 1
            most[0] = max(most[0], now[0])
        threading.Event().wait(0.01)
        with lock:
            now[0] -= 1

    list(processors.side_by_side(count, range(12), 2))
    assert most[0] <= 2


def test_the_first_error_by_order_is_raised_and_the_rest_is_left_alone(four_threads: None) -> None:
    begun = []

    def fail(k: int) -> int:
        begun.append(k)
        if k == 0:
            raise ValueError("of the first")
        threading.Event().wait(0.05)
        if k == 1:
            raise ValueError("of the second")
        return k

    with pytest.raises(ValueError, match="of the first"):
        list(processors.side_by_side(fail, range(1000)))
    assert len(begun) < 1000


def test_a_module_that_another_thread_is_importing_is_waited_for(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """`prepare` beside the first `fit` of a program ended with an AttributeError about PyTorch."""
    (tmp_path / "late_module.py").write_text("import late_event\nlate_event.wait()\nVALUE = 1\n")
    begun, goes_on = threading.Event(), threading.Event()

    class _Event:
        def wait(self) -> None:
            begun.set()
            goes_on.wait(HANGING_S)

    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setitem(sys.modules, "late_event", _Event())
    assert processors.imported("late_module") is None
    importing = threading.Thread(target=importlib.import_module, args=("late_module",))
    importing.start()
    assert begun.wait(HANGING_S)
    threading.Timer(0.2, goes_on.set).start()
    assert processors.imported("late_module").VALUE == 1
    importing.join(HANGING_S)
    monkeypatch.delitem(sys.modules, "late_module")
