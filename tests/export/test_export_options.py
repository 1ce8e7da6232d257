"""Options of `sattools export` that are wrong or do nothing are told by their names."""

from pathlib import Path
from typing import Any

import pytest
from click.testing import CliRunner

from sattools.cli import main


def export(*arguments: Any) -> Any:
    return CliRunner().invoke(main, ["export", *map(str, arguments)])


def test_an_image_that_is_named_twice_is_wrong_usage() -> None:
    result = export("scene.json", "--view", "A", "--view", "B", "--view", "A")
    assert result.exit_code == 2
    assert "--view: found 'A' twice, expected every image once" in result.stderr


@pytest.mark.parametrize(("products", "told"), [("laz", True), ("laz,dtm", False)])
def test_a_width_of_buildings_without_bare_ground_is_told(tmp_path: Path, products: str, told: bool) -> None:
    result = export(tmp_path / "scene.json", "--products", products, "--ground-width", "30")
    assert ("--ground-width does nothing here: expected --products dtm beside it" in result.stderr) == told
    assert "scene.json" in result.stderr.splitlines()[-1]  # which is not there


def test_a_width_of_buildings_in_a_file_of_options_for_several_exports_is_not_told(tmp_path: Path) -> None:
    (tmp_path / "c.toml").write_text("[export]\nground-width = 30.0\n")
    result = export(tmp_path / "scene.json", "--config", tmp_path / "c.toml")
    assert "--ground-width" not in result.stderr
