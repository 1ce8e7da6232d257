"""The suite in larger programs: from other folders, in pools of processes, with arguments of other kinds."""

import copy
import multiprocessing
import pickle
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import sattools
from sattools.errors import InputError, OutputExistsError, SceneError
from sattools.scene.called import for_python

STAGES = ("prepare", "normalise", "match", "fit", "export", "align", "compare", "change", "simulate")


def test_a_program_may_go_to_another_folder(make_town: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A scene that was read by a relative path was not found any more."""
    make_town()
    monkeypatch.chdir(tmp_path)
    scene = sattools.Scene.from_file("TOWN/scene.json")
    monkeypatch.chdir("/")
    assert sattools.normalise(scene).history[-1]["command"] == "normalise"


@pytest.mark.parametrize("name", STAGES)
def test_functions_can_be_handed_to_other_processes(name: str) -> None:
    function = getattr(sattools, name)
    assert pickle.dumps(function)
    assert copy.deepcopy(function) is function


def test_a_pool_of_processes_takes_the_functions_themselves(tmp_path: Path) -> None:
    """`pool.map(sattools.fit, paths)` could not hand the function on."""
    with multiprocessing.get_context("spawn").Pool(1) as pool, pytest.raises(SceneError, match=r"none\.json: found No"):
        pool.map(sattools.fit, [str(tmp_path / "none.json")])


@pytest.mark.parametrize("preset", [None, "nerf", 3])
def test_a_preset_that_there_is_not_is_told(make_town: Any, preset: Any) -> None:
    with pytest.raises(InputError, match="option 'preset': found"):
        sattools.fit(make_town(), {"preset": preset})


@pytest.mark.parametrize("progress", ["bar", 1])
def test_progress_of_another_kind_is_told_before_the_work(make_town: Any, progress: Any) -> None:
    with pytest.raises(InputError, match="expected True, or a function"):
        sattools.normalise(make_town(), progress=progress)


def test_names_of_options_of_other_kinds_are_told(make_town: Any) -> None:
    with pytest.raises(InputError, match="found option 3, expected some of"):
        sattools.normalise(make_town(), {3: 1, "none": 2})


@pytest.mark.parametrize("surface", [np.zeros((4, 4), np.float32), None, b"dsm.tif"])
def test_change_of_arrays_says_what_it_takes(surface: Any) -> None:
    with pytest.raises(InputError, match=r"change: found .*, expected a Scene, the path of"):
        sattools.change(surface, surface)


@pytest.mark.parametrize(("name", "value"), [("predicted", "other.tif"), ("fit", "A=a.json"), ("out", "folder")])
def test_compare_takes_no_option_that_it_would_not_heed(make_town: Any, name: str, value: str) -> None:
    """The figures were those of the scene's own surface, whatever surface was asked about."""
    with pytest.raises(InputError, match=f"found option '{name}' beside a scene"):
        sattools.compare(make_town(), {name: value})


def test_errors_name_flags_as_python_gives_them(make_town: Any) -> None:
    scene = sattools.normalise(make_town())
    with pytest.raises(OutputExistsError, match=r": exists already; give overwrite=True to replace it$"):
        sattools.normalise(scene)
    assert sattools.normalise(scene, overwrite=True) is scene


@pytest.mark.parametrize(
    ("shell", "python"),
    [
        ("a.st: give --overwrite in place of --resume", "a.st: give overwrite=True in place of resume=True"),
        ("run it again (--overwrite), with --prior", "run it again (overwrite=True), with --prior"),
        ("`sattools prior --overwrite` after it", "`sattools prior --overwrite` after it"),
        ("/data/a--overwrite.tif and --overwrite-all", "/data/a--overwrite.tif and --overwrite-all"),
    ],
)
def test_only_flags_that_are_advised_are_named_otherwise(shell: str, python: str) -> None:
    assert for_python(shell) == python
