"""The recipes for clusters do what a fit in tiles does on one machine."""

import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
import torch
import yaml
from patience import HANGING_S

from sattools.fit.checkpoint import load
from sattools.fit.options import FitOptions
from sattools.fit.stage import fit

FOLDER = Path(__file__).parents[1] / "examples/cluster"
OPTIONS = ["--tile", "32", "--overlap", "8", "--resolution", "2", "--coarsest", "2", "--prior-weight", "0"]


def run(script: str, *arguments: str, **environment: str) -> subprocess.CompletedProcess[str]:
    sattools = str(Path(sys.executable).parent / "sattools")
    return subprocess.run(
        ["sh", str(FOLDER / script), *arguments],
        env={**os.environ, "SATTOOLS": sattools, **environment},
        capture_output=True,
        text=True,
        timeout=HANGING_S,
    )


def stand_in(program: Path, text: str) -> None:
    """Write a program in Python that is run in another one's place."""
    program.parent.mkdir()
    program.write_text(f"#!{sys.executable}\n{text}")
    program.chmod(0o755)


@pytest.fixture
def scheduler(tmp_path: Path) -> Path:
    """A stand-in for `sbatch` that runs jobs where it is called, and keeps their command lines."""
    program = tmp_path / "bin/sbatch"
    stand_in(
        program,
        "import os, subprocess, sys\n"
        f"open({str(tmp_path / 'calls')!r}, 'a').write('\\t'.join(sys.argv[1:]) + '\\n')\n"
        "array = next((a.split('=')[1] for a in sys.argv if a.startswith('--array=')), None)\n"
        "command = sys.argv[sys.argv.index('--wrap') + 1]\n"
        "first, last = map(int, array.split('-')) if array else (0, 0)\n"
        "for k in range(first, last + 1):\n"
        "    more = {'SLURM_ARRAY_TASK_ID': str(k)} if array else {}\n"
        "    subprocess.run(command, shell=True, check=True, env={**os.environ, **more})\n"
        "print(os.environ.get('JOB', '41'))\n",
    )
    (tmp_path / "bin/sattools").symlink_to(Path(sys.executable).parent / "sattools")
    return program.parent


@pytest.mark.slow
def test_a_slurm_cluster_makes_what_one_machine_makes(make_town: Any, scheduler: Path, tmp_path: Path) -> None:
    alone, spread = make_town("ALONE"), make_town("SPREAD")
    fit(alone, FitOptions(tile=32.0, overlap=8.0, resolution=2.0, coarsest=2.0, prior_weight=0.0))
    path = str(spread.root / "scene.json")
    done = run("slurm.sh", path, *OPTIONS, PATH=f"{scheduler}:{os.environ['PATH']}")
    assert done.returncode == 0, done.stderr
    calls = [line.split("\t") for line in (tmp_path / "calls").read_text().splitlines()]
    assert [next(a for a in call if a.startswith("--job-name")) for call in calls] == [
        "--job-name=split", "--job-name=tiles", "--job-name=mosaic",
    ]  # fmt: skip
    assert "--array=0-3" in calls[1]
    assert "--dependency=afterok:41" in calls[2]
    one, other = (load(scene.root / "fit/model.safetensors")[0] for scene in (alone, spread))
    assert {name: torch.equal(t, other[name]) for name, t in one.items()} == dict.fromkeys(one, True)
    assert "dsm" in json.loads((spread.root / "scene.json").read_text())["sattools"]["products"]


@pytest.fixture
def recorder(tmp_path: Path) -> Path:
    """A stand-in for `sattools` that does nothing, and keeps its arguments, a line of JSON a call."""
    program = tmp_path / "our own/sattools"
    kept = str(tmp_path / "did")
    stand_in(program, f"import json, sys\nprint(json.dumps(sys.argv[1:]), file=open({kept!r}, 'a'))\n")
    return program


def calls_of(recorder: Path) -> list[list[str]]:
    return [json.loads(line) for line in (recorder.parents[1] / "did").read_text().splitlines()]


def test_paths_with_blanks_and_quotes_reach_the_commands_as_they_are(
    scheduler: Path, recorder: Path, tmp_path: Path
) -> None:
    scene = tmp_path / "Mary's area/scene.json"
    tile = scene.parent / "fit/tiles/r000c000/scene.json"
    tile.parent.mkdir(parents=True)
    tile.touch()
    options = ["--tile", "512", "--config", "our options.toml"]
    more = {"PATH": f"{scheduler}:{os.environ['PATH']}", "SATTOOLS": str(recorder)}
    done = run("slurm.sh", str(scene), *options, **more)
    assert done.returncode == 0, done.stderr
    assert [call[2:] if call[0] == "--threads" else call for call in calls_of(recorder)] == [
        ["fit", *options, "--part", "split", str(scene)],
        ["fit", *options, str(tile)],
        ["fit", *options, "--part", "mosaic", str(scene)],
        ["export", str(scene)],
    ]


def test_more_tiles_than_an_array_may_have_jobs_are_several_arrays(
    scheduler: Path, recorder: Path, tmp_path: Path
) -> None:
    tiles = [tmp_path / f"large/fit/tiles/r000c{number:03d}/scene.json" for number in range(5)]
    for tile in tiles:
        tile.parent.mkdir(parents=True)
        tile.touch()
    scene = tmp_path / "large/scene.json"
    more = {"PATH": f"{scheduler}:{os.environ['PATH']}", "SATTOOLS": str(recorder), "MAX_ARRAY": "2"}
    more["JOB"] = "41;hall"  # as `--parsable` prints where there are several clusters
    done = run("slurm.sh", str(scene), **more)
    assert done.returncode == 0, done.stderr
    assert [call[-1] for call in calls_of(recorder)[1:-2]] == [str(tile) for tile in tiles]
    calls = [line.split("\t") for line in (tmp_path / "calls").read_text().splitlines()]
    arrays = [next((word for word in call if word.startswith("--array")), None) for call in calls]
    assert arrays == [None, "--array=0-1", "--array=0-1", "--array=0-0", None]
    assert "--dependency=afterok:41:41:41" in calls[-1]


def test_an_area_of_one_tile_needs_no_array_of_jobs(scheduler: Path, recorder: Path, tmp_path: Path) -> None:
    scene = tmp_path / "small/scene.json"
    scene.parent.mkdir()
    done = run("slurm.sh", str(scene), PATH=f"{scheduler}:{os.environ['PATH']}", SATTOOLS=str(recorder))
    assert (done.returncode, done.stderr) == (0, "")
    names = [line.split("\t")[-3] for line in (tmp_path / "calls").read_text().splitlines()]
    assert names == ["--job-name=split", "--job-name=mosaic"]
    assert [call[-1] for call in calls_of(recorder)] == [str(scene)] * 3


@pytest.mark.parametrize(
    ("options", "split", "export"),
    [(["--tile", "512"], ["--resume"], []), (["--tile", "512", "--overwrite"], [], ["--overwrite"])],
)
def test_what_is_there_is_gone_on_with_or_replaced_as_asked(
    scheduler: Path, recorder: Path, tmp_path: Path, options: list[str], split: list[str], export: list[str]
) -> None:
    scene = tmp_path / "area/scene.json"
    tiles = scene.parent / "fit/tiles/tiles.json"
    tiles.parent.mkdir(parents=True)
    tiles.touch()
    done = run("slurm.sh", str(scene), *options, PATH=f"{scheduler}:{os.environ['PATH']}", SATTOOLS=str(recorder))
    assert (done.returncode, done.stderr) == (0, "")
    first, *_, last = calls_of(recorder)
    assert first[2:] == ["fit", *options, *split, "--part", "split", str(scene)]
    assert last == ["export", *export, str(scene)]


def test_a_number_without_a_tile_and_an_unknown_part_are_refused(make_town: Any) -> None:
    path = str(make_town().root / "scene.json")
    done = run("tiles.sh", "tile", path, JOB_COMPLETION_INDEX="7")
    assert done.returncode == 1
    assert "found no tile number 7" in done.stderr
    assert run("tiles.sh", "tiles", path).returncode == 2


@pytest.mark.parametrize("script", ["slurm.sh", "tiles.sh"])
@pytest.mark.parametrize(("arguments", "status"), [((), 2), (("--help",), 0)])
def test_a_script_that_is_asked_says_how_it_is_called(script: str, arguments: tuple[str, ...], status: int) -> None:
    done = run(script, *arguments)
    assert (done.returncode, done.stdout) == (status, "")
    assert f"{script} " in done.stderr
    assert "set -eu" not in done.stderr
    assert "parameter not set" not in done.stderr


def test_the_job_for_kubernetes_counts_its_tiles() -> None:
    job = yaml.safe_load((FOLDER / "kubernetes.yaml").read_text())
    assert (job["apiVersion"], job["kind"]) == ("batch/v1", "Job")
    spec = job["spec"]
    assert spec["completionMode"] == "Indexed"  # or there would be no JOB_COMPLETION_INDEX
    (container,) = spec["template"]["spec"]["containers"]
    assert container["command"][2] == "tile"
    assert {mount["name"] for mount in container["volumeMounts"]} == {
        v["name"] for v in spec["template"]["spec"]["volumes"]
    }
