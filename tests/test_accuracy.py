"""The errors that docs/accuracy.md, docs/hdr.md and docs/reflectance.md publish, kept: on the real tile, the external
scenes, and of networks on a simulated town.

A limit is the published figure and 3 %, or 0.3 dB: what another version of PyTorch or another processor changes stays
far below that (the same code gives the same figure to the third digit), and what a change of the code gains or loses on
purpose lies above.
"""

import json
import re
from pathlib import Path
from typing import Any

import pytest
import rasterio
from click.testing import CliRunner

from sattools.cli import main


def run(*arguments: object) -> None:
    result = CliRunner().invoke(main, ["--quiet", *map(str, arguments)])
    assert result.exit_code == 0, result.stderr


def errors(scene: Path) -> Any:
    return json.loads((scene.parent / "compare/errors.json").read_text())


def surface(scene: Path, truth: Path) -> Any:
    """Errors of the surface that the defaults make."""
    run("fit", scene)
    run("export", scene)
    run("compare", "--dsm", truth, scene)
    return errors(scene)


def test_the_real_tile(data_dir: Path, tmp_path: Path) -> None:
    contest = data_dir / "dfc2019"
    images = sorted((contest / "Track3-RGB-crops/JAX_068").glob("*.tif"))
    run("prep", *images, "--metadata", contest / "rpc_raw/JAX_068", "--id", "JAX_068", "--out", tmp_path)
    found = surface(tmp_path / "JAX_068/scene.json", contest / "Track3-Truth/JAX_068_DSM.tif")
    assert found["mae"] < 1.03 * 0.962
    assert found["mae_capped_5m"] < 1.03 * 0.696
    assert abs(found["near_steps"]["signed"]) < 0.15  # a gain of one sign by the other is none


@pytest.mark.slow
def test_a_city_of_another_simulator(data_dir: Path, tmp_path: Path) -> None:
    city = data_dir / "external/city_214"
    images = sorted((city / "images").glob("*.tif"))
    run("prep", *images, "--metadata", city / "metadata", "--id", "city_214", "--out", tmp_path)
    found = surface(tmp_path / "city_214/scene.json", city / "truth/JAX_214_DSM.tif")
    assert found["mae"] < 1.03 * 0.495
    assert found["mae_capped_5m"] < 1.03 * 0.385
    assert abs(found["near_steps"]["signed"]) < 0.15  # a gain of one sign by the other is none


@pytest.mark.slow
def test_seven_views_of_that_city(data_dir: Path, tmp_path: Path) -> None:
    """Too few to be robust from the first pass on; three images had been better than these seven."""
    city = data_dir / "external/city_214"
    images = [city / f"images/JAX_214_{k:03d}_RGB.tif" for k in (1, 3, 6, 9, 13, 18, 19)]
    run("prep", *images, "--metadata", city / "metadata", "--id", "city_214", "--out", tmp_path)
    found = surface(tmp_path / "city_214/scene.json", city / "truth/JAX_214_DSM.tif")
    assert found["mae"] < 1.03 * 0.625
    assert found["mae_capped_5m"] < 1.03 * 0.422


@pytest.mark.slow
def test_a_glossy_tower_keeps_its_roof(tmp_path: Path) -> None:
    """Its round roof of 50 m looks different in every image; a piece of 50 m2 had been filled from the podium."""
    run("simulate", "--seed", 3030, "--terrain", "downtown", "--bias-px", 2, "--out", tmp_path)
    city = tmp_path / "SIM_001"
    with rasterio.open(city / "truth/SIM_001_DSM.tif") as truth:
        area = "--crs", truth.crs, "--bounds", *truth.bounds
    images = sorted((city / "images").glob("*.tif"))
    out = tmp_path / "out"
    run("prep", *images, "--metadata", city / "metadata", "--id", "GLOSSY", "--out", out, *area)
    found = surface(out / "GLOSSY/scene.json", city / "truth/SIM_001_DSM.tif")
    assert found["mae"] < 1.03 * 0.661
    assert found["mae_capped_5m"] < 1.03 * 0.412


def ground(data_dir: Path, root: Path, *area: object) -> Path:
    """Steep natural ground with known reflectance, one view held out; with its prior."""
    given = data_dir / "external/natural_12"
    images = sorted((given / "images").glob("*.tif"))
    run("prep", *images, "--metadata", given / "metadata", "--holdout", "HAP_003", "--id", "HAP", "--out", root, *area)
    scene = root / "HAP/scene.json"
    run("normalise", "--quantity", "toa_reflectance", "--scale", 1 / 4095, scene)
    run("prior", scene)
    return scene


def errors_of_ground(data_dir: Path, scene: Path, brdf: str) -> Any:
    """Of the view that was held out, and of what Hapke's model says of the ground."""
    truth = data_dir / "external/natural_12/truth"
    run("fit", "--overwrite", "--brdf", brdf, "--resolution", 2, scene)
    run("export", "--overwrite", "--undetermined", "prior", "--view", "HAP_003", scene)
    maps = [f"--map={name}={truth / name}.tif" for name in ("w", "b", "theta")] if brdf == "hapke" else []
    run("compare", "--overwrite", "--views", "--dsm", truth / "HAP_DSM.tif", *maps, scene)
    return errors(scene)


def test_hapkes_parameters_of_steep_ground_and_a_view_that_was_held_out(data_dir: Path, tmp_path: Path) -> None:
    """Of the middle quarter of the area, in a third of the time; limits: what it had when this was written, and 3 %."""
    middle = "--crs", "EPSG:32719", "--bounds", 586550, 7462750, 586850, 7463050
    found = errors_of_ground(data_dir, ground(data_dir, tmp_path, *middle), "hapke")
    assert found["mae"] < 1.03 * 0.486
    assert found["views"]["HAP_003"]["psnr"] > 45.15 - 0.3
    for name, nrmse in {"w": 0.168, "b": 0.225, "theta": 0.177}.items():
        assert found["parameters"][name]["nrmse"] < 1.03 * nrmse, name


@pytest.fixture(scope="module")
def hills(data_dir: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return ground(data_dir, tmp_path_factory.mktemp("hills"))


@pytest.mark.slow
@pytest.mark.parametrize(("brdf", "psnr"), [("hapke", 42.02), ("rpv", 41.03), ("lambert", 32.92)])
def test_a_view_of_steep_ground_that_was_held_out(data_dir: Path, hills: Path, brdf: str, psnr: float) -> None:
    """As published; of the whole area, which takes a minute for each model."""
    found = errors_of_ground(data_dir, hills, brdf)
    assert found["views"]["HAP_003"]["psnr"] > psnr - 0.3
    for name, nrmse in {"w": 0.160, "b": 0.239, "theta": 0.238}.items() if brdf == "hapke" else ():
        assert found["parameters"][name]["nrmse"] < 1.03 * nrmse, name


@pytest.fixture(scope="module")
def town(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Any]:
    """A simulated town of 64 m in six views, one held out, and the errors of its surface."""
    root = tmp_path_factory.mktemp("town")
    views = ["--views", 7, "--dates", 3, "--test-views", 1]
    run("simulate", "--size", 64, *views, "--seed", 1, "--id", "TOWN", "--out", root)
    scene = root / "TOWN/scene.json"
    run("fit", scene)
    run("export", scene)
    run("compare", scene)
    return scene, errors(scene)


@pytest.mark.parametrize(
    ("network", "psnr"),
    [(("--field", "neural", "--steps", 60), 28.5), (("--preset", "eonerf", "--width", 64, "--steps", 20), 27.2)],
    ids=["neural", "eonerf"],
)
def test_a_network_keeps_the_surface_and_shows_a_view_that_was_held_out(
    town: tuple[Path, Any], network: tuple[object, ...], psnr: float
) -> None:
    """By steps, not seconds: the same on any machine. The fitted surface has 0.594 m and 27.2 dB.

    It had 0.563 m before images got their tone curves band by band, which is better on larger towns and the same in the
    mean of eight of this kind.
    """
    scene, surface_errors = town
    assert surface_errors["mae"] < 1.03 * 0.594
    run("fit", "--overwrite", *network, scene)
    run("export", "--overwrite", "--view", "TOWN_002", scene)
    run("compare", "--overwrite", "--views", scene)
    found = errors(scene)
    assert found["mae"] < 1.03 * surface_errors["mae"]
    assert abs(found["shift_m"][2] - surface_errors["shift_m"][2]) < 0.05  # it neither sinks nor rises
    assert found["views"]["TOWN_002"]["psnr"] > psnr - 0.3
    history = json.loads(scene.read_text())["sattools"]["history"]
    (note,) = next(entry["notes"] for entry in reversed(history) if entry["command"] == "fit")
    change = re.search(r"change the error of held-out rays by ([+-][\d.]+) %", note)
    assert change is not None, note
    assert abs(float(change[1])) < 1.0  # of heights of its own, which it may not have kept
    assert ("; its colours alone from step 10 on" in note) == ("eonerf" in network)
