"""What a command will take is said before it begins: in a dry run, on a terminal, and in the scene's log."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from click.testing import CliRunner

from sattools.cli import main, plans
from sattools.prep.options import PrepOptions
from sattools.prep.stage import check_inputs, prepare
from sattools.prior import PriorOptions
from sattools.processors import cores, takes
from sattools.scene import Grid, Scene

AREA = "0.0041 km2, 16384 cells, 6 images"
QUICK = ("--rough-passes", "0", "--resolution", "4")  # what matching finds does not count


def run(*arguments: object) -> Any:
    result = CliRunner().invoke(main, [str(argument) for argument in arguments])
    assert result.exit_code == 0, result.stderr
    return result


@pytest.mark.parametrize(
    ("command", "words", "writes"),
    [
        (["prior"], AREA, "prior/"),
        (["fit"], f"{AREA}, all at once", "fit/model.safetensors and fit/trace.csv"),
        (["export"], AREA, "export/"),
        (["compare"], AREA, "compare/"),
        (["align", "--to", "truth/TOWN_DSM.tif"], AREA, "the moved scene"),
        (["normalise"], "images, ", "radiance/"),
    ],
)
def test_a_dry_run_says_what_it_will_take_and_write(
    make_town: Callable[[], Scene], monkeypatch: pytest.MonkeyPatch, command: list[str], words: str, writes: str
) -> None:
    scene = make_town()
    monkeypatch.chdir(scene.root)
    before = sorted(scene.root.rglob("*"))
    text = (scene.root / "scene.json").read_text()
    result = CliRunner().invoke(main, [*command, "--dry-run"], input=text)  # as after dry runs of what comes before
    assert result.exit_code == 0, result.stderr
    said = result.stderr
    assert words in said
    assert "GiB of memory and" in said
    assert said.endswith(f"; writes {writes}\n")
    assert sorted(scene.root.rglob("*")) == before


def test_prep_says_it_of_its_images(make_town: Callable[[], Scene], tmp_path: Path) -> None:
    images = make_town().root / "images"
    said = run("prep", "--dry-run", "--out", tmp_path / "new", "--id", "X", images).stderr
    assert "would make X: " in said
    assert " megapixels: about 0.4 GiB of memory and " in said
    assert said.endswith(f"; writes {tmp_path}/new/X/\n")
    assert not (tmp_path / "new").exists()


@pytest.mark.parametrize(
    ("images", "edge", "gib"),
    # really 0.66, 0.75, 1.90, 2.24, 1.07 and 1.29 GiB
    [(3, 1500, "0.7"), (12, 1500, "0.7"), (12, 3000, "1.9"), (22, 3000, "2.2"), (3, 10000, "1.1"), (3, 40000, "1.3")],
)
def test_prep_says_the_memory_of_many_images_and_of_large_ones(images: int, edge: int, gib: str) -> None:
    assert f" megapixels: about {gib} GiB of memory and " in plans.of_prep([(edge, edge)] * images)


def test_prep_of_an_area_says_it_of_what_is_read_of_its_images(
    make_town: Callable[[], Scene], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Of whole images of thousands of megapixels little may be read; what is kept around the area is part of it."""
    monkeypatch.setattr("sattools.prep.places._BIAS_MARGIN_PX", 25)  # these images are small
    town = make_town()
    images = [town.path(item.assets["image"].href) for item in town.items]
    west, south, east, north = town.require_grid().bounds
    area = [west + 28, south + 28, east - 28, north - 28]
    low, high = town.require_height_range()
    options = PrepOptions(out=str(tmp_path), id="X", crs=town.require_grid().crs, bounds=area)
    options = replace(options, min_height=low, max_height=high)
    told = check_inputs(images, options)
    kept = [item.properties["proj:shape"] for item in prepare(images, options)[0].items]
    for (rows, columns), (kept_rows, kept_columns), item in zip(told, kept, town.items, strict=True):
        whole = item.properties["proj:shape"]
        assert kept_rows <= rows < whole[0]
        assert kept_columns <= columns < whole[1]


def test_simulate_says_it_of_its_rays(tmp_path: Path) -> None:
    said = run("simulate", "--dry-run", "--size", 256, "--out", tmp_path, "--id", "X").stderr
    # really 22 CPU seconds and 0.45 GiB
    assert "0.0655 km2, 12 images, 3.15 megapixels: about 0.4 GiB of memory and 21 CPU seconds" in said
    assert said.endswith(f"; writes {tmp_path}/X/\n")
    assert list(tmp_path.iterdir()) == []


def test_change_says_it_of_the_earlier_surface(make_town: Callable[[], Scene], tmp_path: Path) -> None:
    heights = make_town().root / "truth/TOWN_DSM.tif"
    said = run("change", heights, heights, "--out", tmp_path / "new", "--dry-run").stderr
    assert f"would compare {heights} with {heights}: 0.0041 km2, 16384 cells: about 0.2 GiB" in said
    assert not (tmp_path / "new").exists()


def test_change_says_nothing_of_a_plan_that_it_cannot_follow(make_town: Callable[[], Scene], tmp_path: Path) -> None:
    scene = make_town()
    heights, fitted = scene.root / "truth/TOWN_DSM.tif", scene.root / "scene.json"
    result = CliRunner().invoke(main, ["change", str(heights), str(fitted), "--out", str(tmp_path / "x"), "--dry-run"])
    assert result.exit_code == 1
    (line,) = result.stderr.splitlines()
    assert "found no product 'dsm', expected a scene after `sattools export`" in line


def test_people_see_it_first_and_programs_only_in_the_log(make_town: Callable[[], Scene]) -> None:
    document = make_town().root / "scene.json"
    first, *_ = run("--progress", "bar", "prior", *QUICK, document).stderr.splitlines()
    assert first.startswith("sattools prior: TOWN: 0.0041 km2, 16384 cells, 6 images: about ")
    for shown in ("json", "none", "auto"):  # the runner's stderr is no terminal
        assert "GiB of memory" not in run("--progress", shown, "prior", *QUICK, "--overwrite", document).stderr
    assert (document.parent / "sattools.log").read_text().count("prior TOWN: 0.0041 km2, 16384 cells") == 4


@pytest.mark.parametrize("plan", [plans.of_export, plans.of_compare, plans.of_align, plans.of_prior(PriorOptions())])
def test_what_a_scene_lacks_is_for_the_command_to_say(town_source: Scene, plan: plans.Plan) -> None:
    scene = Scene.from_json(town_source.to_json())
    scene.grid = None
    assert plan(scene).startswith("writes ")


def test_minutes_are_seconds_while_they_are_few() -> None:
    there = f"(this machine has {cores()} cores)"
    assert takes(2**30, 12.3) == f"about 1.0 GiB of memory and 12 CPU seconds {there}"
    assert takes(2**29, 90) == f"about 0.5 GiB of memory and 1.5 CPU minutes {there}"
    assert takes(0, 3600) == f"about 0.0 GiB of memory and 60 CPU minutes {there}"


@pytest.mark.parametrize(
    ("plan", "shape", "images", "seconds"),
    [
        # measured on one thread, docs/batch.md: 27.1 km2 of three images, and JAX_068
        (plans.of_export, (5207, 5207), 3, 38),
        (plans.of_export, (547, 541), 17, 2.4),
        (plans.of_compare, (5207, 5207), 3, 43),
        (plans.of_align, (5207, 5207), 3, 36),
        # later, on a machine with other work: 0.61 km2 of three images, and JAX_068
        (plans.of_prior(PriorOptions()), (1566, 1562), 3, 91.4),
        (plans.of_prior(PriorOptions()), (547, 541), 17, 38.3),
    ],
)
def test_what_is_said_is_what_was_measured(
    town_source: Scene,
    monkeypatch: pytest.MonkeyPatch,
    plan: plans.Plan,
    shape: tuple[int, int],
    images: int,
    seconds: float,
) -> None:
    scene, told = Scene.from_json(town_source.to_json()), []
    cell, high = (1.0, 91.0) if shape == (5207, 5207) else (0.5, 84.0) if images == 3 else (0.5, 69.3)
    scene.grid, scene.height_range_m = Grid("EPSG:32617", 0.0, 0.0, cell, *shape), (0.0, high)
    item = replace(scene.items[0], properties={})  # of pixels that suit the cells, whatever these are
    monkeypatch.setattr(scene, "train_items", lambda: [item] * images)
    monkeypatch.setattr(plans, "takes", lambda memory, cpu_s: told.append(cpu_s) or "")
    plan(scene)
    assert told[0] == pytest.approx(seconds, rel=0.25)
