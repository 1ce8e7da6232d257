"""The plugin's parts that know nothing of QGIS: forms, environment, running and cancelling."""

import json
import os
import shutil
import stat
import subprocess
import sys
import time
import zipfile
from pathlib import Path
from typing import Any

import pytest
from sattools_qgis import colours, forms, runner

from sattools.cli import main
from sattools.cli.usage import usage

USAGE = json.loads(usage(main))


def script(tmp_path: Path, text: Any) -> Any:
    """An executable Python script."""
    path = tmp_path / "program"
    path.write_text(f"#!{sys.executable}\n{text}", encoding="utf-8")
    path.chmod(path.stat().st_mode | stat.S_IXUSR)
    return str(path)


def run(path: Any, cancelled: Any = lambda: False) -> Any:
    progress, lines = [], []
    output = runner.run([path], lambda share, text: progress.append((share, text)), lines.append, cancelled)
    return output, progress, lines


def test_every_command_that_the_plugin_knows_exists() -> None:
    assert set(forms.ALGORITHMS) <= set(USAGE["commands"])


@pytest.mark.parametrize("name", list(forms.ALGORITHMS))
def test_a_form_left_at_its_defaults_replaces_results_but_no_scene_and_adds_nothing_else(name: Any) -> None:
    """A scene of the same name may be of other images."""
    fields = forms.fields(name, USAGE["commands"][name])
    given = forms.arguments(fields, {f["key"]: f["default"] for f in fields})
    assert given == ([] if name in forms.SOURCES else ["--overwrite"])


@pytest.mark.parametrize("name", list(forms.ALGORITHMS))
def test_every_option_that_goes_with_a_scene_reaches_the_command_line(name: Any) -> None:
    fields = forms.fields(name, USAGE["commands"][name])
    aside = {"compare": {"--predicted", "--fit", "--out"}, "prep": {"--dfc2019"}}.get(name, set())
    assert {f["flag"] for f in fields} == {o["name"] for o in USAGE["commands"][name]["options"]} - aside
    assert len({f["key"] for f in fields}) == len(fields)


def test_a_paragraph_of_help_is_one_line() -> None:
    assert forms.paragraphs("Says\nwhat.\n\nAnd\n  how.") == "Says what.\nAnd how."
    assert max(forms.paragraphs(c["help"]).count("\n") for c in USAGE["commands"].values()) < 4


def test_values_become_arguments() -> None:
    fields = forms.fields("fit", USAGE["commands"]["fit"])
    values = {"SEED": 7, "POSE": "no", "EPOCHS": "4 2", "LOSS": "raw-log", "OVERWRITE": False, "BUDGET": None}
    given = " " + " ".join(forms.arguments(fields, values))
    assert sorted(given.split(" --")[1:]) == ["epochs 2", "epochs 4", "loss raw-log", "no-pose", "seed 7"]


@pytest.mark.parametrize(("value", "given"), [("yes", ["--copy"]), ("no", ["--no-copy"]), (None, []), ("", [])])
def test_what_may_be_left_to_the_command_is_neither_on_nor_off(value: Any, given: list[str]) -> None:
    """A box without a tick was no `--no-copy`: pixels were copied all the same."""
    (copy,) = [field for field in forms.fields("prep", USAGE["commands"]["prep"]) if field["key"] == "COPY"]
    assert (copy["type"], copy["choices"], copy["default"]) == ("switch", ["yes", "no"], None)
    assert forms.arguments([copy], {"COPY": value}) == given


def test_a_value_that_is_chosen_beside_a_preset_reaches_the_command_even_if_it_is_the_usual_one() -> None:
    fields = forms.fields("fit", USAGE["commands"]["fit"])
    values = {"PRESET": "satnerf", "LOSS": "raw-gamma", "POSE": "yes", "ROBUST": 0.1}
    given = " " + " ".join(forms.arguments(fields, values))
    assert sorted(given.split(" --")[1:]) == ["loss raw-gamma", "pose", "preset satnerf", "robust 0.1"]
    (loss,) = [field for field in fields if field["key"] == "LOSS"]
    assert loss["default"] is None  # what a form shows is what comes
    assert loss["help"].endswith("Left empty: raw-gamma, or what the preset says.")


def test_all_that_a_preset_may_set_is_marked_so() -> None:
    from sattools.fit import presets

    names = set().union(*presets.PRESETS.values(), presets.WARM, presets.NEURAL)
    marked = {o["name"].lstrip("-").replace("-", "_") for o in USAGE["commands"]["fit"]["options"] if o["by_preset"]}
    assert marked == names


@pytest.mark.parametrize("value", ["auto", "512"])
def test_a_number_that_may_be_a_word_is_asked_for_as_text(value: str) -> None:
    (tile,) = [field for field in forms.fields("fit", USAGE["commands"]["fit"]) if field["key"] == "TILE"]
    assert (tile["type"], tile["default"]) == ("text", None)
    assert "auto = as the free memory asks for" in tile["help"]
    assert forms.arguments([tile], {"TILE": value}) == ["--tile", value]
    assert forms.arguments([tile], {"TILE": ""}) == []


def test_an_option_of_several_values_is_given_once() -> None:
    fields = forms.fields("prep", USAGE["commands"]["prep"])
    bounds = [f for f in fields if f["key"] == "BOUNDS"]
    assert forms.arguments(bounds, {"BOUNDS": "1 2 3 4"}) == ["--bounds", "1", "2", "3", "4"]


def test_names_with_blanks_are_one_value_within_quotes() -> None:
    fields = [f for f in forms.fields("compare", USAGE["commands"]["compare"]) if f["key"] in ("MAP", "LPIPS_WEIGHTS")]
    text = 'w="C:\\my maps\\w.tif"  "b=O\'Hara/b.tif"'
    assert forms.arguments(fields, {"MAP": text, "LPIPS_WEIGHTS": "a b"}) == [
        "--map", "w=C:\\my maps\\w.tif", "--map", "b=O'Hara/b.tif", "--lpips-weights", "a", "--lpips-weights", "b",
    ]  # fmt: skip
    assert all("in double quotes what holds blanks itself" in f["help"] for f in fields)


def test_several_layers_are_given_one_by_one_whatever_their_names_hold() -> None:
    fields = forms.fields("prep", USAGE["commands"]["prep"])
    assert forms.arguments(fields, {"MASK": ["a lake.gpkg", "b.shp"], "AOI": "my area.shp"}) == [
        "--aoi", "my area.shp", "--mask", "a lake.gpkg", "--mask", "b.shp",
    ]  # fmt: skip


@pytest.mark.parametrize("name", list(forms.ALGORITHMS))
def test_a_form_shows_few_fields_and_each_of_them_exists(name: Any) -> None:
    fields = forms.fields(name, USAGE["commands"][name])
    plain = [f["flag"].lstrip("-") for f in fields if not f["advanced"]]
    assert plain == list(forms.PLAIN[name])
    assert len(plain) <= 8
    assert all(f["help"] and len(f["label"]) < 45 for f in fields)


def test_the_products_in_the_form_are_those_of_export() -> None:
    from sattools.export.products.names import FILES

    assert set(forms.PRODUCTS) == set(FILES)


@pytest.mark.parametrize("kind", ["hapke", "rpv"])
def test_every_map_of_a_reflectance_model_is_loaded_after_an_export(kind: Any) -> None:
    from sattools.fit.materials.parameters import AMPLITUDE, SHAPE

    names = [parameter.name for parameter in (AMPLITUDE[kind], *SHAPE[kind])]
    names += [*(f"{name}_std" for name in names), "identifiable", "normal", "normal_std", "reflectance", "relit"]
    assert set(names) <= set(forms.ALGORITHMS["export"][2])


def test_a_scene_that_has_been_moved_is_read_from_where_it_lies(tmp_path: Path) -> None:
    (tmp_path / "dsm.tif").write_text("")
    document = {"sattools": {"root": "/somewhere/else", "products": {"dsm": "dsm.tif"}}}
    (tmp_path / "scene.json").write_text(json.dumps(document))
    scene = forms.read_scene(str(tmp_path / "scene.json"))
    assert forms.products(scene, ["dsm"]) == {"dsm": str(tmp_path / "dsm.tif")}


def test_of_what_a_pipe_has_left_elsewhere_the_scene_in_its_folder_is_read(tmp_path: Path) -> None:
    """`... | sattools export > harbour.json`: results of `compare` stand in the folder's document only."""
    (tmp_path / "work").mkdir()
    (tmp_path / "work/difference.tif").write_text("")
    own = {"sattools": {"root": ".", "products": {"difference": "difference.tif"}}}
    (tmp_path / "work/scene.json").write_text(json.dumps(own))
    piped = {"sattools": {"root": str(tmp_path / "work"), "products": {}}}
    (tmp_path / "harbour.json").write_text(json.dumps(piped))
    scene = forms.read_scene(str(tmp_path / "harbour.json"))
    assert forms.products(scene, ["difference"]) == {"difference": str(tmp_path / "work/difference.tif")}
    assert forms.document_of(scene, "harbour.json") == str(tmp_path / "work/scene.json")


@pytest.mark.parametrize(
    ("names", "expected"),
    [
        (["albedo blue", "albedo green", "albedo red", "albedo nir08"], [3, 2, 1]),
        (["coastal", "blue", "green", "yellow", "red", "rededge", "nir08", "nir09"], [5, 3, 2]),
        (["albedo red (Red)", "albedo green (Green)", "albedo blue (Blue)"], [1, 2, 3]),  # as later versions of QGIS
        (["rededge", "green", "blue", "nir"], [1, 2, 3]),
        ([f"albedo band {k}" for k in range(1, 9)], [5, 3, 2]),
        ([f"albedo band {k}" for k in range(1, 5)], [1, 2, 3]),
        (["normal east", "normal north", "normal up"], [1, 2, 3]),
        ([""] * 8, [1, 2, 3]),
    ],
)
def test_bands_that_are_called_red_green_and_blue_are_shown_so(names: list[str], expected: list[int]) -> None:
    """Four bands of WorldView come blue first: roofs of tiles were blue."""
    assert colours.shown_bands([f"Band {k}: {name}" for k, name in enumerate(names, 1)]) == expected


def test_the_plugins_metadata_has_no_placeholders() -> None:
    text = (Path(forms.__file__).parent / "metadata.txt").read_text()
    assert "example.org" not in text
    assert {"name", "version", "description", "qgisMinimumVersion"} <= {line.split("=")[0] for line in text.split("\n")}


def test_the_zip_for_qgis_holds_no_compiled_files(tmp_path: Path) -> None:
    root = Path(forms.__file__).parents[2]
    shutil.copytree(root / "qgis_plugin", tmp_path / "qgis_plugin")
    shutil.copy(root / "Makefile", tmp_path)
    for folder in ("sattools_qgis", "sattools_qgis/processing"):
        (tmp_path / "qgis_plugin" / folder / "__pycache__").mkdir(exist_ok=True)
        (tmp_path / "qgis_plugin" / folder / "__pycache__" / "forms.cpython-312.pyc").touch()
    subprocess.run(["make", "-s", "qgis-zip", f"PYTHON={sys.executable}"], cwd=tmp_path, check=True)
    names = zipfile.ZipFile(tmp_path / "dist" / "sattools_qgis.zip").namelist()
    assert "sattools_qgis/metadata.txt" in names
    assert [name for name in names if "__pycache__" in name] == []


def test_the_environment_of_qgis_stays_with_qgis() -> None:
    own = {"PATH": "/bin", "HOME": "/h", "LANG": "C"}
    foreign = {"PYTHONPATH": "x", "QT_PLUGIN_PATH": "x", "GDAL_DATA": "x", "PROJ_LIB": "x", "LD_LIBRARY_PATH": "x"}
    foreign |= {"PYTHONHOME": "x", "DYLD_LIBRARY_PATH": "x", "__PYVENV_LAUNCHER__": "x"}  # of macOS, too
    assert runner.clean_environment(own | foreign) == own


def test_a_home_in_the_setting_is_found(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The way to install that is told has one."""
    monkeypatch.setenv("HOME", str(tmp_path))
    assert runner.find_executable("~/program") is None
    path = script(tmp_path, "")
    assert runner.find_executable("~/program") == path


def test_windows_opens_no_console_above_qgis() -> None:
    assert runner.apart("nt") == {"creationflags": 0x08000200}  # CREATE_NO_WINDOW, CREATE_NEW_PROCESS_GROUP
    assert runner.apart("posix") == {"start_new_session": True}


def test_a_command_is_told_as_a_shell_takes_it() -> None:
    assert runner.as_typed(["/my programs/sattools", "fit", "a.json"]) == "'/my programs/sattools' fit a.json"


def test_progress_lines_are_told_apart_from_messages(tmp_path: Path) -> None:
    text = (
        'import sys\nprint("{\\"progress\\": 0.25, \\"message\\": \\"half\\"}", file=sys.stderr)\n'
        'print("a remark", file=sys.stderr)\nprint("result")\n'
    )
    assert run(script(tmp_path, text)) == ("result\n", [(0.25, "half")], ["a remark"])


def test_a_failure_carries_the_last_line(tmp_path: Path) -> None:
    path = script(tmp_path, 'import sys\nprint("first", file=sys.stderr)\nsys.exit("sattools fit: error: no images")\n')
    said: list[str] = []
    with pytest.raises(runner.CommandFailed, match=r"^sattools fit: error: no images$"):
        runner.run([path], lambda share, text: None, said.append, lambda: False)
    assert said == ["first"]  # QGIS shows the error itself


def test_an_error_that_was_not_the_last_word_is_told_in_its_place(tmp_path: Path) -> None:
    path = script(tmp_path, 'import sys\nprint("sattools fit: error: a\\nb", file=sys.stderr)\n')
    assert run(path) == ("", [], ["sattools fit: error: a", "b"])


def test_a_command_that_the_system_has_ended_does_not_blame_the_warning_before(tmp_path: Path) -> None:
    warned = "import os, sys\nprint('sattools: a warning', file=sys.stderr, flush=True)\n"
    path = script(tmp_path, f"{warned}os.kill(os.getpid(), 9)")
    with pytest.raises(runner.CommandFailed, match=r"ended from outside \(signal 9\); was there too little memory\?"):
        run(path)
    assert runner._why(0xC0000005, "a warning").startswith("sattools was ended from outside (exit code 0xC0000005)")
    assert runner._why(1, "MemoryError") == "MemoryError"


@pytest.mark.parametrize(
    ("text", "found"),
    [
        ("import sys\nsys.exit('Error: No such option: --json-usage')", "No such option: --json-usage"),
        ("print('[]')", "gives no --json-usage"),
        ('print(\'{"version": null, "commands": {}}\')', "gives no --json-usage"),
    ],
)
def test_an_executable_of_another_kind_is_told_with_its_own_words(tmp_path: Path, text: str, found: str) -> None:
    with pytest.raises(runner.CommandFailed, match=found):
        runner.usage_of(script(tmp_path, text))


def test_cancelling_ends_the_whole_process_group(tmp_path: Path) -> None:
    marker = tmp_path / "child"
    path = script(
        tmp_path,
        "import subprocess, sys, time\n"
        "child = subprocess.Popen([sys.executable, '-c', 'import time; time.sleep(60)'])\n"
        f"open({str(marker)!r}, 'w').write(str(child.pid))\n"
        "time.sleep(60)\n",
    )
    with pytest.raises(runner.Cancelled):
        run(path, lambda: marker.exists() and marker.read_text() != "")
    child = int(marker.read_text())
    for _ in range(50):  # a killed orphan stays in the table until init has read its status
        state = subprocess.run(["ps", "-o", "stat=", "-p", str(child)], capture_output=True, text=True).stdout.strip()
        if state == "" or state.startswith("Z"):
            break
        time.sleep(0.1)
    assert state == "" or state.startswith("Z")


def test_windows_is_asked_to_end_what_the_launcher_has_started_too(monkeypatch: pytest.MonkeyPatch) -> None:
    calls = []

    class Process:
        pid = 77

        def poll(self) -> Any:
            return None

        def terminate(self) -> None:
            calls.append("terminate")

        def wait(self, seconds: float) -> None:
            calls.append("wait")

    monkeypatch.setattr(subprocess, "run", lambda command, **_: calls.append(command))
    runner._end(Process(), "nt")
    assert calls == [["taskkill", "/F", "/T", "/PID", "77"], "terminate", "wait"]


def test_a_missing_executable_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PATH", str(tmp_path))
    assert runner.find_executable() is None
    assert runner.find_executable(str(tmp_path / "nothing")) is None
    assert "Settings > Options > Processing" in runner.INSTALL


def test_an_executable_is_found_on_the_path(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "sattools"
    path.write_text("#!/bin/sh\n")
    path.chmod(0o755)
    monkeypatch.setenv("PATH", str(tmp_path))
    assert runner.find_executable() == str(path)
    assert os.path.samefile(runner.find_executable(str(path)), path)
