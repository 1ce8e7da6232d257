"""Configurations whose values do not go together end a batch before its first fit, not after it."""

import tomllib
from pathlib import Path
from typing import Any

import pytest
from click.testing import CliRunner

from sattools.cli import main

GOOD = """\
[normalise]
quantity = "reflectance_factor"
scale = "1/10000"
[fit]
preset = "satnerf"
tile = 200
dry-run = false
[export]
products = ["laz,dtm", "mesh"]
[align]
to = "lidar.tif"
[compare]
dsm = "lidar.tif"
classes = "classes.tif"
region = "west"
"""


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ('[export]\nproducts = ["laz", "lazz"]', "c.toml: [export] --products: found 'lazz', expected some of dsm,"),
        ('[fit]\nviews = "nearest"', "c.toml: [fit] --views: found 'nearest', expected all or nearest-nadir:N"),
        ("[fit]\ntile = 40", "c.toml: [fit] Invalid value for --overlap: found 32 m, expected less than half of"),
        ('[compare]\nregion = "left"', "c.toml: [compare] --region: found 'left', expected west, east, north, south"),
        ('[compare]\npredicted = "a.tif"\ndsm = "b.tif"', "c.toml: [compare] found a scene beside --predicted, which"),
        ('[compare]\nfit = ["A=a.json"]\nout = "o"', "c.toml: [compare] found SCENE beside --fit, expected it as"),
        ("[align]\ntilt = true", "c.toml: [align] found no 'to', expected a reference"),
        ("[fit]\nprint-config = true", "c.toml: [fit] found 'print-config', expected `sattools fit --config"),
        ("[export]\ndry_run = true", "c.toml: [export] found 'dry_run', expected `sattools batch --dry-run`"),
        ('[prep]\ndfc2019 = "data"', "c.toml: [prep] found 'dfc2019', expected `sattools batch --dfc2019 ROOT --aoi"),
        ('[prep]\ndfc2019 = "data"\naoi = "JAX_004"', "ROOT --aoi AREA` (scenes that are given are prepared already)"),
        ('[normalise]\nscale = "1/3"', "c.toml: [normalise] --scale: found --quantity auto, expected"),
    ],
)
def test_what_a_command_would_refuse_after_hours_is_refused_at_once(
    make_town: Any, tmp_path: Path, text: str, words: str
) -> None:
    scene = make_town("A")
    (tmp_path / "c.toml").write_text(text)
    out = tmp_path / "out"
    given = ["batch", "--config", str(tmp_path / "c.toml"), "--out", str(out), "--workers", "1"]
    result = CliRunner().invoke(main, given, input=scene.to_json())
    assert (result.exit_code, result.stdout) == (2, "")
    assert words in " ".join(result.stderr.split())
    assert not out.exists()


def test_a_configuration_of_values_that_go_together_is_taken(make_town: Any, tmp_path: Path) -> None:
    from sattools.cli.batch import configuration

    (tmp_path / "c.toml").write_text(GOOD)
    with main.make_context("sattools", ["info"]) as context, context.scope():
        found = configuration(tmp_path / "c.toml")
    assert found.tables["fit"] == {"preset": "satnerf", "tile": 200, "dry-run": False}
    assert found.resolved["export"]["products"] == ("laz,dtm", "mesh")


def test_a_file_that_a_configuration_names_and_that_is_missing_is_told_as_one_of_it(
    make_town: Any, tmp_path: Path
) -> None:
    """It was called one of the scene."""
    (tmp_path / "c.toml").write_text(f'[compare]\nmap = ["albedo={tmp_path}/no.tif"]\n')
    given = ["batch", "--config", str(tmp_path / "c.toml"), "--out", str(tmp_path / "out"), "--dry-run"]
    result = CliRunner().invoke(main, given, input=make_town("A").to_json())
    assert result.exit_code == 1
    found = "no.tif: cannot be read (No such file or directory), expected a file that [compare] or [align] of c names"
    assert found in result.stderr


def test_files_are_found_by_workers_in_any_folder(
    make_town: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Of a Dask cluster, whose workers may have been started anywhere."""
    folder = tmp_path / "here"
    (folder / "vendor").mkdir(parents=True)
    for name in ("lidar.tif", "theta.tif"):
        (folder / name).touch()
    (folder / "c.toml").write_text(
        '[normalise]\nmetadata = "vendor"\n[align]\nto = "lidar.tif"\n'
        '[compare]\ndsm = "https://a.example/dsm.tif"\nmap = ["theta=theta.tif"]\nclasses = "/far/classes.tif"\n'
    )
    monkeypatch.chdir(folder)
    done: list[Any] = []
    monkeypatch.setattr("sattools.batch.stage.run", lambda jobs, *rest: done.extend(jobs))
    monkeypatch.setattr("sattools.batch.plan.reference_files", lambda *_: [])
    CliRunner().invoke(main, ["batch", str(make_town("A").root / "scene.json"), "--config", "c.toml"])
    (job,) = done
    assert tomllib.loads(job.task.config) == {
        "normalise": {"metadata": f"{folder}/vendor"},
        "align": {"to": f"{folder}/lidar.tif"},
        "compare": {
            "dsm": "https://a.example/dsm.tif", "map": [f"theta={folder}/theta.tif"], "classes": "/far/classes.tif",
        },
    }  # fmt: skip
