"""The suite in larger programs: from other folders, in pools of processes, with arguments of other kinds."""

import copy
import json
import multiprocessing
import pickle
import threading
import warnings
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import rasterio
import torch
from patience import HANGING_S
from rasterio.errors import NotGeoreferencedWarning

import sattools
from sattools.errors import InputError, OutputExistsError, SceneError
from sattools.scene.called import for_python
from sattools.scene.gdal import not_georeferenced

QUICK = {"resolution": 2.0, "coarsest": 2.0, "epochs": [1], "prior_weight": 0.0}
STAGES = ("prepare", "normalise", "match", "fit", "export", "align", "compare", "change", "simulate")


@contextmanager
def _of_doubles() -> Iterator[None]:
    torch.set_default_dtype(torch.float64)
    try:
        yield
    finally:
        torch.set_default_dtype(torch.float32)


def test_a_program_may_go_to_another_folder(make_town: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A scene that was read by a relative path was not found any more."""
    make_town()
    monkeypatch.chdir(tmp_path)
    scene = sattools.Scene.from_file("TOWN/scene.json")
    monkeypatch.chdir("/")
    assert sattools.normalise(scene).history[-1]["command"] == "normalise"


@pytest.mark.parametrize("call", [sattools.normalise, sattools.match, sattools.fit, sattools.export])
def test_a_document_that_was_copied_away_from_its_files_is_told(make_hamlet: Any, tmp_path: Path, call: Any) -> None:
    """A file was named that never was there, as if an earlier step had not been done."""
    (tmp_path / "kept.json").write_text(make_hamlet().to_json(root="."))
    found = rf"found none of its files in {tmp_path}, where {tmp_path}/kept\.json lies, expected the scene\.json in"
    with pytest.raises(SceneError, match=found):
        call(tmp_path / "kept.json")
    assert [path.name for path in tmp_path.iterdir() if path.is_file()] == ["kept.json"]


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


def test_bounds_are_numbers_of_any_make(make_hamlet: Any, tmp_path: Path) -> None:
    """The box of a geopandas table, an array, was told as what JSON cannot hold, once all work was done."""
    hamlet = make_hamlet()
    west, south, east, north = json.loads((hamlet.root / "scene.json").read_text())["bbox"]
    x, y = (west + east) / 2, (south + north) / 2
    box = np.array([x - 2e-4, y - 2e-4, x + 2e-4, y + 2e-4])  # degrees, some 40 m
    options = {"metadata": hamlet.root / "metadata", "out": tmp_path, "id": "PART", "bounds": box}
    scene = sattools.prepare(hamlet.root / "images", options)
    assert scene.history[0]["options"]["bounds"] == box.tolist()
    assert len(scene.history[0]["options"]["bounds"]) == 4


@pytest.mark.parametrize(
    ("options", "why"),
    [
        ({"bounds": [1.0, 2.0, 3.0]}, r"bounds: found \[1, 2, 3\], expected four numbers: west, south, east, north"),
        ({"bounds": "1 2 3 4"}, "PrepOptions: option 'bounds': found '1 2 3 4', expected a list"),
        ({"bounds": 5}, "PrepOptions: option 'bounds': found 5, expected a list"),
        ({"aoi": ["area.gpkg"]}, r"PrepOptions: option 'aoi': found \['area.gpkg'\], expected text"),
        ({"aoi": ""}, "PrepOptions: option 'aoi': found '', expected text that is not empty"),
    ],
    ids=str,
)
def test_an_area_that_is_none_is_told(make_hamlet: Any, tmp_path: Path, options: Any, why: str) -> None:
    hamlet = make_hamlet()
    given = {"metadata": hamlet.root / "metadata", "out": tmp_path, "id": "PART", **options}
    with pytest.raises(InputError, match=f"^{why}$"):
        sattools.prepare(hamlet.root / "images", given)
    assert not (tmp_path / "PART").exists()


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


def test_flags_of_numpy_are_pythons(make_town: Any, tmp_path: Path) -> None:
    scene = sattools.normalise(make_town(), overwrite=np.bool_(False), progress=np.bool_(False))
    with pytest.raises(OutputExistsError):
        sattools.normalise(scene, overwrite=np.False_)
    assert sattools.normalise(scene, overwrite=np.True_).history[-1]["command"] == "normalise"
    with pytest.raises(InputError, match=r"before\.tif: no such file"):
        sattools.change(tmp_path / "before.tif", tmp_path / "after.tif", overwrite=np.True_)
    with pytest.raises(InputError, match="overwrite: found 1, expected true or false"):
        sattools.normalise(scene, overwrite=np.int64(1))


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


@pytest.mark.parametrize(
    "mode",
    [torch.no_grad, torch.inference_mode, partial(torch.autocast, "cpu"), partial(torch.device, "meta"), _of_doubles],
    ids=["no_grad", "inference_mode", "autocast", "device", "doubles"],
)
@pytest.mark.parametrize("options", [QUICK, {"field": "neural", "steps": 2, "resolution": 2.0}], ids=["surface", "net"])
def test_what_a_program_asks_of_pytorch_changes_no_fit(make_hamlet: Any, mode: Any, options: Any) -> None:
    """Where gradients were off, or numbers doubles, fits ended in PyTorch's words."""
    plain = sattools.fit(make_hamlet("PLAIN"), options)
    with mode():
        asked = (torch.is_grad_enabled(), torch.get_default_dtype(), torch.is_autocast_enabled("cpu"))
        fitted = sattools.fit(make_hamlet("ASKED"), options)
        assert (torch.is_grad_enabled(), torch.get_default_dtype(), torch.is_autocast_enabled("cpu")) == asked
    assert fitted.path("fit/model.safetensors").read_bytes() == plain.path("fit/model.safetensors").read_bytes()


@pytest.mark.parametrize("given", [None, {"type": "FeatureCollection"}, b"{}", 3])
def test_what_is_no_document_is_told(given: Any) -> None:
    kind = type(given).__name__
    with pytest.raises(SceneError, match=f"^<stdin>: found {kind}, expected the text of a scene document$"):
        sattools.Scene.from_json(given)
    with pytest.raises(SceneError, match=f"^found {kind}, expected the path of a scene document$"):
        sattools.Scene.from_file(given)


def test_threads_side_by_side_hear_nothing_of_images_without_a_place(make_town: Any, tmp_path: Path) -> None:
    """A library in one puts back the filters of warnings from before another began: that one's would be gone."""
    plain = tmp_path / "plain.tif"
    profile = {"driver": "GTiff", "width": 2, "height": 2, "count": 1, "dtype": "uint8"}
    with not_georeferenced, rasterio.open(plain, "w", **profile):
        pass
    scenes = [make_town("A"), make_town("B")]
    changed, back = threading.Event(), threading.Event()

    def first(share: float, _: str) -> None:
        if not changed.is_set():
            with warnings.catch_warnings():
                changed.set()
                assert begun.wait(HANGING_S)
            back.set()

    def second(share: float, _: str) -> None:
        begun.set()
        assert back.wait(HANGING_S)
        rasterio.open(plain).close()

    begun = threading.Event()
    with warnings.catch_warnings():
        warnings.simplefilter("error", NotGeoreferencedWarning)
        before = list(warnings.filters)
        with ThreadPoolExecutor(2) as threads:
            one = threads.submit(sattools.normalise, scenes[0], progress=first)
            assert changed.wait(HANGING_S)
            other = threads.submit(sattools.normalise, scenes[1], progress=second)
            assert [run.result(HANGING_S).id for run in (one, other)] == ["A", "B"]
        assert warnings.filters == before
