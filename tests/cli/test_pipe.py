"""The contract of the pipe: scenes in, scenes out, one line each; errors on stderr; exit codes."""

import json
import subprocess
import sys
import threading
from pathlib import Path
from typing import Any

import click
import pytest
from click.testing import CliRunner
from patience import HANGING_S

from sattools.cli.options import common_options, scene_argument
from sattools.cli.pipe import Run, run_scenes
from sattools.errors import SceneError
from sattools.scene import Asset, Item, Scene
from sattools.scene.dependencies import begin


@click.command("touch")
@scene_argument
@common_options
@click.option("--fail", default="")
def touch(scenes: Any, overwrite: Any, dry_run: Any, print_config: Any, fail: Any) -> None:
    """A command like any other: writes one file, and fails for one scene if asked to."""

    def work(scene: Any, progress: Any) -> Any:
        if scene.id == fail:
            raise SceneError(f"scene {scene.id}: found a\nproblem, expected none")
        progress(0.5, "half")
        begin(scene, "fit", ["touched"], overwrite)["touched"].write_text(scene.id)
        scene.products["touched"] = "touched"
        return {"notes": ["it was easy"]}

    run_scenes(Run("touch", None, dry_run, print_config, overwrite), scenes, work, plan="touch a file")


@pytest.fixture
def line(tmp_path: Path) -> Any:
    def make(name: Any) -> Any:
        (tmp_path / name).mkdir()
        return Scene(name, tmp_path / name).to_json() + "\n"

    return make


def run(*arguments: Any, text: Any = "") -> Any:
    return CliRunner().invoke(touch, arguments, input=text)


def ids(result: Any) -> Any:
    return [json.loads(row)["id"] for row in result.stdout.splitlines()]


def test_one_scene_is_one_line_with_its_history(line: Any, tmp_path: Path) -> None:
    result = run(text=line("a"))
    assert result.exit_code == 0, result.output
    assert result.stdout.count("\n") == 1
    document = json.loads(result.stdout)["sattools"]
    assert document["products"] == {"touched": "touched"}
    entry = document["history"][-1]
    assert entry["command"] == "touch"
    assert entry["notes"] == ["it was easy"]
    assert entry["seconds"] >= 0
    assert 5 < entry["peak_memory_mb"] < 100000
    assert entry["versions"]["python"] == ".".join(map(str, sys.version_info[:3]))
    written = json.loads((tmp_path / "a/scene.json").read_text())
    assert written["sattools"].pop("root") == "."  # so that the folder can be moved
    assert document.pop("root") == str(tmp_path / "a")
    assert written["sattools"] == document


def test_several_scenes_are_passed_on_in_order_and_empty_lines_are_skipped(line: Any) -> None:
    result = run(text=line("a") + "\n" + line("b") + line("c"))
    assert result.exit_code == 0
    assert ids(result) == ["a", "b", "c"]


def test_one_scene_fails_and_the_others_are_passed_on(line: Any) -> None:
    result = run("--fail", "b", text=line("a") + line("b") + line("c"))
    assert result.exit_code == 3
    assert ids(result) == ["a", "c"]
    assert result.stderr == "sattools touch: error: scene b: found a problem, expected none\n"


def test_when_all_scenes_fail_the_command_fails(line: Any) -> None:
    result = run("--fail", "a", text=line("a"))
    assert (result.exit_code, result.stdout) == (1, "")


def test_empty_input_is_an_error_that_says_so() -> None:
    for text in ("", "\n\n"):
        result = run(text=text)
        assert result.exit_code == 1
        assert result.stderr.startswith("sattools touch: error: stdin: found nothing, expected scene documents")
        assert "dry runs of prep and simulate make none" in result.stderr


def test_two_scenes_with_one_id_and_root_are_told_apart_by_an_error(line: Any) -> None:
    text = line("a")
    result = run("--overwrite", text=text + text)
    assert result.exit_code == 3
    assert ids(result) == ["a"]
    assert "stdin line 2: found scene id 'a' a second time, expected unique ids" in result.stderr


def test_an_unreadable_line_is_named_and_the_next_is_done(line: Any) -> None:
    result = run(text="{nonsense\n" + line("b"))
    assert result.exit_code == 3
    assert ids(result) == ["b"]
    assert result.stderr.startswith("sattools touch: error: stdin line 1: found text that is not JSON")
    assert result.stderr.count("\n") == 1


@pytest.mark.parametrize("bom", ["", "\ufeff"])
def test_a_document_may_go_over_several_lines_as_jq_prints_it(line: Any, bom: str) -> None:
    spread = bom + json.dumps(json.loads(line("a")), indent=2) + "\n"
    result = run(text=spread + line("b") + "{nonsense\n")
    assert result.exit_code == 3
    assert ids(result) == ["a", "b"]
    number = spread.count("\n") + 2
    assert result.stderr.startswith(f"sattools touch: error: stdin line {number}: found text that is not JSON")
    assert result.stderr.count("\n") == 1


def test_a_document_that_breaks_off_is_one_error(line: Any) -> None:
    spread = json.dumps(json.loads(line("a")), indent=2)
    result = run(text=spread[: len(spread) // 2])
    assert result.exit_code == 1
    assert result.stderr.startswith("sattools touch: error: stdin line 1: found text that is not JSON")
    assert result.stderr.count("\n") == 1


def test_lines_of_another_text_are_one_error(line: Any) -> None:
    summary = "scene S  root /somewhere\n  grid 128 x 128 cells\n  6 images\n"
    result = run(text=summary + line("a") + "more\n\nand more\n" + line("b") + "[\n  {\n  },\n")
    assert result.exit_code == 3
    assert ids(result) == ["a", "b"]
    assert result.stderr.splitlines() == [
        "sattools touch: error: stdin lines 1 to 3: found text that is not JSON ('scene S root /somewhere'), expected "
        "scene documents",
        "sattools touch: error: stdin lines 5 to 7: found text that is not JSON ('more'), expected scene documents",
        "sattools touch: error: stdin lines 9 to 11: found text that is not JSON ('['), expected scene documents",
    ]


def test_a_scene_whose_root_is_gone_is_refused_and_no_folder_is_made(tmp_path: Path) -> None:
    result = run(text=Scene("a", tmp_path / "gone").to_json())
    assert result.exit_code == 1
    assert f"scene a: found no folder {tmp_path / 'gone'}, expected the scene's root" in result.stderr
    assert not (tmp_path / "gone").exists()


def test_a_scene_json_on_a_pipe_from_another_folder_is_told_how_to_be_given(
    line: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    scene = Scene.from_json(line("a"))
    scene.items.append(Item("i", None, None, {}, {"image": Asset("images/i.tif")}))
    elsewhere = tmp_path / "elsewhere"
    elsewhere.mkdir()
    monkeypatch.chdir(elsewhere)
    result = run(text=scene.to_json(root="."))
    assert result.exit_code == 1
    assert f"scene a: found none of its files in {elsewhere}, the current folder" in result.stderr
    assert "expected its path on the command line instead" in result.stderr
    assert not list(elsewhere.iterdir())
    scene.output("images/i.tif").touch()
    monkeypatch.chdir(scene.root)
    assert ids(run(text=scene.to_json(root="."))) == ["a"]


def test_a_path_is_taken_instead_of_stdin(line: Any, tmp_path: Path) -> None:
    text = line("a")
    path = tmp_path / "a/scene.json"
    path.write_text(json.dumps(json.loads(text), indent=3))
    assert ids(run(str(path))) == ["a"]
    assert run(str(tmp_path / "missing.json")).exit_code == 1


def test_a_folder_is_told_which_document_lies_in_it(line: Any, tmp_path: Path) -> None:
    text = line("a")
    assert f"{tmp_path}: found a folder, expected a scene document" in run(str(tmp_path)).stderr
    (tmp_path / "a/scene.json").write_text(text)
    for folder in (tmp_path / "a", tmp_path):  # the second as `prep --out` names it
        result = run(str(folder))
        assert result.exit_code == 1
        assert f"{folder}: found a folder, expected the scene document {tmp_path}/a/scene.json" in result.stderr


def test_a_document_whose_folder_was_moved_is_not_asked_for_its_own_path(
    line: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    scene = Scene.from_json(line("a"))
    scene.items.append(Item("i", None, None, {}, {"image": Asset("images/i.tif")}))
    (tmp_path / "kept.json").write_text(scene.to_json())
    scene.root.rename(tmp_path / "moved")
    monkeypatch.chdir(tmp_path)
    result = run("kept.json")
    assert result.exit_code == 1
    assert f"found none of its files in {tmp_path}, where kept.json lies, expected the scene.json in" in result.stderr


def test_dry_run_says_what_would_be_done_and_passes_the_scene_on(line: Any, tmp_path: Path) -> None:
    text = line("a")
    result = run("--dry-run", text=text)
    assert result.exit_code == 0
    assert result.stdout == text
    assert result.stderr == f"sattools touch: would touch a file for scene a in {tmp_path / 'a'}\n"
    assert list((tmp_path / "a").iterdir()) == []


def test_existing_outputs_need_overwrite(line: Any) -> None:
    text = line("a")
    assert run(text=text).exit_code == 0
    second = run(text=text)
    assert second.exit_code == 1
    assert "exists already; give --overwrite to replace it" in second.stderr
    assert run("--overwrite", text=text).exit_code == 0


def test_a_root_that_cannot_be_written_is_one_clear_line(tmp_path: Path) -> None:
    (tmp_path / "a").mkdir()
    (tmp_path / "a/touched").mkdir()
    (tmp_path / "a/scene.json").mkdir()  # stands in for a read-only folder, which root may write all the same
    scene = Scene("a", tmp_path / "a")

    @click.command("other")
    @scene_argument
    def other(scenes: Any) -> None:
        run_scenes(Run("other", None), scenes, lambda scene, progress: None)

    result = CliRunner().invoke(other, input=scene.to_json())
    assert result.exit_code == 1
    assert result.stdout == ""
    assert result.stderr.startswith(f"sattools other: error: {tmp_path}/a/scene.json: found a folder")
    assert [p.name for p in (tmp_path / "a").iterdir() if ".tmp" in p.name] == []


def sattools(*arguments: Any, **keywords: Any) -> Any:
    return subprocess.Popen([sys.executable, "-m", "sattools", *arguments], text=True, **keywords)


def test_a_reader_that_goes_away_ends_the_command_quietly(line: Any) -> None:
    process = sattools("info", stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.PIPE)
    process.stdout.close()
    process.stdin.write("".join(line(f"s{k}") for k in range(50)))
    process.stdin.close()
    assert process.stderr.read() == ""
    assert process.wait() == 1
    process.stderr.close()


def test_scenes_come_out_before_the_next_is_read(line: Any) -> None:
    """A slow source must not hold back what is done: the first scene arrives while stdin is still open."""
    process = sattools("info", stdin=subprocess.PIPE, stdout=subprocess.PIPE)
    process.stdin.write(line("a"))
    process.stdin.flush()
    assert process.stdout.readline().startswith("scene a ")
    process.stdin.close()
    assert process.wait() == 0
    process.stdout.close()


@pytest.mark.skipif(sys.platform == "win32", reason="a pipe cannot be asked there whether something has come")
@pytest.mark.parametrize(
    ("command", "module"), [("prior", "sattools.prior.matched"), ("compare", "sattools.compare.maps")]
)
def test_a_command_imports_while_the_one_before_it_works(command: str, module: str) -> None:
    """What `prep | prior | fit | export` takes has the start of one command in it, not of four."""
    process = subprocess.Popen(
        [sys.executable, "-X", "importtime", "-m", "sattools", command],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )
    assert process.stderr
    hanging = threading.Timer(HANGING_S, process.kill)
    hanging.start()
    imported = iter(lambda: process.stderr.readline().rpartition("|")[2].strip(), "")
    assert module in imported
    hanging.cancel()
    output, rest = process.communicate("", timeout=HANGING_S)
    assert (process.returncode, output) == (1, "")
    assert "found nothing, expected scene documents" in rest.splitlines()[-1]


def test_info_counts_errors_as_the_other_commands_do(line: Any) -> None:
    from sattools.cli import main

    assert CliRunner().invoke(main, ["info"], input="").exit_code == 1
    mixed = CliRunner().invoke(main, ["info"], input="{\n" + line("b"))
    assert mixed.exit_code == 3
    assert mixed.stdout.startswith("scene b ")
