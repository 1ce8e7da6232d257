"""No command writes onto what it reads, none reports what is out of date, and none leaves half of its files."""

import hashlib
import json
import os
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import rasterio
from click.testing import CliRunner

from sattools import api
from sattools.cli import main
from sattools.runlog import NAME
from sattools.scene import Scene
from sattools.scene.dependencies import stale

QUICK = ["--resolution", "2", "--coarsest", "2", "--epochs", "2", "--prior-weight", "0"]


def run(*arguments: Any, text: Any = None) -> Any:
    return CliRunner().invoke(main, ["--threads", "1", *map(str, arguments)], input=text)


def contents(folder: Any) -> Any:
    """Digest of every file below a folder but the log, which tells of runs that failed, too."""
    found = {}
    for path in sorted(folder.rglob("*")):
        if path.is_file() and path.name != NAME:
            found[str(path.relative_to(folder))] = hashlib.sha256(path.read_bytes()).hexdigest()
    return found


def refused(result: Any, *words: Any) -> None:
    assert result.exit_code == 1, result.output
    assert isinstance(result.exception, SystemExit)
    (line,) = [line for line in result.stderr.splitlines() if "error:" in line]
    for word in words:
        assert word in line


# ---- originals ----------------------------------------------------------------------------------------------------


@pytest.fixture
def originals(make_town: Any, tmp_path: Path) -> Any:
    """A user's folder of images, where `prep` would write by its default --out and --id."""
    town = make_town("SOURCE")
    folder = tmp_path / "work"
    (folder / "TOWN").mkdir(parents=True)
    shutil.copytree(town.root / "images", folder / "TOWN/images")
    shutil.copytree(town.root / "metadata", folder / "metadata")
    return folder


def prep(folder: Any, *more: Any) -> Any:
    before = os.getcwd()
    os.chdir(folder)
    try:
        images = sorted((folder / "TOWN/images").glob("*.tif"))
        bounds = ["--bounds", "-81.6601", "30.3499", "-81.6599", "30.3501"]
        return run("prep", *(p.relative_to(folder) for p in images), "--metadata", "metadata", *bounds, *more)
    finally:
        os.chdir(before)


@pytest.mark.parametrize("flags", [[], ["--overwrite"]])
def test_prep_never_replaces_the_images_it_reads(originals: Any, flags: Any) -> None:
    before = contents(originals)
    refused(prep(originals, *flags), "TOWN/images/TOWN_001.tif", "is an input too", "nothing was written")
    assert contents(originals) == before


@pytest.mark.parametrize("kind", ["symbolic", "hard"])
def test_prep_sees_through_links(originals: Any, kind: Any) -> None:
    for path in (originals / "TOWN/images").glob("*.tif"):
        target = originals / "elsewhere" / path.name
        target.parent.mkdir(exist_ok=True)
        path.rename(target)
        (path.symlink_to if kind == "symbolic" else path.hardlink_to)(target)
    before = contents(originals)
    # a link that leads out of the scene's folder is refused for that already
    refused(prep(originals, "--overwrite"), "outside the scene's root" if kind == "symbolic" else "is an input too")
    assert contents(originals) == before


def test_prep_asks_before_it_replaces_any_of_its_files(originals: Any, tmp_path: Path) -> None:
    (tmp_path / "out/TOWN/rpc").mkdir(parents=True)
    (tmp_path / "out/TOWN/rpc/TOWN_003_RPC.TXT").write_text("somebody's camera")
    refused(prep(originals, "--out", tmp_path / "out"), "TOWN_003_RPC.TXT: exists already; give --overwrite")
    assert list(contents(tmp_path / "out")) == ["TOWN/rpc/TOWN_003_RPC.TXT"]


def test_no_option_that_names_an_output_can_name_an_input(make_town: Any, tmp_path: Path) -> None:
    town = make_town()
    document = town.root / "scene.json"
    assert run("fit", *QUICK, document).exit_code == 0
    assert run("export", document).exit_code == 0
    before = contents(town.root)
    image = town.root / "images/TOWN_001.tif"
    (tmp_path / "link.html").symlink_to(image)
    (tmp_path / "difference.tif").symlink_to(town.root / "truth/TOWN_DSM.tif")
    for arguments in (
        ["report", "--out", image, "--overwrite", document],
        ["report", "--out", tmp_path / "link.html", "--overwrite", document],
        ["report", "--out", document, "--overwrite", document],
        ["compare", "--predicted", town.root / "export/dsm.tif", "--dsm", town.root / "truth/TOWN_DSM.tif",
         "--out", tmp_path, "--overwrite"],
        ["simulate", "--dsm", town.root / "truth/TOWN_DSM.tif", "--id", "TOWN", "--out", town.root.parent,
         "--size", "48", "--views", "2", "--overwrite"],
    ):  # fmt: skip
        refused(run(*arguments), "input")
        assert contents(town.root) == before
    # a reference below compare/ would be replaced by the difference to it
    assert run("compare", document).exit_code == 0
    (town.root / "compare/difference.tif").replace(town.root / "reference.tif")
    (town.root / "compare/difference.tif").symlink_to(town.root / "reference.tif")
    before = contents(town.root)
    refused(run("compare", "--dsm", town.root / "reference.tif", "--overwrite", document), "is the input")
    assert contents(town.root) == before


def test_a_document_of_something_else_in_the_scenes_folder_is_kept(make_town: Any) -> None:
    town = make_town()
    text = town.to_json()
    for other in ('{"my": "notes"}', text.replace('"id":"TOWN"', '"id":"NEIGHBOUR"')):
        (town.root / "scene.json").write_text(other)
        refused(run("fit", *QUICK, text=text), "scene.json", "--overwrite")
        assert (town.root / "scene.json").read_text() == other
    assert run("fit", *QUICK, "--overwrite", text=text).exit_code == 0


# ---- all or nothing -----------------------------------------------------------------------------------------------


def limited(size: int, *arguments: Any) -> Any:
    """The command while this process may write no file larger than ``size`` bytes, as on a full disk."""
    resource = pytest.importorskip("resource", reason="no limit of this kind on Windows")
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, before[1]))
    try:
        return run(*arguments)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)


def test_a_disk_that_fills_up_leaves_every_file_of_every_command_as_it_was(make_town: Any, tmp_path: Path) -> None:
    """At a few sizes, so that the first, a middle and the last file of a command is the one that fails."""
    town = make_town()
    document = town.root / "scene.json"
    steps = {
        "normalise": [],
        "prior": ["--resolution", "2"],
        "fit": [*QUICK[:-2]],
        "export": ["--view", "TOWN_002"],
        "compare": ["--views"],
    }
    for name, options in steps.items():
        earlier = contents(town.root)
        assert run(name, *options, document).exit_code == 0, name
        before = contents(town.root)
        largest = max((town.root / n).stat().st_size for n in before if before[n] != earlier.get(n))
        for size in (0, 2000, largest - 1):
            done = limited(size, name, *options, "--overwrite", document)
            assert done.exit_code == 1, (name, size, done.stderr)
            assert isinstance(done.exception, SystemExit)
            assert "cannot be written" in done.stderr
            assert contents(town.root) == before, (name, size)


def test_an_image_that_fails_late_leaves_no_radiance_of_the_others(make_town: Any) -> None:
    town = make_town()
    path = town.path(town.items[-1].assets["image"].href)
    with rasterio.open(path, "r+") as data:
        data.write(np.zeros((data.count, data.height, data.width), data.dtypes[0]))
    before = contents(town.root)
    refused(run("normalise", town.root / "scene.json"), path.name)
    assert contents(town.root) == before


# ---- scores that count --------------------------------------------------------------------------------------------


def test_a_report_after_a_new_fit_has_no_score_of_the_old_one(make_town: Any) -> None:
    town = make_town()
    document = town.root / "scene.json"
    for name, options in (("fit", QUICK), ("export", []), ("compare", []), ("fit", [*QUICK, "--seed", "1"])):
        assert run(name, *options, "--overwrite", document).exit_code == 0
    products = json.loads(document.read_text())["sattools"]["products"]
    assert {"dsm", "errors", "difference"} & products.keys() == set()
    assert run("report", document).exit_code == 0
    page = (town.root / "report.html").read_text()
    assert "MAE [m]" not in page
    # compare does the export that was left out, says so, and scores the new surface
    result = run("compare", "--overwrite", document)
    assert "exporting it first" in result.stderr
    history = json.loads(document.read_text())["sattools"]["history"]
    assert [entry["command"] for entry in history[-2:]] == ["export", "compare"]


def test_a_surface_replaced_behind_the_scenes_back_is_neither_scored_nor_shown(
    make_town: Any, caplog: pytest.LogCaptureFixture
) -> None:
    town = make_town()
    document = town.root / "scene.json"
    for name, options in (("fit", QUICK), ("export", []), ("compare", [])):
        assert run(name, *options, document).exit_code == 0
    shutil.copy(town.root / "truth/TOWN_DSM.tif", town.root / "export/dsm.tif")
    result = run("compare", document)
    refused(result, "export/dsm.tif", "exists already; give --overwrite")
    assert "another file for dsm than the history knows" in result.stderr
    assert run("report", document).exit_code == 0
    assert "another file for dsm than the history knows" in caplog.text
    assert "Left out: dsm, dsm_std" in (town.root / "report.html").read_text()
    shutil.copy(town.root / "fit/trace.csv", town.root / "fit/model.safetensors")
    refused(run("export", "--overwrite", document), "model.safetensors")


def test_an_edited_sun_makes_the_fit_out_of_date(make_town: Any) -> None:
    town = make_town()
    document = town.root / "scene.json"
    assert run("fit", *QUICK, document).exit_code == 0
    scene = Scene.from_file(document)
    scene.items[0].properties["view:sun_azimuth"] += 20
    document.write_text(scene.to_json())
    refused(run("export", document), "what fit was made from has changed since", "sattools fit")


@pytest.mark.parametrize("tiles", [{}, {"tile": 32.0, "overlap": 8.0}])
def test_an_image_that_is_replaced_while_a_fit_runs_makes_the_fit_out_of_date(make_town: Any, tiles: Any) -> None:
    """It had been noted as the one that the fit had seen."""
    town = make_town()
    path = town.path(town.items[0].assets["image"].href)

    def replaced(share: float, message: str) -> None:
        if "epoch 2" in message:
            with rasterio.open(path, "r+") as data:
                data.write((data.read() * 0.9).astype(data.dtypes[0]))

    quick = {"resolution": 2.0, "coarsest": 2.0, "epochs": [2], "prior_weight": 0.0}
    api.fit(town, quick | tiles, progress=replaced)
    refused(run("export", town.root / "scene.json"), "what fit was made from has changed since", "sattools fit")


@pytest.mark.parametrize(("stage", "last"), [("normalise", "TOWN_006"), ("prior", "writing")])
def test_an_image_that_is_replaced_while_a_stage_runs_makes_what_it_leaves_out_of_date(
    make_town: Any, stage: str, last: str
) -> None:
    """It had been noted as the one that the stage had seen."""
    town = make_town()
    path = town.path(town.items[0].assets["image"].href)

    def replaced(share: float, message: str) -> None:
        if message == last:
            with rasterio.open(path, "r+") as data:
                data.write((data.read() * 0.9).astype(data.dtypes[0]))

    if stage == "prior":
        api.match(town, {"resolution": 2.0, "rough_passes": 0}, progress=replaced)
    else:
        api.normalise(town, progress=replaced)
    assert f"what {stage} was made from has changed since" in str(stale(town, stage))


def test_a_document_from_before_another_prep_is_told_that_it_is(
    originals: Any, caplog: pytest.LogCaptureFixture
) -> None:
    """Its files are those of the new one by then."""
    first = prep(originals, "--id", "NEW", "--out", "made")
    assert first.exit_code == 0, first.stderr
    assert prep(originals, "--id", "NEW", "--out", "made", "--cell-size", "2", "--overwrite").exit_code == 0
    document = originals / "made/NEW/scene.json"
    text = document.read_text().replace('"root":"."', f'"root":"{document.parent}"')
    assert run("normalise", text=text).exit_code == 0
    assert "made anew" not in caplog.text
    assert run("normalise", "--overwrite", text=first.stdout).exit_code == 0
    assert f"the document is not that of {document}, which was made anew since" in caplog.text
    assert "made anew since" in Scene.from_file(document).history[-1]["notes"][-1]


def test_hapkes_maps_do_not_outlive_their_fit() -> None:
    from sattools.scene.dependencies import STAGES

    assert {"w", "b", "c", "theta", "rho0", "k", "rhoc", "normal", "reflectance"} <= set(STAGES["export"].products)


def test_every_product_and_asset_of_a_command_is_in_the_table(make_town: Any) -> None:
    """Else it would outlive what it was made from."""
    from sattools.scene.dependencies import drop

    town = make_town()
    document = town.root / "scene.json"
    before = Scene.from_file(document)
    for name, options in (
        ("normalise", []),
        ("prior", ["--resolution", "2", "--per-image"]),
        ("fit", [*QUICK[:-2], "--shadow", "learned", "--transient", "on"]),
        ("export", ["--view", "TOWN_002", "--sun", "120", "40"]),
        ("compare", ["--views"]),
    ):
        result = run(name, *options, document)
        assert result.exit_code == 0, result.stderr
    scene = Scene.from_file(document)
    drop(scene, "normalise")
    assert scene.products == before.products
    assert [set(item.assets) for item in scene.items] == [set(item.assets) for item in before.items]


def test_two_commands_in_one_scene_at_once_keep_each_others_entries(make_town: Any) -> None:
    town = make_town()
    document = town.root / "scene.json"
    command = [sys.executable, "-m", "sattools", "--threads", "1", "-q"]
    both = [
        subprocess.Popen([*command, *rest, str(document)], stdout=subprocess.DEVNULL)
        for rest in (["normalise"], ["prior", "--resolution", "2"])
    ]
    assert [process.wait() for process in both] == [0, 0]
    history = json.loads(document.read_text())["sattools"]["history"]
    assert sorted(entry["command"] for entry in history) == ["normalise", "prior"]
