"""The page: complete, self-contained, honest about what is missing, and sound in a real browser."""

import json
import re
import shutil
import subprocess
from html import escape
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from click.testing import CliRunner
from patience import HANGING_S
from towns import copied

from sattools.batch.table import write_tables
from sattools.cli import main
from sattools.report.batch import batch_page
from sattools.report.commands import pipeline
from sattools.report.page import Section, render
from sattools.report.scene import scene_page
from sattools.scene import Scene
from sattools.scene.grid import Grid
from sattools.scene.raster import write_cog

BROWSERS = ("chromium", "chromium-browser", "google-chrome", "chrome")


# of a browser in a test: no network of its own, nothing that asks or waits
FLAGS = (
    *("--headless", "--no-sandbox", "--disable-gpu", "--disable-dev-shm-usage", "--disable-quic", "--no-first-run"),
    *("--disable-background-networking", "--disable-component-update", "--disable-sync"),
    *("--enable-logging=stderr", "--v=0", "--virtual-time-budget=5000", "--dump-dom"),
)


@pytest.fixture
def opened(tmp_path_factory: pytest.TempPathFactory) -> Any:
    """Opens a page in a real browser with a fresh profile: its document afterwards, and what was said."""
    browser = next(filter(None, map(shutil.which, BROWSERS)), None)
    if browser is None:
        pytest.skip("no Chromium or Chrome on this machine")

    def call(page: Path) -> tuple[str, list[str]]:
        profile = tmp_path_factory.mktemp("profile")
        command = [browser, *FLAGS, f"--user-data-dir={profile}", page.as_uri()]
        done = subprocess.run(command, capture_output=True, text=True, timeout=HANGING_S)
        # what pages say goes to the log as INFO:CONSOLE; the browser's own troubles on a bare machine do not
        return done.stdout, [line for line in done.stderr.splitlines() if "CONSOLE" in line]

    return call


class Page(HTMLParser):
    """What a page shows, and everything that it would load."""

    def __init__(self, text: Any) -> None:
        super().__init__()
        self.images, self.headings, self.captions, self.loaded, self.open, self.links = [], [], [], [], [], []
        self.text = ""
        self.feed(text)

    def handle_starttag(self, tag: Any, attributes: Any) -> None:
        values = dict(attributes)
        if tag == "img":
            self.images.append(values)
        if tag == "a" and not values["href"].startswith("#"):
            self.links.append(values["href"])  # followed by a reader, not loaded
            return
        self.loaded += [values[name] for name in ("src", "href") if name in values]
        self.open.append(tag)
        if tag == "figcaption":
            self.captions.append("")

    def handle_data(self, data: Any) -> None:
        self.text += data
        if self.open and self.open[-1] == "h2":
            self.headings.append(data)
        if self.open and self.open[-1] == "figcaption":
            self.captions[-1] += data

    def handle_endtag(self, tag: Any) -> None:
        if tag in self.open:
            del self.open[len(self.open) - 1 - self.open[::-1].index(tag) :]


def run(*arguments: Any, text: Any = None) -> Any:
    return CliRunner().invoke(main, ["report", *map(str, arguments)], input=text)


def with_results(scene: Scene) -> Scene:
    """A scene with maps, a trace, errors, an adjustment and a name that HTML could mistake for a tag."""
    grid, rng = scene.require_grid(), np.random.default_rng(0)
    for name, bands in (("dsm", 1), ("dsm_std", 1), ("albedo", 3), ("theta", 1), ("difference", 1)):
        write_cog(scene.output(f"export/{name}.tif"), rng.random((bands, *grid.shape), np.float32), grid)
        scene.products[name] = f"export/{name}.tif"
    errors = {"mae": 1.25, "median": 0.5, "rmse": 2.0, "nmad": 0.4, "cells": 900, "completeness": 1.0, "within_1m": 0.8}
    errors |= {"protocol": "dsm", "reference": "<b>LIDAR</b>", "mask": "all", "shift_m": [0.5, 0.0, -1.0]}
    errors |= {"slopes": [{"from_deg": 0.0, "to_deg": 5.0, "mae": 1.0, "median": 0.5, "n": 50}]}
    errors |= {"classes": {"trees": {"mae": 3.25, "median": 2.0, "rmse": 4.0, "nmad": 1.0, "n": 80}}}
    codes = rng.integers(0, 3, (1, *grid.shape)).astype(np.uint8)
    write_cog(scene.output("export/validity.tif"), codes, grid)
    scene.products["validity"] = "export/validity.tif"
    scene.output("compare/errors.json").write_text(json.dumps(errors))
    scene.output("fit/trace.csv").write_text("seconds,loss,mae_m\n1.0,0.5,2.0\n2.0,0.25,1.5\n")
    scene.products |= {"errors": "compare/errors.json", "trace": "fit/trace.csv"}
    view = {"id": "TOWN_001", "median_before_px": 0.9, "median_after_px": 0.1}
    view["residuals"] = rng.random((20, 4)).tolist()
    pair = {"images": ["TOWN_001", "TOWN_002"], "angle_deg": 21.5, "tie_points": 5, "before_px": 0.9, "after_px": 0.1}
    adjustment = {"observations": 10, "ground_points": 5, "median_before_px": 0.9, "median_after_px": 0.1}
    (scene.root / "adjustment.json").write_text(
        json.dumps(adjustment | {"model": "shift", "views": [view], "pairs": [pair]})
    )
    entry = {"command": "fit", "options": {"seed": 7}, "seconds": 2.0, "peak_memory_mb": 300.0, "versions": {}}
    scene.history.append(entry)
    (scene.root / "scene.json").write_text(scene.to_json())
    return scene


@pytest.fixture
def finished(make_town: Any) -> Scene:
    return with_results(make_town("TOWN"))


@pytest.fixture(scope="module")
def reported(town_source: Scene, tmp_path_factory: pytest.TempPathFactory) -> Scene:
    """Such a scene with its page, to be looked at only."""
    scene = with_results(copied(town_source, tmp_path_factory.mktemp("reported") / "TOWN"))
    result = run(scene.root)
    assert result.exit_code == 0, result.output
    assert result.stdout == f"{scene.root}/report.html\n"
    return scene


def check_self_contained(page: Any) -> None:
    assert all(image["alt"] for image in page.images)
    assert all(image["src"].startswith("data:image/png;base64,") for image in page.images)
    assert [name for name in page.loaded if not name.startswith(("data:", "#"))] == []
    assert len(page.captions) == len(page.images)
    assert all(caption.strip() for caption in page.captions)


@pytest.mark.drawn
def test_a_scenes_page_shows_all_that_is_known(reported: Scene) -> None:
    page = Page((reported.root / "report.html").read_text())
    check_self_contained(page)
    assert page.headings == [
        *("Images", "Camera adjustment", "Radiometry", "Surface", "Errors", "Maps", "Fit", "Files", "How it was made")
    ]
    # footprints, directions, residuals (twice), histograms, heights, validity, differences, errors by class and slope,
    # error against time, three maps, training
    assert len(page.images) == 14
    assert {"export/dsm.tif", "compare/errors.json"} <= set(page.links)
    assert all((reported.root / link).is_file() for link in page.links)
    assert "<b>LIDAR</b>" in page.text  # as text, not as a tag
    for words in (
        "1.250",
        "3.250",
        "roughness theta [degrees]",
        "median 0.90 pixels before, 0.10 after",
        "--seed 7",
        "21.5",
    ):
        assert words in page.text


def test_what_a_scene_does_not_have_is_left_out(make_town: Any) -> None:
    scene = make_town("TOWN")
    for item in scene.items:
        item.assets.clear()
    scene.history.clear()
    result = run("--out", scene.root / "page.html", text=scene.to_json())
    assert result.exit_code == 0, result.output
    assert Page((scene.root / "page.html").read_text()).headings == ["Images", "Files"]  # the truth of the town


def test_the_page_links_the_log(make_town: Any) -> None:
    scene = make_town("TOWN")
    (scene.root / "sattools.log").write_text("x")
    assert run(scene.root).exit_code == 0
    assert "sattools.log" in Page((scene.root / "report.html").read_text()).links


def test_a_folder_of_something_else_is_told_what_is_looked_for(tmp_path: Path) -> None:
    """It was a `scene.json` with "No such file or directory" in it."""
    refused = run(tmp_path)
    assert refused.exit_code == 1
    assert f"{tmp_path}: found a folder without scene.json, table.csv and evaluation.json, expected" in refused.stderr


def test_an_existing_page_is_kept_unless_it_may_be_replaced(finished: Any) -> None:
    page = finished.root / "report.html"
    assert run(finished.root).exit_code == 0
    page.write_text(page.read_text() + "<!-- mine -->")
    refused = run(finished.root)
    assert refused.exit_code == 1
    assert "exists already; give --overwrite" in refused.stderr
    assert page.read_text().endswith("<!-- mine -->")
    assert run(finished.root, "--overwrite").exit_code == 0
    assert not page.read_text().endswith("<!-- mine -->")


@pytest.fixture
def batch(tmp_path: Path) -> Any:
    rows = [
        {"scene": scene, "configuration": name, "status": "done", "seconds": seconds, "mae_m": error}
        for scene, name, seconds, error in (("A", "fast", 10.0, 2.0), ("A", "slow", 60.0, 1.0))
    ]
    rows.append({"scene": "B", "configuration": "fast", "status": "missing", "error": "found no <images>"})
    write_tables(rows, tmp_path)
    folder = tmp_path / "runs/fast/A"
    folder.mkdir(parents=True)
    (folder / "config.toml").write_text("[fit]\nseed = 3\n")
    (folder / "log.txt").write_text("$ sattools fit scene.json\nsaid something\n")
    return tmp_path


@pytest.mark.drawn
def test_a_batchs_page_shows_the_table_the_front_and_the_commands(batch: Any) -> None:
    result = run(batch)
    assert result.exit_code == 0, result.output
    page = Page((batch / "report.html").read_text())
    check_self_contained(page)
    assert page.headings == ["Error against time", "Results", "How it was made"]
    for words in ("MAE [m]", "2.000", "found no <images>", "seed = 3", "sattools fit scene.json"):
        assert words in page.text
    assert "said something" not in page.text


def test_a_batchs_page_shows_nothing_that_an_earlier_run_has_left_in_the_folder(batch: Any, finished: Any) -> None:
    """A map of errors and commands of before, where the configuration has changed since."""
    folder = batch / "runs/fast/A"
    for name in ("dsm", "difference"):
        (folder / "export").mkdir(exist_ok=True)
        shutil.copy(finished.root / f"export/{name}.tif", folder / "export")
    (folder / "compare").mkdir()
    shutil.copy(finished.root / "export/difference.tif", folder / "compare")
    del finished.products["difference"]
    (folder / "scene.json").write_text(finished.to_json(root="."))
    calls = ["normalise", "fit --seed 1", "export", "compare", "fit --seed 2", "fit --seed 2", "export"]
    (folder / "log.txt").write_text("".join(f"$ sattools --threads 1 {call} scene.json\n" for call in calls))
    page = batch_page(batch)
    assert "A, fast: surface model" in page
    assert "A, fast: registered surface minus reference" not in page
    assert re.findall("--threads 1 (.*) scene.json", Page(page).text) == ["fit --seed 2", "export"]


@pytest.mark.parametrize("text", ["", "a,b\n1,2\n", "scene,configuration,status,seconds,mae_m\n../x,fast,done,1,2\n"])
def test_a_table_that_is_none_is_one_line_on_stderr(tmp_path: Path, text: Any) -> None:
    (tmp_path / "table.csv").write_text(text)
    result = run(tmp_path)
    assert result.exit_code == 1
    assert result.stderr.startswith("sattools report: error:")
    assert result.stderr.count("\n") == 1


def test_the_same_again_is_told_without_what_was_done_in_vain(finished: Any) -> None:
    """`fit` stood before the `normalise` that it was run again for, with the prior and the notes of before."""
    seconds = {"seconds": 100.0}
    finished.history = [
        {"command": "prior", "options": {"step": 0.5}, **seconds},
        {"command": "fit", "options": {"brdf": "hapke"}, "notes": ["amplitudes are relative"], **seconds},
        {"command": "normalise", "options": {"black": [40.0]}, "seconds": 1.0},
        {"command": "fit", "options": {"seed": 2}, "notes": ["heights are the prior's"], "seconds": 2.0},
        {"command": "export", "options": {}, "seconds": 0.5},
    ]
    assert pipeline(finished.history) == (
        "sattools normalise --black 40.0 |\n    sattools fit --seed 2 |\n    sattools export"
    )
    page = Page(scene_page(finished)).text
    assert "heights are the prior's" in page
    assert "amplitudes are relative" not in page


def test_images_that_were_set_aside_are_not_said_to_be_held_out(finished: Any) -> None:
    finished.items[0].properties["sattools:role"] = "unused"
    finished.items[1].properties["sattools:fit_role"] = "test"
    roles = re.findall(r"<td[^>]*>(train|test|unused)</td>", scene_page(finished))
    assert roles == ["unused", "test", *["train"] * (len(finished.items) - 2)]


@pytest.mark.drawn
def test_pages_open_in_a_browser_without_a_broken_image_or_an_error(
    reported: Scene, batch: Any, opened: Any, tmp_path: Path
) -> None:
    assert run(batch).exit_code == 0
    # a page that loads both in frames would need a policy of its own: each is opened by itself, a probe added at its
    # end; the page itself holds no script
    for path in (reported.root / "report.html", batch / "report.html"):
        text = path.read_text()
        assert "<script" not in text
        probe = (
            "<script>window.onload = () => { const all = [...document.images]; "
            "const bad = all.filter(i => !i.complete || !i.naturalWidth); "
            "document.title = `${all.length} images, ${bad.length} broken`; }"
            "</script>"
        )
        open_policy = text.replace("style-src 'unsafe-inline'", "style-src 'unsafe-inline'; script-src 'unsafe-inline'")
        probed = tmp_path / "probed.html"
        probed.write_text(open_policy.replace("</body>", probe + "</body>"))
        for page, words in ((path, "<title>"), (probed, f"<title>{text.count('<img ')} images, 0 broken</title>")):
            document, said = opened(page)
            assert words in document
            assert said == []


def test_a_broken_image_and_a_script_error_would_be_noticed(tmp_path: Path, opened: Any) -> None:
    """The probe above must be able to fail."""
    page = render("bad", [Section("x", ["y"])]).replace(
        "</body>", '<script src="http://localhost/x.js"></script></body>'
    )
    path = tmp_path / "bad.html"
    path.write_text(page)
    _, said = opened(path)
    assert any("Content Security Policy" in line for line in said)


def test_the_cells_that_it_names_are_those_of_the_file_not_of_the_picture(finished: Any) -> None:
    grid = Grid("EPSG:32617", 436500.0, 3357800.0, 0.5, 800, 700)  # more cells than a picture shows
    write_cog(finished.output("export/dsm.tif"), np.zeros(grid.shape, np.float32), grid)
    assert run(finished.root).exit_code == 0
    assert "cells of 0.5 m, drawn as means over 1 m." in Page((finished.root / "report.html").read_text()).text


def test_a_batchs_heights_are_those_after_align_and_above_what_their_files_say(
    batch: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    from sattools.export import hillshade

    scene = Scene("A", batch / "runs/fast/A")
    scene.grid = Grid("EPSG:32617", 436500.0, 3357800.0, 1.0, 30, 20)
    for place, height in (("export/dsm.tif", 0.0), ("align/1/dsm.tif", 31.0)):
        heights = np.full(scene.grid.shape, height, np.float32)
        write_cog(scene.output(place), heights, scene.grid, tags={"VERTICAL_DATUM": "EGM96 geoid"})
    scene.products["dsm"] = "align/1/dsm.tif"
    scene.write()
    said, shown, picture = [], [], hillshade.picture

    def noted(*arguments: Any) -> Any:
        figure = picture(*arguments)
        said.extend(axes.get_ylabel() for axes in figure.axes)
        shown.append(float(arguments[0].mean()))
        return figure

    monkeypatch.setattr(hillshade, "picture", noted)
    assert run(batch).exit_code == 0
    assert "height above the EGM96 geoid [m]" in said
    assert shown == [31.0]


@pytest.mark.drawn
def test_a_page_of_many_maps_is_small(make_town: Any) -> None:
    scene = make_town()
    grid = scene.require_grid()
    rng = np.random.default_rng(1)
    for name in ("albedo", "w", "b", "c", "theta", "dsm_std", "probability", "rho0", "k", "rhoc"):
        write_cog(scene.output(f"export/{name}.tif"), rng.random((3, *grid.shape), np.float32), grid)
        scene.products[name] = f"export/{name}.tif"
    (scene.root / "scene.json").write_text(scene.to_json())
    assert run(scene.root).exit_code == 0
    assert (scene.root / "report.html").stat().st_size < 3_000_000  # noise packs worse than any map


@pytest.mark.drawn
@pytest.mark.parametrize(("width", "columns"), [(390, 1), (1600, 2)])
def test_a_page_fits_a_phone_and_uses_a_wide_screen(
    reported: Scene, opened: Any, tmp_path: Path, width: int, columns: int
) -> None:
    text = (reported.root / "report.html").read_text()
    page = tmp_path / "frame.html"
    asked = "getComputedStyle(d.querySelector('.parts')).gridTemplateColumns.split(' ').length"
    wide = "d.documentElement.scrollWidth"
    wraps = "d.querySelector('nav').scrollWidth <= d.querySelector('nav').clientWidth"
    script = (
        "<script>function look() { const d = document.querySelector('iframe').contentDocument;"
        f"document.title = [{asked}, {wide}, {wraps}].join(); }}</script>"
    )
    frame = f'<iframe width="{width}" height="800" style="border:0" onload="look()" srcdoc="{escape(text)}"></iframe>'
    page.write_text(f"<!DOCTYPE html><html><body>{script}{frame}</body></html>")
    document, said = opened(page)
    found, page_width, nav = re.search(r"<title>(.*?)</title>", document)[1].split(",")
    assert (int(found), nav) == (columns, "true"), said
    assert int(page_width) <= width
