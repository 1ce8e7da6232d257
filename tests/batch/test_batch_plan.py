"""What a batch plans: keys that follow the inputs, the contest's layout, and errors before anything is computed."""

import json
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from click.testing import CliRunner
from planned import DEFAULT, contest, keys
from unread import Unread

from sattools.batch import cluster
from sattools.batch.cluster import Shares, shares
from sattools.batch.configuration import Configuration
from sattools.batch.options import BatchOptions
from sattools.batch.plan import Task, pilot_tasks
from sattools.batch.queue import make_plan
from sattools.cli import main
from sattools.prep.dfc2019 import find_images, find_truth
from sattools.scene import memory
from sattools.scene.raster import write_cog


def finish(task: Task) -> None:
    """Leave what a finished task leaves; its scene's document names what that of its source does."""
    document = task.start()
    done = {"key": task.key, "status": "done", "scene_json": str(document), "row": {}}
    task.record.write_text(json.dumps(done))


def test_the_contests_folders_are_searched_and_no_image_is_found_twice(tmp_path: Path) -> None:
    root = contest(tmp_path)
    names = {kind: [p.parent.name for p in find_images(root, "JAX_068", kind)[0]] for kind in ("auto", "crops", "rgb")}
    assert names == {"auto": ["JAX_068"], "crops": ["JAX_068"], "rgb": ["Track3-RGB-3"]}
    assert [p.name for p in find_images(root, "JAX_004")[0]] == ["JAX_004_006_RGB.tif", "JAX_004_007_RGB.tif"]
    assert [p.name for p in find_images(root, "JAX_004", "msi")[0]] == ["JAX_004_006_MSI.tif"]
    assert find_truth(root, "JAX_004") == root / "Track3-Truth"
    assert find_truth(root, "JAX_070") is None


def test_missing_areas_are_named_and_the_others_planned(tmp_path: Path) -> None:
    options = BatchOptions(
        out=str(tmp_path / "out"), dfc2019=str(contest(tmp_path / "data")), aoi=["JAX_070", "JAX_999", "OMA_001"]
    )
    plan = make_plan(options, [], [DEFAULT])
    assert [job.task.name for job in plan.jobs] == ["JAX_070/prep", "JAX_070/default"]
    assert {pair: kind for pair, (kind, _) in plan.errors.items()} == {
        ("JAX_999", "default"): "missing",
        ("OMA_001", "default"): "missing",
    }
    assert "images of JAX_999" in plan.errors["JAX_999", "default"][1]


def test_the_contests_tiles_are_cut_to_the_area_that_is_scored(tmp_path: Path) -> None:
    from sattools.scene import Grid

    root = contest(tmp_path / "data")
    grid = Grid("EPSG:32617", 435525.0, 3354400.0, 0.5, 8, 8)
    for name in ("DSM", "CLS_v2"):
        # overwritten by real rasters, with the sidecar of the contest
        (root / f"Track3-Truth/JAX_004_{name}.tif").unlink(missing_ok=True)
        write_cog(root / f"Track3-Truth/JAX_004_{name}.tif", np.full((1, 8, 8), 2.0, np.float32), grid)
    (root / "Track3-Truth/JAX_004_DSM.txt").write_text("435525.0\n3354396.0\n8\n0.5\n")
    options = BatchOptions(out=str(tmp_path / "out"), dfc2019=str(root), aoi=["JAX_004"])
    prep, fit = (job.task for job in make_plan(options, [], [DEFAULT]).jobs)
    at = prep.commands[0].index("--bounds")
    assert prep.commands[0][at + 1 : at + 7] == [
        *("435525.000", "3354396.000", "435529.000", "3354400.000"),
        *("--crs", "EPSG:32617"),
    ]
    assert fit.commands[-1] == ["compare", "{scene}", "--overwrite", "--truth", str(root / "Track3-Truth")]


def test_scores_that_are_asked_for_and_cannot_be_had_are_told(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    options = BatchOptions(out=str(tmp_path / "out"), dfc2019=str(contest(tmp_path / "data")), aoi=["JAX_070"])
    asks = Configuration("asks", {"compare": {"views": True}}, {"prep": {}, "fit": {}, "compare": {"views": True}})
    last = make_plan(options, [], [asks]).jobs[-1].task
    assert last.commands[-1][0] == "export"
    assert "asks: found no reference of scene JAX_070, [compare] is left out" in caplog.text
    caplog.clear()
    make_plan(options, [], [DEFAULT])
    assert "no reference" not in caplog.text


def test_configurations_that_prepare_alike_share_the_prepared_scene_and_its_prior(tmp_path: Path) -> None:
    options = BatchOptions(out=str(tmp_path / "out"), dfc2019=str(contest(tmp_path / "data")), aoi=["JAX_070"])
    fast = Configuration("fast", {"fit": {"epochs": [2]}}, {"prep": {"correction": "auto"}, "fit": {"epochs": [2]}})
    slow = Configuration("slow", {}, {"prep": {"correction": "auto"}, "fit": {"epochs": [9]}})
    shift = Configuration("shift", {}, {"prep": {"correction": "shift"}, "fit": {"epochs": [9]}})
    jobs = make_plan(options, [], [fast, slow, shift]).jobs
    names = [job.task.name for job in jobs]
    assert names == [
        *("JAX_070/prep", "JAX_070: prior", "JAX_070/fast", "JAX_070/slow", "JAX_070/prep", "JAX_070/shift")
    ]
    assert [job.after for job in jobs] == [(), (jobs[0],), (jobs[1],), (jobs[1],), (), (jobs[4],)]
    assert [c[0] for c in jobs[1].task.commands] == ["prior"]
    assert jobs[2].task.source == f"{jobs[1].task.folder}/scene.json"
    # the prior must not see an image that is held out, so that this fit makes its own
    held = Configuration("held", {}, {"prep": {"correction": "auto"}, "fit": {"holdout": ["JAX_070_001_RGB"]}})
    names = [job.task.name for job in make_plan(options, [], [fast, held]).jobs]
    assert names == ["JAX_070/prep", "JAX_070/fast", "JAX_070/held"]
    # nor is anything shared by one alone
    assert [job.task.name for job in make_plan(options, [], [fast]).jobs] == ["JAX_070/prep", "JAX_070/fast"]


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("[fit]\nsede = 3", "found option 'sede', which `sattools fit` does not have"),
        ("[fit]\nseed = -3", "-3 is not in the range x>=0"),
        ("[train]\nseed = 3", "found the table [train], expected one named like a command"),
        ("seed = 3", "found 'seed', expected the tables"),
        ("[fit", "found no valid TOML"),
    ],
)
def test_a_wrong_configuration_ends_the_batch_before_it_starts(tmp_path: Path, text: Any, words: Any) -> None:
    (tmp_path / "c.toml").write_text(text)
    result = CliRunner().invoke(main, ["batch", "scene.json", "--config", str(tmp_path / "c.toml")])
    assert result.exit_code == 2
    assert words in " ".join(result.stderr.split())
    assert " batch [OPTIONS] [SCENE]..." in result.stderr


def test_a_dry_run_says_what_the_batch_would_say(make_town: Any, tmp_path: Path) -> None:
    scene = make_town("A")
    (tmp_path / "näme.toml").write_text("[fit]\nseed = 3")
    out = ["--out", str(tmp_path / "out"), "--dry-run"]
    result = CliRunner().invoke(main, ["batch", *out, "--config", str(tmp_path / "näme.toml")], input=scene.to_json())
    assert (result.exit_code, result.stdout) == (1, "")
    assert result.stderr.startswith("sattools batch: error: --config: found id 'näme', expected 1-128 letters")
    scene.path(scene.items[0].assets["image"].href).unlink()
    result = CliRunner().invoke(main, ["batch", *out], input=scene.to_json())
    assert result.exit_code == 1
    assert "sattools batch: error: A/default: " in result.stderr
    assert not (tmp_path / "out").exists()


def dry_batch(*arguments: Any, text: str = "") -> Any:
    return CliRunner().invoke(main, ["batch", *map(str, arguments), "--dry-run"], input=text)


@pytest.mark.parametrize(
    ("place", "options", "why"),
    [
        ("out", [], "out: cannot be written to, expected a writable folder for table.csv"),
        ("out/table.csv", [], "table.csv: exists already; give --overwrite to replace it"),
        ("out/joined", ["--join"], "joined: cannot be written to, expected a writable folder for dsm.tif"),
        ("out/scenes", [], "scenes: cannot be written to, expected a writable folder for A.json"),
        ("out/runs", [], "runs: cannot be written to, expected a writable folder for task.json"),
    ],
)
def test_a_batch_and_its_dry_run_refuse_a_folder_with_something_else_in_it(
    make_town: Any, tmp_path: Path, place: str, options: list[str], why: str
) -> None:
    path, document = tmp_path / place, make_town("A").root / "scene.json"
    path.parent.mkdir(exist_ok=True)
    path.write_text("somebody's")
    given = [str(document), "--out", str(tmp_path / "out"), *options]
    for found in (dry_batch(*given), CliRunner().invoke(main, ["batch", *given])):
        assert (found.exit_code, found.stdout) == (1, "")
        assert why in found.stderr
    assert path.read_text() == "somebody's"


def test_a_dry_run_looks_for_what_its_tasks_would_run_on(
    make_town: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    given = [make_town("A").root / "scene.json", "--out", tmp_path / "out"]
    monkeypatch.setattr(cluster, "_gpus", list)
    assert "--gpu: found no GPU by nvidia-smi" in dry_batch(*given, "--gpu").stderr
    assert "--scheduler nonsense: found no Dask scheduler" in dry_batch(*given, "--scheduler", "nonsense").stderr
    monkeypatch.setattr(cluster, "find_spec", lambda name: None)
    assert "found no Dask, expected the extra" in dry_batch(*given).stderr


@pytest.mark.parametrize(
    ("options", "why"),
    [
        (["--scheduler", "tcp://nowhere.invalid:8786"], "batch: found no Dask, expected the extra"),
        (["--gpu"], "--gpu: found no GPU by nvidia-smi"),
        (["--out", "file", "--join"], "file: cannot be written to, expected a writable folder for table.csv"),
    ],
    ids=["Dask", "GPU", "folder"],
)
@pytest.mark.parametrize("dry", [[], ["--dry-run"]])
def test_what_is_in_the_way_of_any_scene_is_told_before_those_of_a_pipe_come(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, options: list[str], why: str, dry: list[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("file").touch()
    monkeypatch.setattr(cluster, "_gpus", list)
    monkeypatch.setattr(cluster, "find_spec", lambda name: None)
    result = CliRunner().invoke(main, ["batch", *options, *dry], input=Unread())
    assert (result.exit_code, result.stdout) == (1, "")
    assert why in result.stderr


def test_a_scheduler_may_come_as_late_as_the_scenes_of_a_pipe(tmp_path: Path) -> None:
    given = ["--scheduler", "nonsense", "--out", str(tmp_path / "out")]
    result = CliRunner().invoke(main, ["batch", *given], input=b"")
    assert "expected scenes, or --dfc2019 ROOT --aoi AREA" in result.stderr
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("text", "why"),
    [
        ("[prior]\nresolution = 100.0", "sattools prior: error: grid: found 1 x 1 cells of 100 m"),
        ("[fit]\nholdout = ['nobody']", "sattools fit: error: scene A: found no item 'nobody' to hold out"),
        ("[fit]\npreset = 'rpv-nerf'\nbrdf = 'hapke'", "sattools fit: error: --brdf hapke: network rpv has no head"),
        ("[fit]\ntile = 32.0\noverlap = 8.0\nbrdf = 'rpv'", "sattools fit: error: --tile: found --brdf rpv"),
        ("[export]\nview = ['nobody']", "sattools export: error: scene A: found no item 'nobody'"),
        (f"[align]\nto = '{__file__}'", f"sattools align: error: {__file__}: "),
        ("[compare]\ntruth = 'nowhere'", f"sattools compare: error: {Path.cwd() / 'nowhere'}: no such folder"),
    ],
)
def test_a_dry_run_says_what_a_command_would_refuse_at_its_start(
    make_town: Any, tmp_path: Path, text: str, why: str
) -> None:
    scene = make_town("A")
    before = sorted(tmp_path.rglob("*"))
    (tmp_path / "good.toml").write_text("[fit]\nseed = 3")
    (tmp_path / "bad.toml").write_text(text)
    configs = [f"--config={tmp_path / name}" for name in ("bad.toml", "good.toml")]
    result = dry_batch(*configs, "--out", tmp_path / "out", text=scene.to_json())
    *planned, refused = result.stderr.splitlines()
    assert refused.startswith(f"sattools batch: error: A/bad: {why}")
    # after the prior that both would have shared, if it was to be made
    assert planned[-1].startswith("sattools batch: would do A/good in ")
    assert "A/bad" not in " ".join(planned)
    assert (result.exit_code, result.stdout) == (3, "")
    assert sorted(set(tmp_path.rglob("*")) - set(before)) == [tmp_path / "bad.toml", tmp_path / "good.toml"]


def test_a_dry_run_looks_at_an_areas_images(tmp_path: Path) -> None:
    images = tmp_path / "Track3-RGB-1"
    images.mkdir()
    for number in range(3):
        (images / f"JAX_004_{number:03d}_RGB.tif").write_text("no image")
    result = dry_batch("--dfc2019", tmp_path, "--aoi", "JAX_004", "--out", tmp_path / "out")
    assert (result.exit_code, result.stdout) == (1, "")
    (line,) = result.stderr.splitlines()
    assert line.startswith("sattools batch: error: JAX_004/default: sattools prep: error: ")
    assert "JAX_004_000_RGB.tif: found no readable image" in line


def test_with_overwrite_a_plan_has_what_is_done_and_a_dry_run_leaves_it(make_town: Any, tmp_path: Path) -> None:
    scene, options = make_town("A"), BatchOptions(out=str(tmp_path / "out"))
    (job,) = make_plan(options, [scene], [DEFAULT]).jobs
    finish(job.task)
    assert make_plan(options, [scene], [DEFAULT], dry_run=True).jobs == []
    assert make_plan(options, [scene], [DEFAULT], overwrite=True, dry_run=True).jobs == [job]
    assert job.task.record.exists()
    plan = make_plan(options, [scene], [DEFAULT], overwrite=True)
    assert (plan.jobs, job.task.record.exists()) == ([job], True)
    plan.forget()
    assert not job.task.record.exists()


def test_areas_need_the_contests_root(tmp_path: Path) -> None:
    result = CliRunner().invoke(main, ["batch", "--aoi", "JAX_004", "--out", str(tmp_path)], input="")
    assert result.exit_code == 1
    assert "found no --dfc2019" in result.stderr


def test_a_table_align_moves_every_scene_and_its_reference_counts(town_source: Any, tmp_path: Path) -> None:
    grid = town_source.require_grid()
    write_cog(tmp_path / "dem.tif", np.zeros(grid.shape, np.float32), grid)
    tables = {"align": {"to": str(tmp_path / "dem.tif")}}
    plain, aligned = DEFAULT, Configuration("aligned", tables, tables)
    plan = make_plan(BatchOptions(out=str(tmp_path / "out")), [town_source], [plain, aligned])
    named = {job.task.configuration: [command[0] for command in job.task.commands] for job in plan.jobs}
    assert "align" not in named["default"]
    assert named["aligned"][named["aligned"].index("export") + 1] == "align"
    before = keys(tmp_path, town_source, aligned)
    write_cog(tmp_path / "dem.tif", np.ones(grid.shape, np.float32), grid)
    assert keys(tmp_path, town_source, aligned) != before


def test_pilot_tiles_are_tasks_before_the_split(tmp_path: Path) -> None:
    run = Task(
        "A/cut", str(tmp_path), "key", "A", "cut", str(tmp_path), [["fit", "{scene}"]], "", str(tmp_path / "A.json")
    )
    coarse = replace(run, key="coarse", kind="coarse")
    (tmp_path / "fit/tiles").mkdir(parents=True)
    (tmp_path / "fit/tiles/tiles.json").write_text('{"pilots": ["pilot.r1c1", "pilot.r1c3"], "tiles": null}')
    pilots, split = pilot_tasks(run, coarse)
    assert [task.folder for task in pilots] == [str(tmp_path / f"fit/tiles/pilot.{name}") for name in ("r1c1", "r1c3")]
    assert [task.commands for task in pilots] == 2 * [[["fit", "{scene}", "--overwrite"]]]
    assert split.commands == [["fit", "{scene}", "--overwrite", "--resume", "--part", "split"]]
    assert split.source == str(tmp_path / "scene.json")
    assert len({task.key for task in (coarse, split, *pilots)}) == 4
    assert {task.record.name for task in (coarse, split, *pilots)} == {"coarse.json", "split.json", "task.json"}


@pytest.mark.parametrize(
    ("given", "cores", "gb", "runs", "tiled", "expected"),
    [
        # workers, threads of a tile, threads of what only other runs are beside
        ({}, 8, 64, 20, False, (8, 1, 1)),
        ({}, 8, 64, 2, False, (2, 4, 4)),  # what is left of the cores goes to threads
        ({}, 8, 64, 1, True, (8, 1, 8)),  # the coarse fit is alone, its tiles are not
        ({}, 8, 64, 2, True, (8, 1, 4)),
        ({}, 8, 16, 20, False, (4, 2, 2)),  # 3500 MB each
        ({}, 2, 2, 20, True, (1, 2, 2)),
        ({"workers": 3}, 8, 64, 20, False, (3, 2, 2)),
        ({"task_threads": 2}, 8, 64, 20, True, (8, 2, 2)),
        ({"memory_limit": 16000.0}, 8, 64, 20, True, (3, 2, 2)),
    ],
)
def test_cores_go_to_as_many_tasks_as_there_are_and_memory_allows(
    given: Any, cores: int, gb: int, runs: int, tiled: bool, expected: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    psutil = pytest.importorskip("psutil", reason="needs the extra `batch`")
    monkeypatch.setattr(psutil, "virtual_memory", lambda: SimpleNamespace(total=gb * 10**9))
    monkeypatch.setattr(memory, "group_files", lambda *_: [])
    found = shares(BatchOptions(**given), cores, runs, tiled)
    assert (found.workers, found.threads, found.alone) == expected
    assert found.memory_mb == given.get("memory_limit", pytest.approx(gb * 10**9 / 2**20 / found.workers))


@pytest.mark.parametrize(("given", "each"), [({}, 4000), ({"workers": 4}, 2000), ({"memory_limit": 900.0}, 900)])
def test_what_the_user_grants_is_for_all_tasks_together(
    given: Any, each: float, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """So is what a container may take of its machine's memory."""
    psutil = pytest.importorskip("psutil", reason="needs the extra `batch`")
    monkeypatch.setattr(psutil, "virtual_memory", lambda: SimpleNamespace(total=64 * 10**9))
    with memory.limited(8000.0):
        assert shares(BatchOptions(**given), 2, 20, False).memory_mb == each
    (tmp_path / "memory.max").write_text(f"{8000 * 2**20}\n")
    monkeypatch.setattr(memory, "group_files", lambda *_: [tmp_path / "memory.max"])
    assert shares(BatchOptions(**given), 2, 20, False).memory_mb == each


def test_only_tiles_have_as_many_beside_them_as_there_are_workers() -> None:
    found = Shares(8, 1, 4, None)
    tasks = [
        Task("A", "a", "k", "A", "c", "", [], "", kind=kind) for kind in ("prep", "coarse", "split", "tile", "run")
    ]
    assert [found.threads_of(task) for task in tasks] == [4, 4, 4, 1, 4]
