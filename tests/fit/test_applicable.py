"""Options that would do nothing beside the others are refused where they are given on the command line."""

from pathlib import Path
from typing import Any

import pytest
from click.testing import CliRunner

from sattools.cli import main
from sattools.fit.applicable import NEEDED, without_effect
from sattools.fit.options import FitOptions
from sattools.fit.presets import PRESETS, resolve, with_preset


@pytest.mark.parametrize(
    ("flags", "words"),
    [
        (["--network", "satnerf"], "--network: found --field surface, expected --field mlp"),
        (["--guided", "64"], "--guided: found --field surface, expected --field mlp, neural or voxel"),
        (["--field", "voxel", "--width", "32"], "--width: found --field voxel, expected --field mlp"),
        (["--preset", "satnerf", "--epochs", "3"], "--epochs: found --field mlp, expected --field surface"),
        (["--pretrain", "0.5"], "--pretrain: found --brdf lambert, expected --brdf rpv, hapke or auto"),
        (["--preset", "hapke-nerf", "--materials", "4"], "--materials: found --brdf hapke and --field mlp"),
        (["--preset", "spsnerf", "--beta"], "--beta: found --field mlp and --network spsnerf"),
        (["--shadow-weight", "0.1"], "--shadow-weight: found --shadow geometric, expected --shadow learned or auto"),
    ],
)
def test_what_would_do_nothing_is_refused(flags: list[str], words: str) -> None:
    result = CliRunner().invoke(main, ["fit", *flags, "--print-config"])
    assert result.exit_code == 2
    assert words in result.stderr
    assert result.stderr.endswith(": it would do nothing\n")


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
        assert result.exit_code == 0, result.stderr


@pytest.mark.parametrize("preset", PRESETS)
def test_no_preset_sets_what_does_nothing_beside_it_but_for_what_others_bring(preset: Any) -> None:
    options, own = resolve(preset, {}), set(with_preset(preset)) & set(NEEDED)
    assert without_effect(options, own) is None


def test_the_first_that_does_nothing_is_named() -> None:
    assert without_effect(FitOptions(), NEEDED) is None
    found = without_effect(FitOptions(width=8, network="satnerf"), ["width", "network"])
    assert found == (
        "width",
        "found --field surface, expected --field mlp (or a preset with a network): it would do nothing",
    )
