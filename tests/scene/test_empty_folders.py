"""Folders that were made for files go where no file comes: at the end of a call, and no earlier."""

import contextvars
import subprocess
import sys
import threading
from pathlib import Path
from typing import Any

import pytest

import sattools
from sattools.errors import InputError, SattoolsError
from sattools.scene import Scene
from sattools.scene.files import all_or_nothing, write_bytes
from sattools.scene.folders import make_folder


def folders(place: Path) -> list[str]:
    return sorted(str(path.relative_to(place)) for path in place.rglob("*") if path.is_dir())


def stopped(share: float, message: str) -> None:
    if share > 0.5:
        raise ZeroDivisionError


def test_a_call_that_fails_leaves_no_folder(make_town: Any, tmp_path: Path) -> None:
    """A notebook goes on after it, and had them until Python ended."""
    scene = make_town()
    before, heights = folders(scene.root), scene.root / "truth/TOWN_DSM.tif"
    with pytest.raises(SattoolsError, match="to hold out"):
        sattools.fit(scene, {"holdout": ["nobody"]})
    options = {"out": tmp_path / "new" / "place", "metadata": scene.root / "metadata", "bounds": [0, 0, 1, 1]}
    with pytest.raises(InputError, match="bounds"):
        sattools.prepare(scene.root / "images", options)
    with pytest.raises(ZeroDivisionError):
        sattools.change(heights, heights, {"out": tmp_path / "change"}, progress=stopped)
    assert folders(scene.root) == before
    assert not (tmp_path / "new").exists()
    assert not (tmp_path / "change").exists()


def test_what_has_files_and_what_a_program_makes_for_itself_stays(tmp_path: Path) -> None:
    scene = Scene("A", tmp_path)
    scene.output("mine/later.txt")
    with all_or_nothing():
        make_folder(tmp_path / "empty/within")
        write_bytes(scene.output("full/within/a"), b"a")
        assert (tmp_path / "empty/within").is_dir()
    assert folders(tmp_path) == ["full", "full/within", "mine"]


def test_a_folder_stays_while_another_thread_may_write_into_it(tmp_path: Path) -> None:
    begun, ended = threading.Event(), threading.Event()

    def other() -> None:
        with all_or_nothing():
            begun.set()
            ended.wait()
            (tmp_path / "shared" / "a").write_bytes(b"a")
            make_folder(tmp_path / "own")

    thread = threading.Thread(target=contextvars.Context().run, args=(other,))
    thread.start()
    begun.wait()
    try:
        with all_or_nothing():
            make_folder(tmp_path / "shared")
            make_folder(tmp_path / "unused")
        assert folders(tmp_path) == ["shared", "unused"]
    finally:
        ended.set()
        thread.join()
    assert folders(tmp_path) == ["shared"]


def test_outside_of_calls_they_go_when_the_program_ends(tmp_path: Path) -> None:
    program = (
        "from sattools.scene import Scene; import sys; s = Scene('A', sys.argv[1]); s.output('a/b'); print(s.root)"
    )
    subprocess.run([sys.executable, "-c", program, str(tmp_path)], check=True)
    assert folders(tmp_path) == []
