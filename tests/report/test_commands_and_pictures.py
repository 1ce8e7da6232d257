"""Commands that a page names, footprints, and pictures by themselves."""

import re
import shlex
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from click.testing import CliRunner
from matplotlib.colors import to_rgb

from sattools.batch.table import write_tables
from sattools.cli import main
from sattools.compare.picture import line_styles
from sattools.report import page as page_module
from sattools.report.batch import batch_page
from sattools.report.commands import command_line, pipeline
from sattools.report.figures import new_figure
from sattools.report.page import Picture, Section, render
from sattools.report.scene import scene_page
from sattools.scene import Scene

pytestmark = pytest.mark.drawn


def test_command_lines_name_what_is_not_the_default_and_can_be_pasted() -> None:
    line = command_line("fit", {"preset": "fast", "epochs": [4, 2], "pose": False, "reference": "my dsm.tif"})
    assert shlex.split(line) == [
        *("sattools", "fit", "--epochs", "4", "--epochs", "2", "--no-pose", "--reference", "my dsm.tif")
    ]
    assert command_line("prep", {"bounds": [1.0, 2.0, 3.0, 4.0], "out": "."}) == (
        "sattools prep IMAGE... --bounds 1.0 2.0 3.0 4.0"
    )
    history = [{"command": "fit", "options": {"seed": seed}} for seed in (1, 2)] + [{"command": "export"}]
    assert pipeline(history) == "sattools fit --seed 2 |\n    sattools export"


def test_what_is_done_once_more_after_an_alignment_replaces_its_files_in_the_same_again() -> None:
    history = [{"command": name} for name in ("fit", "export", "align", "fit", "align", "export")]
    assert pipeline(history).replace("sattools ", "").split(" |\n    ") == [
        *("fit", "export", "align", "fit --overwrite", "align", "export --overwrite")
    ]


def test_commands_of_another_tool_are_named_as_they_are() -> None:
    assert pipeline([{"command": "mine"}, {"command": "mine"}]) == "sattools mine |\n    sattools mine"


def test_remarks_are_those_of_the_last_fit_where_one_stands_on_each_side_of_an_alignment(tmp_path: Path) -> None:
    scene = Scene("A", tmp_path)
    told = [("fit", "of the first fit"), ("export", "of the first export"), ("align", "moved"), ("fit", "of the last")]
    scene.history = [{"command": name, "notes": [note]} for name, note in told]
    assert re.findall(r"of the (?:first|last)[a-z ]*", scene_page(scene)) == ["of the last", "of the first export"]


def test_a_batchs_page_names_the_coarse_fit_and_the_split_that_an_earlier_run_has_left(tmp_path: Path) -> None:
    """With other options of `export` only the tiles are joined again."""
    folder = tmp_path / "runs/cut/A"
    folder.mkdir(parents=True)
    write_tables([{"scene": "A", "configuration": "cut", "status": "done", "seconds": 1.0}], tmp_path)
    begun = ["prior", "fit --part coarse", "normalise", "fit --part coarse", "fit --part split"]
    joined = ["fit --part mosaic", "export", "compare", "fit --part mosaic", "export"]
    (folder / "log.txt").write_text("".join(f"$ sattools {call} scene.json\n" for call in begun + joined))
    assert re.findall("sattools ([a-z]+(?: --part [a-z]+)?) scene.json", batch_page(tmp_path)) == [
        *("normalise", "fit --part coarse", "fit --part split", "fit --part mosaic", "export")
    ]


def test_a_page_that_would_be_too_large_has_coarser_pictures(monkeypatch: pytest.MonkeyPatch) -> None:
    """Three pictures and 0.7 MB in the place of a dozen and 3 MB."""
    assert page_module.LARGEST == 3_000_000
    monkeypatch.setattr(page_module, "LARGEST", 700_000)

    def page(count: int) -> str:
        rng = np.random.default_rng(0)
        pictures = []
        for _ in range(count):
            figure = new_figure(8, 8)
            figure.subplots().imshow(rng.random((400, 400)), interpolation="nearest")
            pictures.append(Picture(figure, "noise", "noise"))
        return render("Noise", [Section("Pictures", list(pictures))])

    one, many = page(1), page(3)
    assert len(many) < 700_000
    assert len(many) < 0.8 * 3 * len(one)


def test_lines_of_many_images_can_be_told_apart() -> None:
    for count in (3, 12, 17, 40):
        styles = line_styles(count)
        shown = [(to_rgb(style["color"]), style.get("linestyle", "-")) for style in styles]
        assert len(set(shown)) == count
        alike = [np.abs(np.subtract(a[0], b[0])).max() for k, a in enumerate(shown) for b in shown[:k] if a[1] == b[1]]
        assert not alike or min(alike) > 0.08


def test_footprints_some_of_whose_corners_have_a_height(make_town: Any) -> None:
    scene = make_town()
    corners = scene.items[0].geometry["coordinates"][0]
    corners[0] = [*corners[0], 12.0]  # as GeoJSON allows
    (scene.root / "scene.json").write_text(scene.to_json())
    result = CliRunner().invoke(main, ["report", str(scene.root)])
    assert result.exit_code == 0, result.output
