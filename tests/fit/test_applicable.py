"""Options that do nothing beside the others are told where they are given on the command line or in Python."""

from pathlib import Path
from typing import Any

import pytest
from click.testing import CliRunner

import sattools
from sattools.cli import main
from sattools.errors import SattoolsError, SceneError
from sattools.fit.applicable import NEEDED, without_effect
from sattools.fit.options import FitOptions
from sattools.fit.presets import PRESETS, resolve, with_preset


@pytest.mark.parametrize(
    ("flags", "found"),
    [
        (["--network", "satnerf"], "--field surface, expected --field mlp"),
        (
            ["--guided", "64"],
            "--field surface, expected --field mlp, neural or voxel",
        ),
        (["--field", "voxel", "--width", "32"], "--field voxel, expected --field mlp"),
        (["--precision", "bf16"], "--field surface, expected --field mlp"),
        (["--field", "neural", "--precision", "tf32"], "--field neural, expected --field mlp"),
        (
            ["--preset", "satnerf", "--epochs", "3"],
            "--field mlp, expected --field surface",
        ),
        (
            ["--pretrain", "0.5"],
            "--brdf lambert, expected --brdf rpv, hapke or auto",
        ),
        (
            ["--preset", "hapke-nerf", "--materials", "4"],
            "--brdf hapke and --field mlp",
        ),
        (["--preset", "spsnerf", "--beta"], "--field mlp and --network spsnerf"),
        (
            ["--shadow-weight", "0.1"],
            "--shadow geometric, expected --shadow learned or auto",
        ),
    ],
)
def test_what_does_nothing_is_told_and_the_fit_goes_on(flags: list[str], found: str) -> None:
    result = CliRunner().invoke(main, ["fit", *flags, "--print-config"])
    assert result.exit_code == 0
    (line,) = result.stderr.splitlines()
    option = next(flag for flag in reversed(flags) if flag.startswith("--"))
    assert f"{option} does nothing here: found {found}" in line


@pytest.mark.parametrize(
    "flags",
    [
        ["--preset", "satnerf", "--beta", "--solar-weight", "0.2", "--width", "32", "--rays", "7"],
        ["--field", "neural", "--steps", "60", "--start", "prior", "--depth-weight", "1"],
        ["--brdf", "auto", "--materials", "3", "--normals", "prior", "--pretrain", "0"],
        ["--preset", "rpv-nerf", "--brdf-at", "sample", "--pretrain", "0.1"],
        ["--shadow", "auto", "--shadow-start", "lit", "--transient", "auto", "--epochs", "3"],
        ["--rays", "1024", "--no-beta", "--brdf", "lambert"],  # what they have anyway
    ],
)
def test_what_does_something_is_taken(flags: list[str]) -> None:
    result = CliRunner().invoke(main, ["fit", *flags, "--print-config"])
    assert result.exit_code == 0, result.stderr


def test_a_file_of_options_may_serve_several_fits(tmp_path: Path) -> None:
    config = tmp_path / "all.toml"
    config.write_text('[fit]\nnetwork = "satnerf"\nepochs = [3]\nmaterials = 4\n')
    for flags in ([], ["--preset", "eonerf"]):
        result = CliRunner().invoke(main, ["fit", *flags, "--config", str(config), "--print-config"])
        assert (result.exit_code, result.stderr) == (0, "")


@pytest.mark.parametrize("preset", PRESETS)
def test_no_preset_sets_what_does_nothing_beside_it_but_for_what_others_bring(preset: Any) -> None:
    options, own = resolve(preset, {}), set(with_preset(preset)) & set(NEEDED)
    assert without_effect(options, own) == []


def test_all_that_do_nothing_are_named() -> None:
    assert without_effect(FitOptions(), NEEDED) == []
    why = "found --field surface, expected --field mlp (or a preset with a network)"
    idle = without_effect(FitOptions(width=8, network="satnerf"), ["width", "network", "brdf"])
    assert idle == [("width", why), ("network", why)]


@pytest.mark.parametrize("options", [{"precision": "bf16", "rays": 1024}, FitOptions(precision="bf16")])
def test_from_python_it_is_told_as_well(tmp_path: Path, options: Any, caplog: pytest.LogCaptureFixture) -> None:
    with pytest.raises(SceneError, match=r"none\.json"):
        sattools.fit(tmp_path / "none.json", options)
    why = "found --field surface, expected --field mlp (or a preset with a network)"
    assert [record.getMessage() for record in caplog.records] == [f"--precision does nothing here: {why}"]


def test_a_preset_brings_nothing_from_python_that_is_told(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    for options in ({"preset": "satnerf"}, resolve("satnerf", {"width": 32})):
        with pytest.raises(SceneError, match=r"none\.json"):
            sattools.fit(tmp_path / "none.json", options)
    assert caplog.records == []


def test_of_a_simulation_from_python_as_well(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    (tmp_path / "taken").touch()
    with pytest.raises(SattoolsError, match="taken"):
        sattools.simulate({"units": 3, "out": str(tmp_path / "taken")})
    why = "found --terrain city, expected natural"
    assert [record.getMessage() for record in caplog.records] == [f"--units does nothing here: {why}"]
