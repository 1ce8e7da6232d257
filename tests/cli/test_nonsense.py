"""Documents, options and surroundings that make no sense: one line, the right exit code, nothing half done."""

import json
import os
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from click.testing import CliRunner

from sattools.cli import main
from sattools.scene import Scene

QUICK = ["--resolution", "2", "--coarsest", "2", "--epochs", "1"]
PRIOR = ["prior", "--resolution", "2", "--rough-passes", "0"]


def run(*arguments: Any, text: Any = "") -> Any:
    return CliRunner().invoke(main, [*map(str, arguments)], input=text)


def refused(result: Any, *words: Any, code: Any = 1) -> None:
    assert result.exit_code == code, result.output
    assert result.stdout == ""
    assert "Traceback" not in result.stderr
    assert "internal error" not in result.stderr
    last = " ".join(result.stderr.split()) if code == 2 else result.stderr.splitlines()[-1]
    for word in words:
        assert word in last
    assert len(last) < 1000


@pytest.fixture
def town(make_town: Any) -> Any:
    return make_town()


@pytest.fixture(scope="module")
def fitted_source(town_source: Any, tmp_path_factory: pytest.TempPathFactory) -> Any:
    root = tmp_path_factory.mktemp("fitted") / "TOWN"
    shutil.copytree(town_source.root, root)
    scene = Scene.from_file(root / "scene.json")
    for command in (PRIOR, ["fit", *QUICK]):
        result = run(*command, text=scene.to_json())
        assert result.exit_code == 0, result.output
        scene = Scene.from_json(result.stdout)
    return scene


@pytest.fixture
def fitted(fitted_source: Any, tmp_path: Path) -> Any:
    shutil.copytree(fitted_source.root, tmp_path / "FITTED")
    return Scene.from_file(tmp_path / "FITTED/scene.json")


# ---- what a document says -------------------------------------------------------------------------------


def change(scene: Any, where: Any, value: Any) -> Any:
    document = json.loads(scene.to_json())
    node = document
    for key in where[:-1]:
        node = node[key]
    node[where[-1]] = value
    return json.dumps(document)


SUN = ("features", 0, "properties", "view:sun_elevation")
ROLE = ("features", 0, "properties", "sattools:role")
BITS = ("features", 0, "properties", "sattools:bits")
HEIGHTS = ("sattools", "height_range_m")
DOCUMENTS = {
    "sun 400": (SUN, 400, "view:sun_elevation: found 400"),
    "sun below the horizon": (SUN, -20, "found view:sun_elevation -20, expected a sun above the horizon"),
    "sun NaN": (SUN, float("nan"), "view:sun_elevation: found nan"),
    "heights of another place": (HEIGHTS, [5000, 5100], "found heights from 5000 to 5100 m"),
    "role": (ROLE, "tset", "did you mean 'test'"),
    "bits 0": (BITS, 0, "sattools:bits: found 0"),
    "bits -5": (BITS, -5, "sattools:bits: found -5"),
    "too few bits": (BITS, 4, "found sattools:bits 4 for numbers of up to"),
    "RPC of another item": (("features", 0, "assets", "rpc", "href"), "rpc/TOWN_004_RPC.TXT", "found the rpc of item"),
    "image of another item": (("features", 0, "assets", "image", "href"), "images/TOWN_004.tif", "the image of item"),
    "grid in degrees": (("sattools", "grid", "crs"), "EPSG:4326", "EPSG:4326"),
    "grid of one cell": (("sattools", "grid", "width"), 1, "expected at least 8"),
}


@pytest.mark.parametrize("name", DOCUMENTS)
@pytest.mark.parametrize("command", [PRIOR, ["fit", *QUICK]], ids=["prior", "fit"])
def test_documents_that_contradict_themselves(town: Any, command: Any, name: Any) -> None:
    town.items[0].properties["sattools:value_range"] = [0, 2000]
    where, value, words = DOCUMENTS[name]
    refused(run(*command, text=change(town, where, value)), words)
    assert not [p for p in (town.root / "fit").rglob("*") if p.is_file()]


def test_files_of_another_item_under_the_right_name(town: Any) -> None:
    town.items[0].properties["proj:shape"] = [17, 18]
    refused(run("fit", *QUICK, text=town.to_json()), "the image of another item?")


def test_a_camera_of_another_item_under_the_right_name(town: Any) -> None:
    shutil.copy(town.root / "rpc/TOWN_004_RPC.TXT", town.root / "rpc/TOWN_001_RPC.TXT")
    refused(run("fit", *QUICK, text=town.to_json()), "item TOWN_001: found a camera that looks")


def test_a_prior_that_is_another_product(fitted: Any) -> None:
    fitted.history = []
    fitted.products["prior_dsm"] = fitted.products["prior_normals"]
    fitted.write()
    result = run("fit", *QUICK, "--overwrite", text=fitted.to_json())
    refused(result, "found 3 bands, expected one as prior_dsm has")


@pytest.mark.parametrize(
    ("value", "words"),
    [(np.nan, "no finite height"), (np.inf, "no finite height"), (1e30, "expected some of the Earth")],
)
def test_a_model_of_one_bad_value(fitted: Any, value: Any, words: Any) -> None:
    import torch

    from sattools.fit.checkpoint import load, save

    path = fitted.path(fitted.products["model"])
    tensors, meta = load(path)
    tensors["height"] = torch.full_like(tensors["height"], value)
    save(path, tensors, meta)
    fitted.history = []
    refused(run("export", text=fitted.to_json()), "model.safetensors: found", words)


def test_a_model_whose_tensors_have_another_shape(fitted: Any) -> None:
    from sattools.fit.checkpoint import load, save

    path = fitted.path(fitted.products["model"])
    tensors, meta = load(path)
    tensors["albedo"] = tensors["albedo"][:-1].contiguous()
    save(path, tensors, meta)
    fitted.history = []
    refused(run("export", text=fitted.to_json()), "model.safetensors: found albedo of", "as its grid has")


@pytest.mark.parametrize("sun", ["400,30", "120,-5", "120,91", "nan,30", "a,b", "120"])
def test_a_sun_to_relight_with_that_is_none(fitted: Any, sun: Any) -> None:
    result = run("export", "--view", "TOWN_001", "--sun", *sun.split(","), text=fitted.to_json())
    assert result.exit_code in (1, 2)
    assert "Traceback" not in result.output
    assert "internal error" not in result.output
    assert not (fitted.root / "export").exists()


def test_a_scene_with_a_byte_order_mark_is_read(town: Any) -> None:
    path = town.root / "scene.json"
    path.write_bytes(b"\xef\xbb\xbf" + path.read_bytes())
    assert run("info", path).exit_code == 0
    assert CliRunner().invoke(main, ["info"], input=path.read_bytes()).exit_code == 0


def test_info_prints_nothing_that_steers_a_terminal(town: Any) -> None:
    town.items[0].properties["platform"] = "\x1b[31mred\x1b]0;title\x07"
    town.products["\x1b[2J"] = "x\x9b.tif"
    result = run("info", text=town.to_json())
    assert result.exit_code == 0
    assert not any(c in result.output for c in "\x1b\x07\x9b")


def test_a_report_of_nothing_is_an_error() -> None:
    refused(run("report"), "stdin: found nothing")


@pytest.mark.parametrize("coordinates", [[], [[1, 2]], "x", [[["a", "b"]]]])
def test_a_report_of_a_scene_with_a_bad_geometry(town: Any, coordinates: Any) -> None:
    where = ("features", 0, "geometry")
    text = change(town, where, {"type": "Polygon", "coordinates": coordinates})
    refused(run("report", text=text), "geometry")


def test_a_report_of_a_document_in_another_encoding(town: Any) -> None:
    path = town.root / "scene.json"
    path.write_bytes(b'{"id": "\xe9"}')
    refused(run("report", path), "not UTF-8")
    path.write_bytes(town.to_json().encode("utf-16"))
    assert run("report", path).exit_code == 0


def test_too_little_memory_is_told_as_such_whoever_asked_for_it() -> None:
    from sattools.cli.safety import explain

    of_torch = RuntimeError("[enforce fail at alloc_cpu.cpp:127] DefaultCPUAllocator: can't allocate memory: you tried")
    for error in (of_torch, MemoryError(), RuntimeError("CUDA out of memory. Tried to allocate 2.00 GiB")):
        assert explain(error).startswith("found too little memory (")
    assert explain(RuntimeError("another one")).startswith("internal error (RuntimeError: another one)")


# ---- options and configuration files --------------------------------------------------------------------


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("[fitt]\nseed = 1", "did you mean 'fit'"),
        ("[fit]\nseed = 1.7", "seed: found 1.7, expected a whole number"),
        ("fit = 3", "found fit = 3, expected a table [fit]"),
        ("[fit]\nsede = 1", "did you mean 'seed'"),
        ("[fit]\nseed = nan", "seed: found nan"),
        ("[fit]\nbudget = inf", "budget: found inf"),
        ("[fit]\nepochs = 3", "epochs: found 3, expected a list"),
        ("[fit]\npose = 1", "pose: found 1, expected true or false"),
        ('[fit]\nprecision = "bf17"', "c.toml: precision: 'bf17' is not one of 'float32', 'tf32', 'bf16'"),
        ("[fit]\nsteps = -3", "c.toml: steps: -3 is not in the range 1<=x<=100000000"),
        ("[fit]\nmaterials = 2000000000", "c.toml: materials: "),
    ],
)
@pytest.mark.parametrize("command", ["fit", "batch"])
def test_configuration_files_are_taken_at_their_word(
    tmp_path: Path, town: Any, command: Any, text: Any, words: Any
) -> None:
    path = tmp_path / "c.toml"
    path.write_text(text)
    extra = ["--print-config"] if command == "fit" else ["--dry-run", town.root / "scene.json"]
    refused(run(command, "--config", path, *extra), words, code=2)


NUMBERS = [
    ("prep", "--cell-size"),
    ("prior", "--resolution"),
    ("prior", "--memory"),
    ("fit", "--resolution"),
    ("fit", "--tile"),
    ("fit", "--smooth"),
    ("fit", "--budget"),
    ("simulate", "--lon"),
    ("simulate", "--size"),
    ("normalise", "--gamma"),
]


@pytest.mark.parametrize(("command", "option"), NUMBERS)
@pytest.mark.parametrize("value", ["nan", "inf", "-inf", "1e400"])
def test_numbers_that_are_none(command: Any, option: Any, value: Any) -> None:
    result = run(command, option, value, *(["a.tif"] if command == "prep" else []))
    if "No such option" in result.stderr:
        pytest.fail(f"{command} has no {option}")
    refused(result, option, code=2)


def test_a_count_that_would_never_end(town: Any) -> None:
    result = run("prior", "--rough-passes", "1000000000", text=town.to_json())
    refused(result, "--rough-passes", code=2)


@pytest.mark.parametrize(
    ("command", "size"),
    [(["fit", "--prior-weight", "0"], "1000"), (["fit", "--prior-weight", "0"], "4294967296"), (["prior"], "1000")],
)
def test_cells_as_large_as_the_area(town: Any, command: Any, size: Any) -> None:
    result = CliRunner().invoke(main, [*command, "--resolution", size, "--overwrite", str(town.root / "scene.json")])
    assert result.exit_code == 1, result.stderr
    assert f"found 1 x 1 cells of {float(size):g} m for the whole area" in result.stderr


def test_a_misspelt_command_is_guessed() -> None:
    refused(run("fitt"), "No such command 'fitt' (did you mean 'fit'?)", code=2)


@pytest.mark.parametrize("arguments", [["--threads", "1"], ["--quiet"], ["-q"], ["--progress", "none"], ["-v"]])
def test_how_a_command_runs_may_be_said_after_it(town: Any, arguments: Any) -> None:
    assert run("info", town.root / "scene.json", *arguments).exit_code == 0
    assert run(*arguments, "info", town.root / "scene.json").exit_code == 0


def test_a_dry_run_of_a_batch_writes_nothing(town: Any, tmp_path: Path) -> None:
    out = tmp_path / "out"
    result = run("batch", town.root / "scene.json", "--out", out, "--dry-run")
    assert result.exit_code == 0, result.output
    assert "would do" in result.stderr
    assert not out.exists()


# ---- surroundings ---------------------------------------------------------------------------------------


def command(*arguments: Any, **keywords: Any) -> Any:
    return subprocess.run(
        [sys.executable, "-m", "sattools", *map(str, arguments)], capture_output=True, text=True, **keywords
    )


def test_a_working_folder_that_was_deleted(tmp_path: Path) -> None:
    gone = tmp_path / "gone"
    gone.mkdir()
    call = f"cd {gone} && rmdir {gone} && exec {sys.executable} -P -m sattools info x.json"
    done = subprocess.run(["bash", "-c", call], capture_output=True, text=True)
    assert done.returncode == 1
    assert done.stderr == (
        "sattools info: error: found no working folder (it was deleted), expected to be started in one\n"
    )


def test_names_that_are_not_utf_8(tmp_path: Path) -> None:
    folder = os.fsencode(tmp_path)
    done = subprocess.run(
        [sys.executable, "-m", "sattools", "prep", folder + b"/a\xff.tif", folder + b"/b.tif"], capture_output=True
    )
    assert done.returncode == 1
    assert done.stderr.count(b"\n") == 1
    assert b"found a name that is not UTF-8" in done.stderr


@pytest.mark.parametrize("length", [300, 5000])
@pytest.mark.parametrize("name", ["info", "report", "fit", "compare"])
def test_very_long_names(length: Any, name: Any) -> None:
    refused(run(name, "x" * length), "too long")


def test_very_long_names_of_images() -> None:
    refused(run("prep", "x" * 5000, "y" * 5000), "too long")
    refused(run("prep", "x" * 5000, "y" * 5000, "--dry-run"), "too long")


def test_devices_that_never_end_are_no_documents() -> None:
    refused(run("info", "/dev/zero"), "found more than")
    refused(run("fit", "--config", "/dev/zero", "--print-config"), "found more than", code=2)


def test_names_of_files_are_no_formulas(fitted: Any, tmp_path: Path) -> None:
    reference = tmp_path / r"ref$\foo$_^{.tif"
    shutil.copy(fitted.path(fitted.products["truth_dsm"]), reference)
    done = run("export", text=fitted.to_json())
    assert done.exit_code == 0, done.output
    result = run("compare", "--dsm", reference, text=done.stdout)
    assert result.exit_code == 0, result.output


@pytest.mark.parametrize("record", ['{"key": "k"}', '{"key": "k", "scene_json": 3}', "[]", "", '{"key": "k", "scene_j'])
def test_a_damaged_record_of_a_batch_is_done_again(tmp_path: Path, record: Any) -> None:
    from sattools.batch.plan import Task

    (tmp_path / "task.json").write_text(record)
    assert Task("A/b", str(tmp_path), "k", "A", "b", "", [], "").result() is None


@pytest.mark.parametrize(
    "document",
    [
        {"features": 3.5},
        {"type": "FeatureCollection", "features": [3]},
        {"type": "Polygon", "coordinates": 5},
        {"type": "Polygon", "coordinates": [[[1e400, 0], [0, 1], [1, 1]]]},
        {"type": "Polygon", "coordinates": [[["a", "b"]]]},
        [],
    ],
)
def test_areas_that_are_none(town: Any, tmp_path: Path, document: Any) -> None:
    path = tmp_path / "area.geojson"
    path.write_text(json.dumps(document))
    images = sorted((town.root / "images").glob("*.tif"))
    refused(run("prep", *images, "--aoi", path, "--out", tmp_path / "out"), "area.geojson")
    refused(run("prep", *images, "--aoi", path, "--out", tmp_path / "out", "--dry-run"), "area.geojson")


# ---- a folder that is moved -----------------------------------------------------------------------------


def test_a_scene_works_wherever_its_folder_is_moved(fitted: Any, tmp_path: Path) -> None:
    moved = tmp_path / "elsewhere/deep"
    moved.parent.mkdir()
    shutil.move(fitted.root, moved)
    assert json.loads((moved / "scene.json").read_text())["sattools"]["root"] == "."
    done = run("export", moved / "scene.json")
    assert done.exit_code == 0, done.output
    assert Scene.from_json(done.stdout).root == moved
    assert (moved / "export").is_dir()
    assert run("report", moved).exit_code == 0


def test_a_copy_of_a_scene_leaves_the_original_alone(town: Any, tmp_path: Path) -> None:
    copy = tmp_path / "copy"
    shutil.copytree(town.root, copy)
    before = sorted(p for p in town.root.rglob("*"))
    done = run(*PRIOR, copy / "scene.json")
    assert done.exit_code == 0, done.output
    assert (copy / "prior").is_dir()
    assert sorted(p for p in town.root.rglob("*")) == before


def test_the_working_folder_does_not_matter_to_a_document_that_is_a_file(
    town: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    Scene.from_file(town.root / "scene.json").write()
    monkeypatch.chdir(tmp_path)
    assert Scene.from_file(Path(town.root.name) / "scene.json").root == town.root
