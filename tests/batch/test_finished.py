"""What counts as finished in a folder of a batch, and what its log says."""

import json
import shutil
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from sattools.batch.configuration import Configuration
from sattools.batch.options import BatchOptions
from sattools.batch.plan import Task
from sattools.batch.queue import make_plan
from sattools.batch.stage import batch
from sattools.batch.task import perform
from sattools.errors import SattoolsError
from sattools.scene import Scene
from sattools.scene.copies import in_another_root
from sattools.scene.location import remote_allowed

DEFAULT = Configuration("default")


def finished(scene: Any, out: Path) -> Task:
    """The run of a scene, with the record and the surface that it leaves."""
    (job,) = make_plan(BatchOptions(out=str(out)), [scene], [DEFAULT]).jobs
    document = job.task.start()
    content = json.loads(document.read_text())
    content["sattools"]["products"]["dsm"] = "export/dsm.tif"
    document.write_text(json.dumps(content))
    (document.parent / "export").mkdir()
    (document.parent / "export/dsm.tif").write_bytes(b"heights")
    done = {"key": job.task.key, "status": "done", "scene_json": str(document), "row": {"scene": "A"}}
    job.task.record.write_text(json.dumps(done))
    return job.task


def test_a_copied_folder_has_results_of_its_own(make_town: Any, tmp_path: Path) -> None:
    scene = make_town("A")
    finished(scene, tmp_path / "out")
    shutil.copytree(tmp_path / "out", tmp_path / "copy")
    for folder in ("copy", "out"):
        plan = make_plan(BatchOptions(out=str(tmp_path / folder)), [scene], [DEFAULT])
        assert plan.jobs == []
        document = tmp_path / folder / "runs/default/A/scene.json"
        assert plan.results["A", "default"]["scene_json"] == str(document)


def test_a_folder_that_was_moved_keeps_its_results(make_town: Any, tmp_path: Path) -> None:
    scene = make_town("A")
    finished(scene, tmp_path / "out")
    (tmp_path / "out").rename(tmp_path / "moved")
    plan = make_plan(BatchOptions(out=str(tmp_path / "moved")), [scene], [DEFAULT])
    assert (plan.jobs, list(plan.results)) == ([], [("A", "default")])


def test_what_cannot_be_begun_anew_stays_finished(make_town: Any, tmp_path: Path) -> None:
    scene = make_town("A")
    task = finished(scene, tmp_path / "out")
    options = BatchOptions(out=str(tmp_path / "out"), scheduler="nonsense")
    with pytest.raises(SattoolsError, match=r"--scheduler nonsense: found no Dask scheduler"):
        batch(options, [scene], [DEFAULT], 1, overwrite=True)
    assert task.record.exists()
    assert make_plan(options, [scene], [DEFAULT]).jobs == []


def test_what_a_run_has_from_a_shared_prior_goes_along_when_the_folder_is_moved(make_town: Any, tmp_path: Path) -> None:
    scene = make_town("A")
    out = tmp_path / "out"
    pair = [Configuration(name, {}, {"fit": {"epochs": [epochs]}}) for name, epochs in (("a", 8), ("b", 9))]
    shared, *runs = (job.task for job in make_plan(BatchOptions(out=str(out)), [scene], pair).jobs)
    document = shared.start()
    content = json.loads(document.read_text())
    content["sattools"]["products"]["prior_dsm"] = "prior/dsm.tif"
    document.write_text(json.dumps(content))
    (document.parent / "prior").mkdir()
    (document.parent / "prior/dsm.tif").write_bytes(b"heights")
    shared.record.write_text(json.dumps({"key": shared.key, "status": "done", "scene_json": "A"}))
    for run in runs:
        hrefs = Scene.from_file(run.start()).products
        assert hrefs["prior_dsm"] == "prior/dsm.tif"
        assert hrefs["truth_dsm"] == str(scene.path(scene.products["truth_dsm"]))  # beyond the batch's folder
        run.record.write_text(json.dumps({"key": run.key, "status": "done", "scene_json": "A", "row": {"scene": "A"}}))
    out.rename(tmp_path / "moved")
    plan = make_plan(BatchOptions(out=str(tmp_path / "moved")), [scene], pair)
    assert (plan.jobs, sorted(plan.results)) == ([], [("A", "a"), ("A", "b")])
    assert (tmp_path / "moved/runs/a/A/prior/dsm.tif").read_bytes() == b"heights"


def test_without_hard_links_runs_read_what_they_share_where_it_is(
    make_town: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def none(*_: Any) -> None:
        raise PermissionError(1, "Operation not permitted")  # as exFAT says

    monkeypatch.setattr(Path, "hardlink_to", none)
    scene = make_town("A")
    copy = in_another_root(scene.root / "scene.json", tmp_path / "run", tmp_path)
    assert Scene.from_file(copy).products["truth_dsm"] == str(scene.path(scene.products["truth_dsm"]))


def test_a_result_of_which_a_file_is_gone_is_made_again(make_town: Any, tmp_path: Path) -> None:
    scene = make_town("A")
    task = finished(scene, tmp_path / "out")
    shutil.copytree(tmp_path / "out", tmp_path / "copy")
    (tmp_path / "copy/runs/default/A/export/dsm.tif").unlink()
    jobs = make_plan(BatchOptions(out=str(tmp_path / "copy")), [scene], [DEFAULT]).jobs
    assert [job.task.key for job in jobs] == [task.key]


def test_files_on_other_machines_are_not_asked_for(make_town: Any, tmp_path: Path) -> None:
    scene = make_town("A")
    task = finished(scene, tmp_path / "out")
    content = json.loads(task.document.read_text())
    content["features"][0]["assets"]["thumbnail"] = {"href": "https://example.invalid/A.png"}
    task.document.write_text(json.dumps(content))
    with remote_allowed():
        assert make_plan(BatchOptions(out=str(tmp_path / "out")), [scene], [DEFAULT]).jobs == []


def test_the_log_has_commands_that_a_shell_takes(make_town: Any, tmp_path: Path) -> None:
    task = finished(make_town("A"), tmp_path / "many areas")
    task.record.unlink()
    calls = []

    def run(call: list[str], *_: Any) -> Any:
        calls.append(call)
        yield 1  # the first one fails, at once

    launcher: Any = SimpleNamespace(run=run)
    assert perform(task, 1, None, lambda *_: None, launcher=launcher)["status"] == "failed"
    assert [call[3:5] for call in calls] == [["1", "fit"]]
    folder = tmp_path / "many areas/runs/default/A"
    line = (
        f"$ sattools --progress json --threads 1 fit '{folder}/scene.json' --overwrite --config '{folder}/config.toml'"
    )
    assert (folder / "log.txt").read_text() == f"{line}\n"
