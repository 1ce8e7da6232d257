"""Two dates between which more of the area has changed than has not."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from click.testing import CliRunner

from sattools.cli import main
from sattools.scene.grid import Grid
from sattools.scene.raster import write_cog

GRID = Grid("EPSG:32617", 436000.0, 3355120.0, 1.0, 120, 120)


def noise(seed: int) -> Any:
    return np.random.default_rng(seed).normal(0.0, 0.1, GRID.shape)


def blocks() -> Any:
    """Roofs of 24 x 24 m, 5 to 35 m high, over 64 % of the ground."""
    heights = np.zeros(GRID.shape)
    tall = np.random.default_rng(7).uniform(5.0, 35.0, (4, 4))
    for row, col in np.ndindex(4, 4):
        heights[30 * row + 3 : 30 * row + 27, 30 * col + 3 : 30 * col + 27] = tall[row, col]
    return heights


def change(tmp_path: Path, risen: Any, *options: str) -> tuple[Any, str]:
    for name, heights in (("before", noise(1)), ("after", noise(2) + risen)):
        write_cog(tmp_path / f"{name}.tif", heights.astype(np.float32), GRID, units="m")
    files = [str(tmp_path / f"{name}.tif") for name in ("before", "after")]
    done = CliRunner().invoke(main, ["change", *files, "--out", str(tmp_path / "out"), "--overwrite", *options])
    assert done.exit_code == 0, done.stderr
    return json.loads(done.stdout), done.stderr


def test_a_surface_against_its_bare_ground_is_not_silently_without_a_change(tmp_path: Path) -> None:
    table, told = change(tmp_path, blocks())
    (note,) = [text for text in table["notes"] if "most of the area seems to have changed, which is taken" in text]
    assert note in told
    # 0.14 m, and what the roofs' edges add
    assert "differences scatter by 20 m, side by side by 0.2 m" in note
    assert "--noise says what unchanged ground has (such as 0.2), and --register none leaves" in note


def test_what_the_note_advises_finds_all_of_it(tmp_path: Path) -> None:
    table, told = change(tmp_path, blocks(), "--noise", "0.15", "--register", "none")
    assert "most of the area" not in told
    assert [region["area_m2"] for region in table["regions"]] == pytest.approx([576.0] * 16, rel=0.01)
    assert sum(region["volume_m3"] for region in table["regions"]) == pytest.approx(blocks().sum(), rel=0.01)
    assert table["noise_m"] == 0.15


def test_ground_that_stayed_dry_in_a_flood_is_not_told_as_sunk_without_a_word(tmp_path: Path) -> None:
    flood = np.zeros(GRID.shape)
    flood[:, :80] = 3.0
    table, told = change(tmp_path, flood)
    assert [round(region["mean_m"]) for region in table["regions"]] == [-3]
    (note,) = [text for text in table["notes"] if text.startswith("most of the area has changed by +2.9 m")]
    assert "4803 m2 that have not are told as changed by about -2.9 m; --register none leaves" in note
    assert note in told
    table, told = change(tmp_path, flood, "--register", "none", "--noise", "0.15")
    assert [round(region["mean_m"]) for region in table["regions"]] == [3]
    assert "most of the area" not in told


@pytest.mark.parametrize("errors", [0.5, 3.0])
def test_noisy_surfaces_and_other_datums_are_no_change_of_most_of_the_area(tmp_path: Path, errors: float) -> None:
    from scipy.ndimage import gaussian_filter

    smooth = gaussian_filter(np.random.default_rng(3).standard_normal(GRID.shape), 2.0)
    risen = 30.0 + errors * smooth / smooth.std()
    risen[20:40, 20:40] += 12.0
    table, told = change(tmp_path, risen, "--register", "z")
    (region,) = table["regions"]
    assert region["mean_m"] == pytest.approx(12.0, abs=errors / 2)
    assert "most of the area" not in told
