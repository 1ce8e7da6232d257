"""What a fit looks at before its first epoch: a reference of another place, values that come in pairs, few cells."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from click.testing import CliRunner
from PIL import Image

from sattools.cli import main
from sattools.errors import InputError
from sattools.fit.checkpoint import load
from sattools.fit.inputs import check_reference
from sattools.fit.options import FitOptions
from sattools.fit.stage import check_start, fit
from sattools.scene import Grid, Scene
from sattools.scene.raster import raster_grid, write_cog

QUICK = FitOptions(resolution=2.0, epochs=[1])


def test_a_reference_of_another_place_is_refused_before_anything_is_done(make_town: Any, tmp_path: Path) -> None:
    """It ended the fit after its first epoch, without a word of which file it was."""
    scene = make_town()
    own = scene.require_grid()
    write_cog(tmp_path / "far.tif", np.zeros((8, 8), np.float32), Grid(own.crs, own.left + 5000.0, own.top, 1.0, 8, 8))
    for begin in (check_start, fit):
        with pytest.raises(InputError, match=r"far.tif: found no ground of scene TOWN, expected a --reference of its"):
            begin(scene, replace(QUICK, reference=str(tmp_path / "far.tif")))
    assert not list(scene.root.glob("fit/*"))


def test_a_reference_without_a_place_is_refused_before_anything_is_done(make_town: Any, tmp_path: Path) -> None:
    scene = make_town()
    Image.fromarray(np.zeros((8, 8), np.float32)).save(tmp_path / "bare.tif")
    for begin in (check_start, fit):
        with pytest.raises(InputError, match=r"bare.tif: found no coordinate reference system, expected a georef"):
            begin(scene, replace(QUICK, reference=str(tmp_path / "bare.tif")))
    assert not list(scene.root.glob("prior/*"))


def test_a_class_map_is_no_reference(make_town: Any, tmp_path: Path) -> None:
    """A fit was watched by the codes of ground, trees and buildings as if they were metres."""
    scene = make_town()
    own = scene.require_grid()
    codes = np.full(own.shape, 2, np.uint8)
    codes[:20, :20], codes[40:, :20] = 5, 6
    write_cog(tmp_path / "classes.tif", codes, own, nodata=None)
    for begin in (check_start, fit):
        with pytest.raises(InputError, match=r"classes.tif: found class codes \(2, 5, 6\), expected heights"):
            begin(scene, replace(QUICK, reference=str(tmp_path / "classes.tif")))
    assert not list(scene.root.glob("prior/*"))


@pytest.mark.parametrize("crs", ["EPSG:32617", "EPSG:4326"])
def test_a_reference_of_a_part_of_the_area_is_watched(make_town: Any, tmp_path: Path, crs: str) -> None:
    scene = make_town()
    truth = scene.path(scene.products["truth_dsm"])
    grid = raster_grid(truth)
    part = grid.part(slice(0, 60), slice(0, 60))
    if crs == "EPSG:4326":
        from sattools.camera.ground import to_geographic

        lon, lat = to_geographic(grid.crs, np.array([grid.left]), np.array([grid.top]))
        part = Grid(crs, float(lon[0]), float(lat[0]), 5e-6, 50, 50)
    write_cog(tmp_path / "part.tif", np.add.outer(np.arange(part.height), np.arange(part.width)).astype("f4"), part)
    fit(scene, replace(QUICK, reference=str(tmp_path / "part.tif")))
    assert (scene.root / "fit/trace.csv").read_text().startswith("seconds,stage,cell_m,epoch,softness_m,loss,mae_m\n")


@pytest.mark.parametrize("west", [179.9995, -180.0003])
def test_a_reference_at_the_date_line_is_taken(tmp_path: Path, west: float) -> None:
    """West of it a degree is 180, east of it -180."""
    zone = Grid("EPSG:32701", 180172.0, 8140199.0, 1.0, 100, 100)  # of 179.9999 degrees west, 16.8 south
    there, beside = tmp_path / "fiji.tif", tmp_path / "beside.tif"
    write_cog(there, np.zeros((50, 200), np.float32), Grid("EPSG:4326", west, -16.7999, 1e-5, 200, 50))
    write_cog(beside, np.zeros((50, 200), np.float32), Grid("EPSG:4326", west + 0.01, -16.7999, 1e-5, 200, 50))
    check_reference(Scene("FIJI", tmp_path, grid=zone), str(there))
    with pytest.raises(InputError, match=r"beside\.tif: found no ground of scene FIJI"):
        check_reference(Scene("FIJI", tmp_path, grid=zone), str(beside))


@pytest.mark.parametrize(("left", "there"), [(278.335, True), (278.345, False)])
def test_longitudes_of_a_reference_may_run_from_0_to_360(tmp_path: Path, left: float, there: bool) -> None:
    scene = Scene("JAX", tmp_path, grid=Grid("EPSG:32617", 436000.0, 3357800.0, 1.0, 80, 60))  # 81.666 degrees west
    write_cog(tmp_path / "lidar.tif", np.zeros((90, 90), np.float32), Grid("EPSG:4326", left, 30.351, 1e-5, 90, 90))
    if there:
        check_reference(scene, str(tmp_path / "lidar.tif"))
    else:
        with pytest.raises(InputError, match="found no ground of scene JAX"):
            check_reference(scene, str(tmp_path / "lidar.tif"))


@pytest.mark.parametrize(("given", "found"), [(["1"], "1"), (["1", "0.5", "0.25"], "1 0.5 0.25")])
def test_softness_is_given_twice(given: list[str], found: str) -> None:
    result = CliRunner().invoke(main, ["fit", *(f"--softness={length}" for length in given)])
    assert result.exit_code == 2
    words = f"--softness: found {found}, expected two numbers, of the start and the end of a stage: --softness 1.5"
    assert words in " ".join(result.stderr.split())


@pytest.mark.parametrize(("coarsest", "told"), [(0.5, True), (2.0, False), (8.0, False)])
def test_a_coarsest_cell_below_the_finest_is_told(
    make_town: Any, caplog: pytest.LogCaptureFixture, coarsest: float, told: bool
) -> None:
    check_start(make_town(), replace(QUICK, coarsest=coarsest))
    line = "--coarsest does nothing here: found 0.5 m, expected more than the finest cell, 2 m"
    assert (line in caplog.messages) == told


def test_two_by_two_cells_are_fitted(make_town: Any) -> None:
    scene = make_town()
    fit(scene, replace(QUICK, resolution=32.0, prior_weight=0.0))
    assert load(scene.root / "fit/model.safetensors")[0]["height"].shape == (2, 2)
