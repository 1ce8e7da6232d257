"""What options and the files that they name tell is told before a command waits for its scene, hours maybe."""

import io
import os
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import rasterio
import torch
from click.testing import CliRunner
from unread import Unread

from sattools.cli import compare, main, pipe
from sattools.export import datum

# what is wrong whatever the scene holds, and what is said of it
WRONG = [
    (["compare", "--dsm", "text"], "text: found no readable image"),
    (["compare", "--dsm", "nowhere.tif"], "nowhere.tif: found no coordinate reference system"),
    (["compare", "--dsm", "palm.tif"], "palm.tif: found numbers in the unit 'degrees'"),
    (["compare", "--dsm", "heights.tif", "--classes", "text"], "text: found no readable image"),
    (["compare", "--truth", "empty"], "empty: found no tile, expected a folder with NAME_DSM.tif"),
    (["compare", "--truth", "tiles", "--aoi", "B"], "tiles: found tiles A (--aoi NAME takes one), expected a folder"),
    (["compare", "--truth", "text"], "text: found a file, expected a folder with NAME_DSM.tif"),
    (["compare", "--map", "theta=text"], "text: found no readable image"),
    (["compare", "--points", "places.csv"], "places.csv: found no value beside the places"),
    (["compare", "--views", "--lpips-weights", "text"], "text: cannot be read"),
    (["fit", "--reference", "palm.tif"], "palm.tif: found numbers in the unit 'degrees'"),
    (["fit", "--device", "cuda"], "device: found no CUDA device"),
    (["fit", "--brdf", "auto", "--prior-weight", "0"], "--brdf auto: found no prior"),
    (["fit", "--bounce", "--brdf", "rpv"], "--bounce: found no sky"),
    (["fit", "--field", "mlp", "--precision", "tf32"], "--precision tf32: found a training on the CPU"),
    (["fit", "--field", "mlp", "--tile", "300"], "--tile: found --field mlp"),
    (["export", "--vertical", "egm96"], "--vertical egm96: found no grid of the EGM96 geoid in PROJ"),
    (["export", "--products", "laz"], "found no laspy, expected the extra"),
    (["align", "--to", "places.csv"], "places.csv: found no z in row 1"),
    (["align", "--to", "nowhere.tif"], "nowhere.tif: found no coordinate reference system"),
    (["align", "--to", "heights.tif", "--tilt", "--method", "z"], "found --tilt with --method z"),
]


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The current folder, with files that are not what options expect; no GPU, no geoids, no reader of LAZ."""
    monkeypatch.chdir(tmp_path)
    for name in ("text", "page.html"):
        Path(name).write_text("words\n")
    Path("places.csv").write_text("name,x,y\na,1,2\n")
    for name, crs, unit in (("nowhere", None, "m"), ("palm", "EPSG:32617", "degrees"), ("heights", "EPSG:32617", "m")):
        place = rasterio.Affine(1, 0, 440000, 0, -1, 3350000)
        shape = {"width": 8, "height": 8, "count": 1, "dtype": "float32"}
        with rasterio.open(f"{name}.tif", "w", crs=crs, transform=place, **shape) as data:
            data.write(np.zeros((1, 8, 8), np.float32))
            data.units = [unit]
    for name in ("empty", "tiles"):
        Path(name).mkdir()
    Path("tiles/A_DSM.tif").touch()
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    monkeypatch.setattr(datum, "has_grid", lambda vertical: False)
    monkeypatch.setitem(sys.modules, "laspy", None)
    return tmp_path


@pytest.mark.parametrize("dry", [[], ["--dry-run"]], ids=str)
@pytest.mark.parametrize(("arguments", "why"), WRONG, ids=lambda value: " ".join(value))
def test_what_no_scene_can_mend_is_told_before_it_comes(
    folder: Path, arguments: list[str], why: str, dry: list[str]
) -> None:
    result = CliRunner().invoke(main, [*arguments, *dry], input=Unread())
    assert (result.exit_code, result.stdout) == (1, ""), result.output
    assert result.stderr.startswith(f"sattools {arguments[0]}: error: {why}"), result.stderr
    assert result.stderr.count("\n") == 1


@pytest.mark.parametrize(
    "arguments",
    [
        ["compare", "--truth", "tiles"],  # the scene's id may be the tile's
        ["compare", "--dsm", "heights.tif", "--classes", "heights.tif", "--map", "theta=heights.tif"],
        ["fit", "--sky", "fitted", "--brdf", "rpv", "--sky-share", "0.1", "--sky-share", "0.2"],  # of two bands
        ["align", "--to", "heights.tif", "--tilt", "--method", "icp"],
        ["compare", "--dsm", "https://a.example/text"],
    ],
    ids=" ".join,
)
def test_what_may_be_right_waits_for_the_scene(folder: Path, arguments: list[str]) -> None:
    result = CliRunner().invoke(main, arguments, input=io.BytesIO(b""))
    assert "stdin: found nothing, expected scene documents" in result.stderr
    assert result.stderr.count("\n") == 1


def test_air_is_not_taken_off_what_is_to_be_no_reflectance(folder: Path) -> None:
    asked = ["normalise", "--atmosphere", "rayleigh", "--quantity", "relative"]
    result = CliRunner().invoke(main, asked, input=Unread())
    assert result.exit_code == 2
    assert "--atmosphere rayleigh: found --quantity relative, expected a reflectance" in result.stderr


def test_a_page_that_is_there_is_told_of_before_the_scene_comes(folder: Path, make_town: Any) -> None:
    other = CliRunner().invoke(main, ["report", "--out", "page.html"], input=Unread())
    assert other.stderr.startswith("sattools report: error: page.html: found a file that is no report")
    report = CliRunner().invoke(main, ["report", "--out", "new.html", str(make_town().root / "scene.json")])
    assert report.exit_code == 0, report.stderr
    result = CliRunner().invoke(main, ["report", "--out", "new.html"], input=Unread())
    assert (result.exit_code, result.stderr.count("--overwrite")) == (1, 1)


NOTICE = "sattools compare: no --truth or --dsm: the scene has to bring its own truth, as those of simulate do\n"


@pytest.mark.parametrize(
    ("options", "waiting", "said"),
    [([], True, NOTICE), (["--dsm", "heights.tif"], True, ""), ([], False, "")],
    ids=["none", "one", "the scene is there"],
)
def test_who_looks_on_is_told_that_no_reference_is_named(
    folder: Path, monkeypatch: pytest.MonkeyPatch, options: list[str], waiting: bool, said: str
) -> None:
    monkeypatch.setattr(compare, "waits", lambda: waiting)
    result = CliRunner().invoke(main, ["--progress", "bar", "compare", *options], input=io.BytesIO(b""))
    assert result.stderr.startswith(f"{said}sattools compare: error: stdin: found nothing")


def test_a_pipe_is_waited_for_until_something_comes(monkeypatch: pytest.MonkeyPatch) -> None:
    reading, writing = os.pipe()
    with open(reading) as stdin, open(writing, "w") as before:
        monkeypatch.setattr(sys, "stdin", stdin)
        assert pipe.waits()
        before.write("{}\n")
        before.flush()
        assert not pipe.waits()
