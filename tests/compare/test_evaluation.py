"""Several fits of one place side by side."""

import csv
import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from click.testing import CliRunner

from sattools.cli import main
from sattools.compare.brdf import Place, brdf_figure, directions, errors, place_in, place_of, unit_vector
from sattools.compare.metrics import MAP_FIGURES
from sattools.errors import InputError
from sattools.reflectance import hapke
from sattools.scene import Asset, Grid, Item, Scene
from sattools.scene.raster import write_cog

GRID = Grid("EPSG:32633", 500000.0, 5000040.0, 1.0, 40, 40)
TRUTH = {"w": (0.3, 0.4, 0.5), "b": (0.2,), "c": (0.6,), "theta": (20.0,)}


def image(values: Any) -> np.ndarray:
    return np.broadcast_to(np.asarray(values, np.float32)[:, None, None], (len(values), *GRID.shape)).copy()


def scene_with(folder: Path, products: dict[str, Any], rendered: float) -> str:
    scene = Scene("NAT", folder, grid=GRID)
    heights = np.zeros(GRID.shape, np.float32)
    heights[10:20, 5:25] = 6
    for name, array in {"dsm": heights[None] + 0.5, **{k: image(v) for k, v in products.items()}}.items():
        write_cog(scene.output(f"export/{name}.tif"), array, GRID)
        scene.products[name] = f"export/{name}.tif"
    write_cog(scene.output("rendered.tif"), image((0.2, 0.3, 0.4)) + rendered, GRID)
    for k, role in enumerate(("train", "train", "test")):
        properties = {
            "view:sun_azimuth": 120.0, "view:sun_elevation": 50.0, "view:azimuth": 10.0, "view:off_nadir": 10.0 * k,
            "sattools:role": role, "sattools:radiance": "reflectance_factor",
        }  # fmt: skip
        write_cog(scene.output(f"radiance_{k}.tif"), image((0.2, 0.3, 0.4)), GRID)
        assets = {"radiance": Asset(f"radiance_{k}.tif")} | ({"rendered": Asset("rendered.tif")} if k == 2 else {})
        scene.items.append(Item(f"NAT_{k}", geometry=None, bbox=None, properties=properties, assets=assets))
    return str(scene.write())


def inputs(folder: Path) -> list[str]:
    """The command on three fits: Hapke 10 % off in w and 5 degrees in theta, RPV, Lambert."""
    fits = {
        "Hpk": scene_with(folder / "a", {**TRUTH, "w": (0.33, 0.44, 0.55), "theta": (25.0,)}, 0.01),
        "RPV": scene_with(
            folder / "b", {"rho0": (0.1, 0.1, 0.1), "k": (0.9,), "asymmetry": (-0.1,), "rhoc": (0.8,)}, 0.02
        ),
        "Lam": scene_with(folder / "c", {"albedo": (0.1, 0.2, 0.3)}, 0.1),
    }
    heights = np.zeros(GRID.shape, np.float32)
    heights[10:20, 5:25] = 6
    write_cog(folder / "truth_dsm.tif", heights, GRID)
    arguments = ["compare", "--register", "none", "--dsm", str(folder / "truth_dsm.tif"), "--views"]
    for name, values in TRUTH.items():
        write_cog(folder / f"{name}.tif", image(values), GRID)
        arguments += ["--map", f"{name}={folder / name}.tif"]
    (folder / "points.csv").write_text("name,x,y,w_1\nmeadow,500010.5,5000010.5,0.22\nscree,500030.5,5000020.5,\n")
    for name, path in fits.items():
        arguments += ["--fit", f"{name}={path}"]
    return arguments


def files(folder: Path) -> dict[Path, bytes]:
    """Those of the fits, with what is in them."""
    return {path: path.read_bytes() for path in folder.glob("[abc]/**/*") if path.is_file()}


@pytest.fixture(scope="module")
def shared(tmp_path_factory: pytest.TempPathFactory) -> list[str]:
    """The command on fits that tests leave as they are."""
    return inputs(tmp_path_factory.mktemp("fits"))


@pytest.fixture(scope="module")
def evaluated(tmp_path_factory: pytest.TempPathFactory) -> Any:
    """The folder of an evaluation with points, to be looked at only, its result, and the fits before and after it."""
    folder = tmp_path_factory.mktemp("evaluated")
    arguments = [*inputs(folder), "--out", str(folder / "eval"), "--points", str(folder / "points.csv")]
    before = files(folder)
    result = CliRunner().invoke(main, arguments)
    return folder / "eval", result, before, files(folder)


@pytest.fixture
def call(shared: list[str], tmp_path: Path) -> Any:
    def run(*more: str) -> Any:
        return CliRunner().invoke(main, [*shared, "--out", str(tmp_path / "eval"), *more])

    return run


@pytest.fixture
def evaluation(evaluated: Any, tmp_path: Path) -> Path:
    """A copy of the evaluation's folder."""
    return Path(shutil.copytree(evaluated[0], tmp_path / "eval"))


@pytest.mark.drawn
def test_tables_and_figures_of_all_fits(evaluated: Any) -> None:
    folder, result, before, after = evaluated
    assert result.exit_code == 0, result.output
    found = json.loads(result.stdout)
    assert found == json.loads((folder / "evaluation.json").read_text())
    assert list(found["fits"]) == ["Hpk", "RPV", "Lam"]
    assert [found["fits"][n]["psnr"] for n in ("Hpk", "RPV", "Lam")] == pytest.approx([40.0, 33.979, 20.0], abs=1e-2)
    assert [f["mae"] for f in found["fits"].values()] == pytest.approx([0.5] * 3)
    # 10 % of three bands over their mean: 0.1 sqrt((9 + 16 + 25) / 3) / 4
    assert found["fits"]["Hpk"]["parameters"]["w"]["nrmse"] == pytest.approx(0.1 * (50 / 3) ** 0.5 / 4, rel=1e-4)
    assert found["fits"]["Hpk"]["parameters"]["theta"]["nrmse"] == pytest.approx(0.25)
    assert found["fits"]["RPV"]["parameters"]["w"]["product"] == "rho0"
    assert set(found["fits"]["RPV"]["parameters"]) == {"w"}
    assert found["fits"]["Lam"]["parameters"] == {}
    # a point's own sample stands before the reference map's: (0.33, 0.44, 0.55) against (0.22, 0.4, 0.5)
    rmse = (((0.33 - 0.22) ** 2 + 0.04**2 + 0.05**2) / 3) ** 0.5
    assert found["points"]["Hpk"]["meadow"]["w"] == pytest.approx(rmse / (1.12 / 3), rel=1e-4)
    assert found["points"]["Hpk"]["scree"]["theta"] == pytest.approx(0.25)
    assert found["brdf"]["sun"] == pytest.approx([120.0, 40.0])
    assert found["brdf"]["views"] == [[10.0, 0.0], [10.0, 10.0]]  # the held-out one was not fitted
    assert found["brdf"]["errors"]["scree"]["Hpk"]["nrmse"] < found["brdf"]["errors"]["scree"]["Lam"]["nrmse"]
    rows = list(csv.DictReader((folder / "views.csv").read_text().splitlines()))
    assert [(row["fit"], round(float(row["psnr"]), 1)) for row in rows] == [("Hpk", 40.0), ("RPV", 34.0), ("Lam", 20.0)]
    rows = list(csv.DictReader((folder / "points.csv").read_text().splitlines()))
    assert len(rows) == 2 * (6 + 3)
    there = {(row["fit"], row["value"], row["product"]) for row in rows if row["value"] in ("w_1", "theta")}
    assert there == {("Hpk", "w_1", "w"), ("Hpk", "theta", "theta"), ("RPV", "w_1", "rho0")}
    assert (folder / "brdf_02.png").read_bytes()[:4] == b"\x89PNG"
    assert "| Hpk | theta | theta | 0.250 |" in (folder / "evaluation.md").read_text()
    assert before
    assert after == before  # scenes are only read


def test_a_fit_that_claims_no_c_has_no_figures_of_it(tmp_path: Path) -> None:
    arguments = [*inputs(tmp_path), "--out", str(tmp_path / "eval"), "--points", str(tmp_path / "points.csv")]
    write_cog(tmp_path / "a/export/c.tif", image((np.nan,)), GRID)
    result = CliRunner().invoke(main, arguments)
    assert result.exit_code == 0, result.output
    found = json.loads(result.stdout)
    assert found["fits"]["Hpk"]["parameters"]["c"] == {"product": "c", **dict.fromkeys(MAP_FIGURES), "n": 0}
    assert "Hpk" not in found["brdf"]["errors"]["scree"]  # no BRF without c
    rows = list(csv.DictReader((tmp_path / "eval/maps.csv").read_text().splitlines()))
    assert [row["nrmse"] for row in rows if (row["fit"], row["map"]) == ("Hpk", "c")] == [""]


def test_a_point_of_which_nothing_is_known_is_told(call: Any, tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    (tmp_path / "points.csv").write_text("name,x,y,w_1\nmeadow,500010.5,5000010.5,\nelsewhere,14.9,45.1,\n")
    result = call("--points", str(tmp_path / "points.csv"))
    assert result.exit_code == 0, result.output
    assert "elsewhere has no value of its own" in caplog.text
    assert "meadow" not in caplog.text  # it has those of the reference maps


def test_a_second_call_replaces_nothing_unasked(call: Any) -> None:
    assert call().exit_code == 0
    again = call()
    assert again.exit_code == 1
    assert "--overwrite" in again.stderr
    assert call("--overwrite").exit_code == 0


def test_the_report_shows_it(evaluation: Path) -> None:
    result = CliRunner().invoke(main, ["report", str(evaluation)])
    assert result.exit_code == 0, result.output
    page = (evaluation / "report.html").read_text()
    assert page.count('alt="Polar plots of the reflectance of') == 2
    assert "avg_geometric" in page


SPOILT: list[Callable[[Any], Any]] = [
    lambda d: d.pop("brdf"),
    lambda d: d["fits"]["Hpk"].update(mae="x"),
    lambda d: d["brdf"]["points"]["scree"]["Hpk"].update(shape=[1]),
    lambda d: d["brdf"]["points"]["scree"]["Hpk"].update(model="phong"),
]


def test_a_spoilt_evaluation_is_one_line(evaluation: Path) -> None:
    path = evaluation / "evaluation.json"
    whole = path.read_text()
    for spoil in SPOILT:
        data = json.loads(whole)
        spoil(data)
        path.write_text(json.dumps(data))
        result = CliRunner().invoke(main, ["report", str(evaluation)])
        assert result.exit_code == 1
        assert result.stderr.count("\n") == 1
        assert "expected" in result.stderr


@pytest.mark.parametrize(
    ("more", "code", "message"),
    [
        (["--fit", "Hpk=x.json"], 2, "'Hpk' twice"),
        (["--fit", "truth=nowhere.json"], 1, "nowhere.json"),
        (["--fit", "nonsense"], 2, "expected NAME=FILE"),
        (["--predicted", "x.tif"], 2, "expected one of them"),
    ],
)
def test_wrong_use(call: Any, more: list[str], code: int, message: str) -> None:
    result = call(*more)
    assert result.exit_code == code
    assert message in result.stderr


def test_tables_without_rows_are_not_printed(tmp_path: Path) -> None:
    path = scene_with(tmp_path / "a", {}, 0.01)
    write_cog(tmp_path / "truth_dsm.tif", np.zeros(GRID.shape, np.float32), GRID)
    given = ["--fit", f"A={path}", "--register", "none", "--dsm", str(tmp_path / "truth_dsm.tif")]
    result = CliRunner().invoke(main, ["compare", *given, "--out", str(tmp_path / "eval")])
    assert result.exit_code == 0, result.output
    assert "| A |" in result.stderr
    assert result.stderr.count("| fit |") == 1


def test_fits_need_a_folder(tmp_path: Path) -> None:
    result = CliRunner().invoke(main, ["compare", "--fit", "a=b"])
    assert result.exit_code == 2
    assert "--out" in result.stderr


def test_the_brf_of_a_place_is_the_model_s() -> None:
    place = Place("hapke", 0.6, (0.3, 0.4, 20.0))
    sun = unit_vector(0.0, 50.0)
    view = unit_vector(90.0, 30.0)  # the golden value of incidence 50, emission 30, azimuth 90
    assert float(place.brf(sun, view)) == pytest.approx(0.146216, abs=1e-6)
    up = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64)
    direct = hapke(up, torch.from_numpy(sun), torch.from_numpy(view), 0.6, 0.3, 0.4, 20.0)
    assert float(place.brf(sun, view)) == float(direct)


def test_errors_count_solid_angles_and_the_images_own_directions() -> None:
    sun = unit_vector(100.0, 40.0)
    truth = Place("lambert", 0.2)
    assert errors(Place("lambert", 0.22), truth, sun, []) == {"nrmse": pytest.approx(0.1), "nrmse_near_views": None}
    # a phase function that is right where the images looked and wrong elsewhere
    bent = Place("rpv", 0.2, (0.5, 0.0, 1.0))
    scale = 0.2 / float(bent.brf(sun, unit_vector(0.0, 0.0)))
    found = errors(Place("rpv", 0.2 * scale, bent.shape), truth, sun, [unit_vector(0.0, 0.0)])
    assert found["nrmse_near_views"] < 0.3 * found["nrmse"]


def test_directions_are_unit_vectors_from_north_clockwise() -> None:
    zenith, azimuth, vectors = directions()
    assert np.linalg.norm(vectors, axis=-1) == pytest.approx(np.ones(vectors.shape[:2]))
    east = vectors[list(zenith).index(30.0), list(azimuth).index(90.0)]
    assert east == pytest.approx([0.5, 0.0, np.sqrt(0.75)])


def test_the_plot_has_a_plain_scale_and_shows_fits_that_agree() -> None:
    place = Place("hapke", 0.6173, (0.3, 0.4, 20.0))
    figure = brdf_figure({"truth": place, "Hpk": place, "Hpk0": place}, (120.0, 40.0), [], "place")
    figure.canvas.draw()
    bar, plane = figure.axes[-2:]
    assert max(len(label.get_text()) for label in bar.get_yticklabels()) <= len("0.25")  # 0.01367 is nothing to read
    assert len({line.get_linestyle() for line in plane.get_lines()[1:]}) == 2


def test_a_place_needs_all_its_maps() -> None:
    values = {name: np.array(v) for name, v in TRUTH.items()}
    assert place_in(values, 1) == Place("hapke", 0.4, (0.2, 0.6, 20.0))
    assert place_in({**values, "c": np.array([np.nan])}, 1) is None
    assert place_in({k: v for k, v in values.items() if k != "b"}, 1) is None
    assert place_in({"albedo": np.array([0.1, 0.2, 0.3])}, 1) == Place("lambert", 0.2)
    assert place_of(Place("lambert", 0.2).to_json(), "x") == Place("lambert", 0.2)
    with pytest.raises(InputError, match="expected model"):
        place_of({"model": "hapke", "amplitude": 0.2, "shape": [0.1]}, "x")
