"""The example notebook runs from its first cell to its last."""

import json
from pathlib import Path

import pytest

NOTEBOOK = Path(__file__).parents[1] / "examples/notebook.ipynb"


@pytest.mark.drawn
def test_the_notebook_runs_and_leaves_what_it_shows(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("xarray")
    import matplotlib

    matplotlib.use("agg")
    monkeypatch.chdir(tmp_path)
    cells = json.loads(NOTEBOOK.read_text(encoding="utf-8"))["cells"]
    names: dict = {}
    code = ["".join(cell["source"]) for cell in cells if cell["cell_type"] == "code"]
    smaller = code[0].replace('"size": 192.0, "views": 9', '"size": 96.0, "views": 6')  # a fourth of the seconds
    assert smaller != code[0]
    for cell in (smaller, *code[1:]):
        exec(compile(cell, str(NOTEBOOK), "exec"), names)  # noqa: S102
    scene = names["scene"]
    assert {"dsm", "w", "theta", "relit", "errors"} <= set(scene.products)
    assert (tmp_path / "notebook/hill.png").stat().st_size > 10_000
    assert names["w"].dims == ("band", "y", "x")
    assert scene.history[-1]["errors"]["completeness"] > 0.9
