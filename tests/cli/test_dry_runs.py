"""A dry run refuses what the run would refuse before its work, in the same words and with the same exit code."""

import re
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import rasterio
from click.testing import CliRunner

from sattools.cli import main
from sattools.scene import Scene

QUICK = ["--resolution", "2", "--epochs", "1"]


def run(*arguments: object, text: str = "") -> Any:
    return CliRunner().invoke(main, ["--quiet", *map(str, arguments)], input=text)


def refused(*arguments: object) -> str:
    """The line with which a command refuses, dry and for real."""
    dry, real = run(*arguments, "--dry-run"), run(*arguments)
    left = r"at most the [\d.]+ \w+ that"  # of a limit: the process itself has grown between the two
    told, done = (re.sub(left, "at most the rest that", one.stderr) for one in (dry, real))
    assert (dry.exit_code, told) == (real.exit_code, done)
    assert dry.stdout == real.stdout == ""
    assert dry.exit_code == 1
    (line,) = dry.stderr.splitlines()
    return str(line)


@pytest.fixture(scope="module")
def fitted_source(town_source: Scene, tmp_path_factory: pytest.TempPathFactory) -> Path:
    root = tmp_path_factory.mktemp("dry") / "TOWN"
    shutil.copytree(town_source.root, root)
    document = root / "scene.json"
    for command in (["prior", "--resolution", "2", "--rough-passes", "0"], ["fit", *QUICK]):
        assert run(*command, document).exit_code == 0
    return document


@pytest.fixture
def fitted(fitted_source: Path, tmp_path: Path) -> Path:
    shutil.copytree(fitted_source.parent, tmp_path / "TOWN")
    return tmp_path / "TOWN/scene.json"


@pytest.mark.parametrize(
    ("options", "why"),
    [
        (["--preset", "rpv-nerf", "--brdf", "hapke"], "network rpv has no head for it, expected --network hapke"),
        (["--preset", "eonerf", "--shadow", "learned"], "network eonerf has no head for it"),
        (["--preset", "eonerf", "--sky", "auto"], "--sky: found --brdf lambert and --field mlp"),
        (["--sky-share", "0.03"], "--sky-share: found --brdf lambert and --field surface"),
        (["--preset", "spsnerf", "--prior-weight", "0"], "--guided: found no prior to sample around"),
        (["--preset", "satnerf", "--transient", "auto"], "--transient auto: expected --field surface"),
        (["--field", "neural", "--start", "noise"], "--field neural: found --start noise"),
        (["--field", "voxel", "--brdf", "rpv"], "a voxel field has no head for it"),
        (["--brdf", "auto", "--prior-weight", "0"], "--brdf auto: found no prior, expected one"),
        (["--brdf", "hapke", "--sky-share", "0.1", "--sky-share", "0.2"], "found 2 values, expected 1 or 3"),
        (["--bands", "pink"], "--bands: found 'pink'"),
        (["--holdout", "nobody"], "found no item 'nobody' to hold out"),
        (["--views", "nearest-nadir:1"], "found 1 training image, expected at least 2"),
        (["--tile", "32", "--overlap", "8", "--brdf", "rpv"], "--tile: found --brdf rpv"),
        ([], "exists already; give --overwrite to replace it"),
    ],
    ids=" ".join,
)
def test_a_fit(fitted: Path, options: list[str], why: str) -> None:
    given = [*options, "--overwrite"] if options else options
    assert why in refused("fit", *given, fitted)


def test_a_network_with_more_rays_than_memory_holds(fitted: Path) -> None:
    line = refused("--max-memory", 1000, "fit", "--overwrite", "--preset", "eonerf", "--rays", 1 << 20, fitted)
    assert "samples a step: found a need of" in line


def test_a_matching(make_town: Callable[[], Scene]) -> None:
    scene = make_town()
    document = scene.root / "scene.json"
    assert "cells of 100 m for the whole area" in refused("prior", "--resolution", 100, document)
    alike = scene.items[0].assets["rpc"].href
    for item in scene.items[1:]:
        shutil.copy(scene.path(alike), scene.path(item.assets["rpc"].href))
        item.properties |= {n: v for n, v in scene.items[0].properties.items() if n.startswith("view:")}
    scene.write()
    assert "found no two images from different directions" in refused("prior", document)
    assert "found no two images from different directions" in refused("fit", document)


def test_an_export(fitted: Path, make_town: Callable[[str], Scene]) -> None:
    assert "found no item 'nobody'" in refused("export", "--view", "nobody", fitted)
    assert "found no item 'nobody'" in refused("export", "--view", "nobody", make_town("OTHER").root / "scene.json")
    assert "found no product 'model'" in refused("export", make_town("PLAIN").root / "scene.json")
    assert run("export", fitted).exit_code == 0
    assert "exists already; give --overwrite" in refused("export", fitted)


def test_a_comparison(fitted: Path, make_town: Callable[[str], Scene], tmp_path: Path) -> None:
    nowhere = tmp_path / "nowhere"
    # what has to be exported first is not, where its scores could not be had
    assert "no such folder" in refused("compare", "--truth", nowhere, fitted)
    assert "found no rendered view" in refused("compare", "--views", fitted)
    assert not (fitted.parent / "export").exists()
    assert "found no DSM" in refused("compare", make_town("PLAIN").root / "scene.json")
    assert run("export", fitted).exit_code == 0
    for options, why in (
        (["--map", f"w={fitted}"], "found no product 'w'"),
        (["--map", "albedo=nowhere.tif"], "nowhere.tif: no such file, expected one for --map albedo"),
        (["--views"], "found no rendered view"),
        (["--region", "0 0 1 1"], "region: found no reference cell"),
    ):
        assert why in refused("compare", *options, fitted)


@pytest.mark.parametrize(
    ("options", "why"),
    [
        (["--map", "w={folder}/truth/TOWN_DSM.tif"], "found no product 'w', expected one of dsm, "),
        (["--map", "albedo={folder}/scene.json"], "scene.json: found no readable image"),
        (["--points", "{folder}/scene.json"], "scene.json: found"),
        (["--region", "0,0,1,1"], "found no reference cell in '0,0,1,1'"),
    ],
    ids=str,
)
def test_a_comparison_that_begins_with_an_export_is_refused_before_it(
    fitted: Path, options: list[str], why: str
) -> None:
    assert why in refused("compare", *(text.format(folder=fitted.parent) for text in options), fitted)
    assert not (fitted.parent / "export").exists()


def test_a_comparison_does_not_export_what_it_could_not_score_or_onto_its_reference(fitted: Path) -> None:
    reference = fitted.parent / "truth/TOWN_DSM.tif"
    scores, surface = fitted.parent / "compare/errors.json", fitted.parent / "export/dsm.tif"
    scores.parent.mkdir()
    scores.write_text("{}")
    assert "compare/errors.json: exists already; give --overwrite" in refused("compare", fitted)
    assert not surface.exists()
    surface.parent.mkdir()
    shutil.copy(reference, surface)
    assert "export/dsm.tif: is an input too" in refused("compare", "--overwrite", "--dsm", surface, fitted)
    assert surface.read_bytes() == reference.read_bytes()


def test_on_a_pipe_of_dry_runs_a_comparison_is_refused_that_could_not_be_made(make_town: Callable[[], Scene]) -> None:
    scene = make_town()
    (scene.root / "points.csv").write_text("name,x,y\nroof,1,2\n")
    for options, why in (
        (["--truth", scene.root / "nowhere"], "nowhere: no such folder"),
        (["--region", "0 0 1 1"], "region: found no reference cell"),
        (["--map", f"w={scene.root}/nowhere.tif"], "nowhere.tif: no such file, expected one for --map w"),
        (["--points", scene.root / "points.csv"], "found no value beside the places"),
    ):
        result = run("compare", *options, "--dry-run", text=scene.to_json())
        assert (result.exit_code, result.stdout) == (1, "")
        assert why in result.stderr
    # views may have been rendered, and maps made, by the dry runs before it
    asked = ["--views", "--map", f"w={scene.root}/truth/TOWN_DSM.tif"]
    assert run("compare", *asked, "--dry-run", text=scene.to_json()).exit_code == 0


def test_comparisons_without_a_scene(fitted: Path, tmp_path: Path) -> None:
    heights = fitted.parent / "truth/TOWN_DSM.tif"
    assert "no such file" in refused("compare", "--predicted", tmp_path / "no.tif", "--dsm", heights)
    assert "found no DSM" in refused("compare", "--fit", f"Lam={fitted}", "--out", tmp_path / "out")


def test_a_preparation(make_town: Callable[[], Scene], tmp_path: Path) -> None:
    images, out = make_town().root / "images", tmp_path / "out"
    assert "found id 'a town', expected 1-128 letters" in refused("prep", images, "--out", out, "--id", "a town")
    (tmp_path / "file").touch()
    assert "file: cannot be written to" in refused("prep", images, "--out", tmp_path / "file", "--id", "X")
    why = refused("prep", images, "--out", out, "--id", "X", "--colours", "nowhere")
    assert "nowhere: no such folder, expected one for --colours" in why
    assert not out.exists()
    (out / "X").mkdir(parents=True)
    (out / "X/scene.json").touch()
    assert "X/scene.json: exists already; give --overwrite" in refused("prep", images, "--out", out, "--id", "X")
    assert run("prep", images, "--out", out, "--id", "X", "--overwrite", "--dry-run").exit_code == 0


def test_a_simulation(make_town: Callable[[], Scene], tmp_path: Path) -> None:
    folder = make_town().root.parent
    assert "found id 'a town', expected 1-128 letters" in refused("simulate", "--out", tmp_path, "--id", "a town")
    assert "exists already; give --overwrite" in refused("simulate", "--out", folder, "--id", "TOWN")
    (tmp_path / "file").touch()
    assert "file: cannot be written to" in refused("simulate", "--out", tmp_path / "file", "--id", "X")
    truth = folder / "TOWN/truth"
    made = ["simulate", "--out", tmp_path, "--id", "X", "--dsm"]
    assert "TOWN_001.tif: found no coordinate" in refused(*made, folder / "TOWN/images/TOWN_001.tif")
    assert "TOWN_001.tif: found no coordinate" in refused(
        *made, folder / "TOWN/images/TOWN_001.tif", "--terrain", "natural"
    )
    heights = truth / "TOWN_DSM.tif"
    assert "TOWN_DSM.tif: found none of the classes 2, 5, 6, 9" in refused(*made, heights, "--classes", heights)
    passes = ["--terrain", "natural", "--passes", "12", "--lat", "60"]
    assert "--passes: found a sun -37.0 degrees high" in refused("simulate", "--out", tmp_path, "--id", "X", *passes)


def test_what_a_simulation_takes_is_that_of_its_images(make_town: Callable[[], Scene], tmp_path: Path) -> None:
    """Test views are among the views, and a given surface may be smaller than asked for."""
    asked = ["simulate", "--out", tmp_path, "--views", "6", "--test-views", "2", "--dry-run"]
    assert "0.0164 km2, 6 images, 0.393 megapixels" in CliRunner().invoke(main, list(map(str, asked))).stderr
    heights = make_town().root / "truth/TOWN_DSM.tif"
    assert "0.0041 km2, 6 images" in CliRunner().invoke(main, [*map(str, asked), "--dsm", str(heights)]).stderr


def test_a_normalisation(make_town: Callable[[], Scene]) -> None:
    document = make_town().root / "scene.json"
    for options, why in (
        (["--bands", "9"], "--bands: found '9', expected a number up to 3"),
        (["--black", "70000"], "--black: found 70000"),
        (["--quantity", "radiance"], "radiance was asked for, but of TOWN_001 no metadata"),
    ):
        assert why in refused("normalise", *options, document)
    assert run("normalise", document).exit_code == 0
    assert "exists already; give --overwrite" in refused("normalise", document)


def test_an_alignment(fitted: Path, make_town: Callable[[str], Scene], tmp_path: Path) -> None:
    heights = fitted.parent / "truth/TOWN_DSM.tif"
    assert "found no DSM" in refused("align", "--to", heights, make_town("PLAIN").root / "scene.json")
    assert run("export", fitted).exit_code == 0
    lost = tmp_path / "lost.tif"
    with rasterio.open(heights) as source, rasterio.open(lost, "w", **source.profile | {"crs": None}) as file:
        file.write(source.read())
    assert "lost.tif: found no coordinate reference system" in refused("align", "--to", lost, fitted)
    points = tmp_path / "points.csv"
    points.write_text("name,x,y\nroof,1,2\n")
    assert "points.csv: found" in refused("align", "--to", points, fitted)
    assert "found --tilt with --method z" in refused("align", "--to", heights, "--tilt", "--method", "z", fitted)
    (fitted.parent / "align/1").mkdir(parents=True)
    (fitted.parent / "align/1/transform.json").touch()
    assert "align/1/transform.json: exists already" in refused("align", "--to", heights, fitted)
    # on a pipe the surface may be what a dry run would have made, but not the reference
    text = make_town("PIPED").to_json()
    assert "found no coordinate" in run("align", "--to", lost, "--dry-run", text=text).stderr
    assert run("align", "--to", heights, "--dry-run", text=text).exit_code == 0


def test_a_change(make_town: Callable[[], Scene], tmp_path: Path) -> None:
    heights, out = make_town().root / "truth/TOWN_DSM.tif", tmp_path / "out"
    both = ["change", heights, heights, "--out", out]
    (tmp_path / "no.gpkg").touch()
    assert "no.gpkg: found" in refused(*both, "--polygons", tmp_path / "no.gpkg")
    assert not out.exists()
    out.mkdir()
    (out / "change.json").touch()
    assert "change.json: exists already; give --overwrite" in refused(*both)


def test_a_pipe_of_dry_runs_needs_none_of_what_they_would_have_made(make_town: Callable[[], Scene]) -> None:
    scene = make_town()
    before = sorted(scene.root.rglob("*"))
    text = (scene.root / "scene.json").read_text().replace('"root":"."', f'"root":"{scene.root}"')
    for command in ("prior", "fit", "export", "compare"):
        result = run(command, "--dry-run", text=text)
        assert result.exit_code == 0, result.stderr
        text = result.stdout
    assert sorted(scene.root.rglob("*")) == before


def test_a_pipe_of_dry_runs_makes_what_is_out_of_date_anew(fitted: Path, tmp_path: Path) -> None:
    """As the run does; a command by itself, of which nobody says that another comes before, refuses it."""
    heights = fitted.parent / "truth/TOWN_DSM.tif"
    assert run("export", fitted).exit_code == 0
    scene = Scene.from_file(fitted)
    scene.items[0].properties["view:sun_azimuth"] += 20
    scene.write()
    text = run("prior", "--overwrite", "--dry-run", fitted).stdout
    for command in (["fit"], ["export"], ["align", "--to", heights], ["compare"]):
        assert "has changed since" in run(*command, "--overwrite", "--dry-run", fitted).stderr
        result = run(*command, "--overwrite", "--dry-run", text=text)
        assert result.exit_code == 0, result.stderr
    (tmp_path / "new.toml").write_text("[prior]\n[fit]\n")
    result = run("batch", fitted, "--config", tmp_path / "new.toml", "--out", tmp_path / "batch", "--dry-run")
    assert result.exit_code == 0, result.stderr
