"""Options: from the command line, from a TOML file, and printed."""

import os
import sys
import tomllib
from pathlib import Path
from typing import Any

import pytest
from click.testing import CliRunner

from sattools.cli import main, pipe
from sattools.fit.options import FitOptions


def run(*arguments: Any, text: Any = "") -> Any:
    return CliRunner().invoke(main, arguments, input=text)


def printed(*arguments: Any) -> Any:
    result = run("fit", *arguments, "--print-config")
    assert result.exit_code == 0, result.output
    return tomllib.loads(result.stdout)["fit"]


def test_print_config_shows_every_option_that_is_set() -> None:
    shown = printed("--seed", "7", "--no-pose", "--epochs", "5", "--epochs", "3")
    assert shown["seed"] == 7
    assert shown["pose"] is False
    assert shown["epochs"] == [5, 3]
    assert shown["loss"] == FitOptions().loss


def test_a_printed_configuration_is_one_that_can_be_given(tmp_path: Path) -> None:
    path = tmp_path / "fit.toml"
    first = run("fit", "--seed", "7", "--epochs", "5", "--no-pose", "--budget", "9.5", "--print-config").stdout
    path.write_text(first)
    assert run("fit", "--config", str(path), "--print-config").stdout == first


@pytest.mark.parametrize(
    "arguments",
    ["prep x.tif", "simulate", "normalise", "prior", "align", "fit", "export", "compare", "change a.tif b.tif"],
)
def test_what_a_command_prints_without_options_can_be_given_to_it(tmp_path: Path, arguments: str) -> None:
    path = tmp_path / "c.toml"
    first = run(*arguments.split(), "--print-config").stdout
    path.write_text(first)
    again = run(*arguments.split(), "--config", str(path), "--print-config")
    assert (again.exit_code, again.stdout) == (0, first)


@pytest.mark.parametrize("text", ["seed = 3", "[fit]\nseed = 3\n[export]\nvertical = 'egm96'"])
def test_options_come_from_the_top_level_or_the_commands_table(tmp_path: Path, text: Any) -> None:
    path = tmp_path / "c.toml"
    path.write_text(text)
    assert printed("--config", str(path))["seed"] == 3


def test_the_command_line_wins_over_the_file_wherever_it_stands(tmp_path: Path) -> None:
    path = tmp_path / "c.toml"
    path.write_text("seed = 3\nheight-rate = 0.2")
    for arguments in (["--config", str(path), "--seed", "4"], ["--seed", "4", "--config", str(path)]):
        shown = printed(*arguments)
        assert (shown["seed"], shown["height-rate"]) == (4, 0.2)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("sede = 3", "found option 'sede', which `sattools fit` does not have"),
        ("seed = -3", "-3 is not in the range x>=0"),
        ("loss = 'l1'", "'l1' is not one of"),
        ("seed = [", "found no valid TOML"),
    ],
)
def test_a_wrong_file_is_a_usage_error(tmp_path: Path, text: Any, words: Any) -> None:
    path = tmp_path / "c.toml"
    path.write_text(text)
    result = run("fit", "--config", str(path), "--print-config")
    assert result.exit_code == 2
    assert words in result.stderr.replace("\n", " ")
    assert result.stdout == ""


@pytest.mark.parametrize("bands", ["[5, 3, 2]", "['5', '3', '2']"])
def test_numbers_of_a_file_are_taken_where_an_option_takes_words_as_well(tmp_path: Path, bands: str) -> None:
    path = tmp_path / "c.toml"
    path.write_text(f"bands = {bands}\n")
    for command in ("normalise", "fit"):
        result = run(command, "--config", str(path), "--print-config")
        assert tomllib.loads(result.stdout)[command]["bands"] == ["5", "3", "2"]


def test_a_missing_file_is_a_usage_error(tmp_path: Path) -> None:
    result = run("fit", "--config", str(tmp_path / "none.toml"))
    assert result.exit_code == 2
    assert "none.toml" in result.stderr


@pytest.mark.parametrize(
    "arguments",
    [
        ["nonsense"],
        ["fit", "--nonsense"],
        ["fit", "--seed", "many"],
        ["fit", "--loss", "l1"],
        ["--threads", "0", "info"],
        ["--progress", "loud", "info"],
        ["simulate", "--views", "0"],
        ["prep"],
    ],
)
def test_wrong_usage_exits_with_2(arguments: Any) -> None:
    result = run(*arguments)
    assert result.exit_code == 2
    assert result.stdout == ""


def test_a_choice_under_its_former_name_works_and_says_its_present_one() -> None:
    result = run("fit", "--tile", "100", "--part", "join", "--print-config")
    assert result.exit_code == 0
    assert 'part = "mosaic"' in result.stdout
    assert "--part join is now called --part mosaic" in result.stderr
    assert "join" not in CliRunner().invoke(main, ["fit", "--help-all"]).stdout.split("--part")[1].split("--budget")[0]


@pytest.mark.parametrize(("call", "count"), [(("export", "--sun", "150,40"), 2), (("prep", "--bounds", "1,2,3,4"), 4)])
def test_numbers_that_belong_together_stand_apart(call: Any, count: int) -> None:
    result = run(*call, "a", "b", "c")
    assert result.exit_code == 2
    assert f"found '{call[-1]}', expected {count} numbers with blanks between them" in result.stderr


@pytest.mark.parametrize("number", ["nan", "inf", "99"])
def test_memory_is_a_number(number: str) -> None:
    result = run("info", "--max-memory", number)
    assert result.exit_code == 2
    assert result.stderr.splitlines()[-1].startswith("Error: Invalid value for '--max-memory'")


@pytest.mark.parametrize(
    ("arguments", "limit_gib"),
    [
        (["--max-memory", "2048", "fit"], 2.0),
        (["fit", "--max-memory", "2048"], 2.0),
        (["fit", "--memory", "2048"], 2.0),
        (["--max-memory", "4096", "fit", "--memory", "2048"], 2.0),  # what is said last
        (["--max-memory", "2048", "prior", "--memory", "300"], 2.0),  # `prior` has a --memory of its own
    ],
)
def test_memory_that_is_granted_is_what_a_command_has_and_no_later_one(
    make_town: Any, monkeypatch: pytest.MonkeyPatch, arguments: list[str], limit_gib: float
) -> None:
    from sattools.scene import memory

    seen: list[int | None] = []
    monkeypatch.setattr(memory.system, "memory_taken", lambda: 0)
    monkeypatch.setattr(pipe, "apply", lambda run, scene, work: (seen.append(memory.available()), sys.exit(7)))
    document = str(make_town().root / "scene.json")
    assert CliRunner().invoke(main, [*arguments, document]).exit_code == 7
    assert seen == [limit_gib * 2**30]
    assert memory.LIMIT not in os.environ


def test_memory_for_nothing_is_wrong_usage() -> None:
    result = CliRunner().invoke(main, ["--max-memory", "1", "info"])
    assert result.exit_code == 2
    assert "1.0 is not in the range x>=100" in result.stderr


@pytest.mark.parametrize(
    ("arguments", "told"),
    [
        (["export", "--products", "foo"], "--products: found 'foo', expected some of dsm"),
        (["export", "--sun", "120", "-40"], "--sun: found azimuth 120 and elevation -40"),
        (["fit", "--views", "foo"], "--views: found 'foo', expected all or nearest-nadir:N"),
        (["compare", "--region", "foo"], "--region: found 'foo', expected west, east, north, south or four numbers"),
        (
            ["compare", "--predicted", "a.tif"],
            "found no reference beside --predicted, expected --dsm FILE",
        ),
        (["compare", "--predicted", "a.tif", "--truth", "t"], "found --truth without a scene, expected --aoi NAME"),
        (["compare", "--dsm", "a.tif", "--truth", "t"], "found both --truth and --dsm, expected one of them"),
        (["compare", "--map", "x"], "--map: found 'x', expected NAME=FILE"),
        (["prep", "--crs", "foo", "a.tif"], "CRS 'foo': found none that is known"),
        (["normalise", "--scale", "abc"], "--scale: found 'abc', expected a positive number or a fraction"),
        (["normalise", "--scale", "0.1"], "--scale: found --quantity auto, expected toa_reflectance"),
        (["simulate", "--terrain", "natural", "--pan", "2"], "--pan: found natural ground, expected a city"),
        (["simulate", "--out", ""], "Invalid value for '--out': found an empty text, expected a file or folder"),
        (["change", "a.tif", "b.tif", "--out", ""], "Invalid value for '--out': found an empty text"),
        (["change", "", "b.tif"], "Invalid value for 'BEFORE': found an empty text, expected a file or folder"),
        (["compare", "--predicted", "a.tif", "--dsm", ""], "Invalid value for '--dsm': found an empty text"),
        (["batch", "--out", ""], "Invalid value for '--out': found an empty text"),
        (["report", "--out", ""], "Invalid value for '--out': found an empty text"),
        (["prep", "--out", "work", ""], "Invalid value for 'IMAGE...': found an empty text"),
        (["info", "--log-file", ""], "Invalid value for '--log-file': found an empty text"),
    ],
)
def test_what_the_command_line_alone_shows_to_be_wrong_is_wrong_usage(arguments: list[str], told: str) -> None:
    """Status 2, whatever scene would come: there is none here."""
    result = CliRunner().invoke(main, arguments)
    assert (result.exit_code, result.stdout) == (2, "")
    assert result.stderr.splitlines()[-1].startswith(f"Error: {told}")
