"""A process knows what its container allows it."""

import os
from pathlib import Path
from typing import Any

import pytest

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
