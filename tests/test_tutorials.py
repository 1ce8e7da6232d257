"""The tutorials' lines run, on smaller areas than the pages', and leave what the pages say."""

import json
import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import rasterio

ROOT = Path(__file__).parents[1]
PAGES = ROOT / "docs/tutorials"
DATA = os.environ.get("SATTOOLS_DATA")
needs_data = pytest.mark.skipif(DATA is None, reason="SATTOOLS_DATA is not set")


def lines(page: str, language: str = "bash", **settings: str) -> str:
    """The page's code, with other settings: every one of them has to be there."""
    text = (PAGES / f"{page}.md").read_text(encoding="utf-8")
    code = "\n".join(re.findall(rf"(?ms)^```{language}\n(.*?)^```", text))
    for name, value in settings.items():
        code, count = re.subn(rf"(?m)^{name}=.*$", lambda _, line=f'{name}="{value}"': line, code)
        assert count == 1, name
    return code


def run(page: str, folder: Path, program: Path = Path(sys.executable).parent, **settings: str) -> str:
    """Run a page's lines in a folder, with the `sattools` of another one; returns what they printed."""
    path = f"{program}:{os.environ['PATH']}"
    done = subprocess.run(
        ["bash", "-euo", "pipefail", "-c", lines(page, **settings)],
        cwd=folder, env={**os.environ, "PATH": path}, capture_output=True, text=True,
    )  # fmt: skip
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


def share_with_data(path: Path) -> float:
    with rasterio.open(path) as file:
        return float(np.isfinite(file.read(1, masked=True).filled(np.nan)).mean())


@needs_data
def test_the_stereo_pair_becomes_a_surface_points_and_an_orthophoto(tmp_path: Path, quick_program: Path) -> None:
    images = Path(str(DATA)) / "pleiades/marseille_triplet"
    pair = f"{images}/img_01.tif {images}/img_03.tif"
    run("pleiades", tmp_path, quick_program, IMAGES=pair, AREA="5.4405 43.2605 5.4417 43.2614")
    export = tmp_path / "work/QUARRY/export"
    assert share_with_data(export / "dsm.tif") > 0.8
    for name in ("points.laz", "ortho.tif", "validity.tif", "contours.gpkg"):
        assert (export / name).is_file()
    assert (tmp_path / "work/QUARRY/report.html").is_file()


@pytest.mark.slow
@needs_data
def test_the_city_of_many_dates_is_scored_against_lidar(tmp_path: Path) -> None:
    root = Path(str(DATA)) / "dfc2019"
    said = run("city", tmp_path, ROOT=str(root), AREA="--bounds -81.6645 30.3484 -81.6637 30.3492")
    errors = json.loads((tmp_path / "errors.json").read_text())
    assert errors["protocol"] == "dfc2019"
    # all images of the page: 0.18 to 0.25 m wherever the height planes begin; of four of them it was 0.52 to 0.77 m
    assert errors["median"] < 0.35
    assert "JAX_068_016_RGB: camera was off by" in said  # `info` shows the notes
    assert "Map of the height differences" in (tmp_path / "work/JAX_068/report.html").read_text()


def test_the_deserts_parameters_are_scored_against_the_truth(tmp_path: Path, quick_program: Path) -> None:
    run("desert", tmp_path, quick_program, SIZE="96", VIEWS="8", EPOCHS="4")
    errors = json.loads((tmp_path / "errors.json").read_text())
    assert errors["parameters"]["w"]["correlation"] > 0.8
    assert {"w", "theta"} <= set(errors["parameters"])


@pytest.mark.slow  # tests/prep/test_colours.py has the same of a smaller town
def test_colours_come_from_the_multispectral_images(tmp_path: Path) -> None:
    run("pansharpening", tmp_path, SIZE="64")
    with rasterio.open(tmp_path / "work/COLOURED/export/ortho.tif") as ortho:
        assert ortho.descriptions == ("colour red", "colour green", "colour blue")


@pytest.mark.slow
def test_the_batch_compares_two_configurations_of_two_areas(tmp_path: Path) -> None:
    pytest.importorskip("distributed")
    run("batch", tmp_path, SIZE="48", LONG="5")
    rows = (tmp_path / "results/table.csv").read_text().splitlines()
    assert len(rows) == 5
    assert all(",done," in row for row in rows[1:])
    assert (tmp_path / "results/report.html").is_file()


@pytest.mark.qgis
@pytest.mark.skipif(shutil.which("qgis_process.bin") is None, reason="QGIS is not installed")
def test_qgis_without_a_window_makes_the_same(
    tmp_path: Path, quick_program: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "runtime").mkdir(mode=0o700)
    for name in [n for n in os.environ if n.startswith(("PYTHON", "QT_", "GDAL_", "PROJ_", "LD_"))]:
        monkeypatch.delenv(name)
    monkeypatch.setenv("PATH", f"/usr/bin:/bin:{quick_program}")
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path / "runtime"))
    monkeypatch.setenv("QGIS_CUSTOM_CONFIG_PATH", str(tmp_path / "profile"))
    monkeypatch.setenv("QGIS_PLUGINPATH", str(ROOT / "qgis_plugin"))
    monkeypatch.setenv("QGIS_PROCESS", "qgis_process.bin")
    done = subprocess.run(
        ["bash", "-euo", "pipefail", "-c", lines("qgis", SIZE="48")], cwd=tmp_path, capture_output=True, text=True
    )
    assert done.returncode == 0, done.stdout + done.stderr
    assert share_with_data(tmp_path / "work/FROM_QGIS/export/dsm.tif") > 0.8
    with rasterio.open(tmp_path / "work/FROM_QGIS/export/dsm.tif") as file:
        assert file.res == (1.0, 1.0)


@pytest.mark.drawn
def test_the_notebook_page_runs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("xarray")
    import matplotlib

    matplotlib.use("agg")
    monkeypatch.chdir(tmp_path)
    names: dict = {}
    exec(compile(lines("notebook", "python"), "notebook.md", "exec"), names)  # noqa: S102
    assert (tmp_path / "notebook/hill.jpg").is_file()
    assert names["errors"]["completeness"] > 0.9


def test_every_tutorial_is_in_the_table_and_in_the_site() -> None:
    pages = {page.name for page in PAGES.glob("*.md")} - {"index.md"}
    table = (PAGES / "index.md").read_text(encoding="utf-8")
    site = (ROOT / "mkdocs.yml").read_text(encoding="utf-8")
    assert all(f"({page})" in table and f"tutorials/{page}" in site for page in pages)


def test_the_pages_and_their_pictures_are_small() -> None:
    pictures = list((ROOT / "docs/images/tutorials").iterdir())
    assert pictures
    assert all(picture.stat().st_size < 250_000 for picture in pictures)
