"""What a command writes beside its own outputs, or while others work, costs nobody a file."""

import shutil
import threading
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import rasterio
from click.testing import CliRunner

from sattools.cli import main
from sattools.cli.logfile import close_log
from sattools.progress import Progress
from sattools.runlog import NAME
from sattools.scene import Scene
from sattools.scene.files import locked, write_text
from sattools.scene.raster import read_raster, write_cog
from sattools.scene.runner import Step, run_first


def run(*arguments: Any, text: str | None = None) -> Any:
    return CliRunner().invoke(main, ["--threads", "1", *map(str, arguments)], input=text)


def contents(folder: Path) -> dict[str, bytes]:
    """Every file below a folder but the log, which tells of runs that failed, too."""
    files = [path for path in sorted(folder.rglob("*")) if path.is_file() and path.name != NAME]
    return {str(path.relative_to(folder)): path.read_bytes() for path in files}


def test_the_page_of_a_scene_does_not_replace_that_of_another(make_town: Any, tmp_path: Path) -> None:
    page = tmp_path / "page.html"
    text = "".join(make_town(name).to_json() + "\n" for name in ("FIRST", "SECOND"))
    result = run("report", "--out", page, "--overwrite", text=text)
    assert (result.exit_code, result.stdout) == (1, f"{page}\n")
    assert "page.html: the page of scene SECOND would replace that of the one before" in result.stderr
    assert "<title>Scene FIRST" in page.read_text()


def test_a_page_does_not_replace_the_document_that_it_shows(make_town: Any, tmp_path: Path) -> None:
    document = tmp_path / "kept.json"
    document.write_text(make_town().to_json())
    before = document.read_text()
    result = run("report", document, "--out", document, "--overwrite")
    assert result.exit_code == 1
    assert "kept.json: is an input too" in result.stderr
    assert document.read_text() == before


def test_a_scene_json_on_a_pipe_leaves_no_empty_page_in_another_folder(
    make_town: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    text = make_town().to_json(root=".")
    elsewhere = tmp_path / "elsewhere"
    elsewhere.mkdir()
    monkeypatch.chdir(elsewhere)
    result = run("report", text=text)
    assert (result.exit_code, result.stdout) == (1, "")
    assert f"found none of its files in {elsewhere}, the current folder" in result.stderr
    assert not list(elsewhere.iterdir())
    monkeypatch.chdir(tmp_path / "TOWN")
    assert run("report", text=text).exit_code == 0


@pytest.mark.parametrize("flags", [[], ["--overwrite"]])
def test_a_page_replaces_no_file_that_is_none(make_town: Any, tmp_path: Path, flags: list[str]) -> None:
    notes = tmp_path / "notes.txt"
    notes.write_text("mine")
    document = make_town().root / "scene.json"
    refused = run("report", document, "--out", notes, *flags)
    assert (refused.exit_code, refused.stdout, notes.read_text()) == (1, "", "mine")
    assert "notes.txt: found a file that is no report of sattools, expected a new name or a report" in refused.stderr
    notes.write_text("")  # as `mktemp` makes it: nothing is lost
    assert run("report", document, "--out", notes, "--overwrite").exit_code == 0


# ---- stages that are done on the way ------------------------------------------------------------------------------


def test_what_a_tile_of_the_contest_leads_to_is_not_exported_onto(make_town: Any, tmp_path: Path) -> None:
    """`compare` makes the export that a new fit has left behind: not onto the surface by which that is scored."""
    town = make_town()
    document, folder = town.root / "scene.json", tmp_path / "truth"
    quick = ["--resolution", "2", "--coarsest", "2", "--epochs", "2", "--prior-weight", "0"]
    assert run("fit", *quick, document).exit_code == 0
    assert run("export", document).exit_code == 0
    folder.mkdir()
    (folder / "TOWN_DSM.tif").symlink_to(town.root / "export/dsm.tif")
    for name in ("TOWN_DSM.txt", "TOWN_CLS.tif"):
        shutil.copy(town.root / "truth" / name, folder)
    assert run("fit", *quick, "--seed", "1", "--overwrite", document).exit_code == 0
    before = contents(town.root)
    result = run("compare", "--truth", folder, "--overwrite", document)
    assert result.exit_code == 1
    assert f"export/dsm.tif: is the input {folder}/TOWN_DSM.tif" in result.stderr
    assert contents(town.root) == before


@pytest.mark.parametrize("dry", [["--dry-run"], []])
def test_a_fit_makes_no_prior_onto_what_it_is_scored_by(make_town: Any, dry: list[str]) -> None:
    town = make_town()
    (town.root / "prior").mkdir()
    (town.root / "truth/TOWN_DSM.tif").rename(town.root / "prior/dsm.tif")
    del town.products["truth_dsm"]
    (town.root / "scene.json").write_text(town.to_json())
    before = contents(town.root)
    given = ["--reference", town.root / "prior/dsm.tif", "--overwrite", *dry]
    result = run("fit", "--resolution", "2", *given, town.root / "scene.json")
    assert result.exit_code == 1
    assert "prior/dsm.tif: is an input too" in result.stderr
    assert contents(town.root) == before


# ---- logs ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["scene.json", "images/TOWN_001.tif", "truth/TOWN_DSM.txt"])
def test_nothing_is_added_to_a_file_that_is_no_log(make_town: Any, name: str) -> None:
    town = make_town()
    before = contents(town.root)
    result = run("--log-file", town.root / name, "info", town.root / "scene.json")
    assert (result.exit_code, result.stdout) == (1, "")
    assert f"{name}: found a file that is no log, expected a new file, a log, or a name in .log" in result.stderr
    assert contents(town.root) == before


@pytest.mark.parametrize(
    ("name", "text"),
    [("run.log", "somebody's words\n"), ("run.txt", "2026-01-31 12:00:00,000 INFO\n"), ("run.txt", "")],
)
def test_a_log_goes_on_in_what_there_is_of_it(tmp_path: Path, name: str, text: str) -> None:
    (tmp_path / name).write_text(text)
    assert run("--log-file", tmp_path / name, "doctor").exit_code in (0, 1)
    close_log()
    found = (tmp_path / name).read_text()
    assert found.startswith(text)
    assert "INFO sattools.run: sattools" in found


# ---- batches ------------------------------------------------------------------------------------------------------


def batch(*arguments: Any) -> tuple[int, str]:
    """Exit code and messages of a batch that is refused, which its dry run is by the same words."""
    results = [run("batch", *arguments, *dry) for dry in (["--dry-run"], [])]
    lines = [[line for line in result.stderr.splitlines() if "error:" in line] for result in results]
    assert lines[0] == lines[1]
    return results[1].exit_code, lines[1][0]


@pytest.mark.parametrize("place", ["runs/default/TOWN/scene.json", "scenes/TOWN.json"])
def test_a_batch_asks_before_it_replaces_a_scene_that_it_has_not_made(
    make_town: Any, tmp_path: Path, place: str
) -> None:
    town, out = make_town(), tmp_path / "work"
    (out / place).parent.mkdir(parents=True)
    (out / place).write_text("somebody's")
    code, said = batch(town.root / "scene.json", "--out", out)
    assert code == 1
    assert f"{place}: exists already; give --overwrite to replace it" in said
    assert contents(out) == {place: b"somebody's"}


@pytest.mark.parametrize("flags", [[], ["--overwrite"]])
def test_a_batch_never_runs_in_the_folder_of_a_scene_that_it_is_given(
    make_town: Any, tmp_path: Path, flags: list[str]
) -> None:
    town, out = make_town(), tmp_path / "work"
    (out / "runs/default").mkdir(parents=True)
    town.root.rename(out / "runs/default/TOWN")
    before = contents(out)
    code, said = batch(out / "runs/default/TOWN/scene.json", "--out", out, *flags)
    assert code == 1
    assert "runs/default/TOWN/scene.json: is an input too" in said
    assert contents(out) == before


@pytest.mark.parametrize(
    ("place", "why"),
    [
        ("runs/rough/TOWN/export/dsm.tif", "which this batch writes, expected a reference in another place"),
        ("joined/fine/dsm.tif", "is an input too"),
    ],
)
def test_a_batch_replaces_no_reference_of_its_own(make_town: Any, tmp_path: Path, place: str, why: str) -> None:
    """The surface of one configuration as the reference of another, and the joined one as that of the next batch."""
    town, out = make_town(), tmp_path / "work"
    (out / place).parent.mkdir(parents=True)
    shutil.copy(town.root / "truth/TOWN_DSM.tif", out / place)
    (tmp_path / "rough.toml").write_text("[fit]\nseed = 1\n")
    (tmp_path / "fine.toml").write_text(f"[compare]\ndsm = '{out / place}'\n")
    before = (out / place).read_bytes()
    given = ["--config", tmp_path / "rough.toml", "--config", tmp_path / "fine.toml", "--overwrite", "--join"]
    code, said = batch(town.root / "scene.json", "--out", out, *given)
    assert code == 1
    assert f"{out / place}: " in said
    assert why in said
    assert (out / place).read_bytes() == before


# ---- two at a time ------------------------------------------------------------------------------------------------


def test_a_scene_is_not_made_anew_under_a_command_that_works_on_it(make_town: Any) -> None:
    """Else `fit` would note that it was made of images that came while it ran."""
    town = make_town()

    def make(progress: Progress) -> tuple[Scene, None]:
        write_text(town.output("images/TOWN_001.tif"), "new")
        made.set()
        return Scene(town.id, town.root), None

    made, before = threading.Event(), contents(town.root)
    again = threading.Thread(target=lambda: run_first(Step("prep", overwrite=True), make))
    with locked(town.root):
        again.start()
        assert made.wait(60)
        again.join(0.3)
        assert again.is_alive()
        assert {name: text for name, text in contents(town.root).items() if "tmp-sattools" not in name} == before
    again.join(60)
    assert (town.root / "images/TOWN_001.tif").read_text() == "new"


# ---- another tool's surface ---------------------------------------------------------------------------------------


def test_another_tools_surface_is_fitted_from_where_no_prior_has_run(make_town: Any) -> None:
    town = make_town()
    heights, grid = read_raster(town.path("truth/TOWN_DSM.tif"))
    write_cog(town.root / "theirs.tif", heights, grid)
    write_cog(town.root / "trust.tif", np.full(grid.shape, 0.9, np.float32), grid)
    town.products |= {"prior_dsm": "theirs.tif", "prior_confidence": "trust.tif"}
    town.write()
    document = town.root / "scene.json"
    done = run("fit", "--resolution", "2", "--coarsest", "2", "--epochs", "2", document)
    assert done.exit_code == 0, done.stderr
    assert not (town.root / "prior").exists()
    assert Scene.from_file(document).products["prior_dsm"] == "theirs.tif"


def test_another_surface_in_place_of_a_priors_is_refused_with_the_way_to_use_it(make_town: Any) -> None:
    town = make_town()
    document = town.root / "scene.json"
    assert run("prior", "--resolution", "2", document).exit_code == 0
    shutil.copy(town.path("truth/TOWN_DSM.tif"), town.root / "prior/dsm.tif")
    refused = run("fit", "--resolution", "2", "--coarsest", "2", "--epochs", "2", document)
    assert (refused.exit_code, refused.stdout) == (1, "")
    assert "found another file for prior_dsm than the history knows" in refused.stderr
    assert "named as prior_dsm, with prior_confidence, in a document from before `prior`" in refused.stderr


@pytest.mark.parametrize("copy", ["--copy", "--no-copy"])
def test_an_image_replaced_between_prep_and_the_next_step_is_told(
    make_town: Any, tmp_path: Path, caplog: pytest.LogCaptureFixture, copy: str
) -> None:
    town = make_town()
    images = sorted((town.root / "images").glob("*.tif"))
    assert (
        run("prep", *images, "--metadata", town.root / "metadata", copy, "--id", "P", "--out", tmp_path).exit_code == 0
    )
    document = tmp_path / "P/scene.json"
    read = Scene.from_file(document)
    assert run("normalise", document).exit_code == 0
    assert "not the image any more" not in caplog.text
    first = read.path(read.items[0].assets["image"].href)
    with rasterio.open(first, "r+") as data:
        data.write(np.ascontiguousarray(data.read()[:, ::-1]))
    assert run("normalise", "--overwrite", document).exit_code == 0
    assert f"{first} is not the image any more that prep has found the camera of" in caplog.text
