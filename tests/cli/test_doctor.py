"""`sattools doctor` says what is there, what is not, and what to do about it."""

import contextlib
import importlib.metadata
import json
import sys
import warnings
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from click.testing import CliRunner

from sattools import doctor
from sattools.cli import main
from sattools.errors import SattoolsError
from sattools.export import datum


def test_this_installation_is_sound() -> None:
    result = CliRunner().invoke(main, ["doctor", "--json"])
    assert result.exit_code == 0
    findings = {row["name"]: row for row in json.loads(result.stdout)}
    assert findings["rasterio"]["state"] == "ok"
    assert findings["GDAL"]["text"].startswith("3.")
    assert "missing" not in {row["state"] for row in findings.values()}


def test_what_only_other_systems_and_extras_need_is_not_missing(monkeypatch: pytest.MonkeyPatch) -> None:
    """A fresh installation on Linux lacks psutil, which is of an extra there; `make demo` ended with that."""
    lines = [
        "numpy>=1.26", "not-there>=1; sys_platform == 'nowhere'", "nor-this>=1; extra == 'batch'",
        "but-this>=1; python_version >= '3'",
    ]  # fmt: skip
    monkeypatch.setattr(importlib.metadata, "requires", lambda name: lines)
    found = {finding.name: finding for finding in doctor._packages()}
    assert {name: finding.state for name, finding in found.items()} == {"numpy": "ok", "but-this": "missing"}
    assert "but-this>=1" in str(found["but-this"].remedy)


def test_without_dask_there_is_no_batch_on_this_machine_either(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "dask", None)
    found = next(finding for finding in doctor.examine() if finding.name == "dask")
    assert (found.state, found.text) == ("note", "not installed; for `batch`, on this machine or several")
    assert found.remedy == "pip install 'sattools[batch]'"


def test_people_read_a_line_per_thing_and_what_to_do(monkeypatch: pytest.MonkeyPatch) -> None:
    rows = [doctor.Finding("Python", "ok", "3.11"), doctor.Finding("torch", "missing", "not there", "install it")]
    monkeypatch.setattr(doctor, "examine", lambda: rows)
    result = CliRunner().invoke(main, ["doctor"])
    assert result.exit_code == 1
    assert result.stdout == "ok      Python  3.11\nmissing torch   not there\n                -> install it\n"


def test_a_library_that_cannot_be_imported_is_a_finding_and_no_traceback(monkeypatch: pytest.MonkeyPatch) -> None:
    def broken() -> list[doctor.Finding]:
        raise ImportError("libfoo.so:\nno such file")

    broken.__name__ = "_torch"
    monkeypatch.setattr(doctor, "_torch", broken)
    found = next(f for f in doctor.examine() if f.name == "torch" and f.state == "missing")
    assert found.text == "ImportError: libfoo.so: no such file"


def test_a_python_that_is_too_old_is_told(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(doctor, "sys", SimpleNamespace(version_info=(3, 9, 1), version="3.9.1 x", executable="p"))
    (found,) = doctor._python()
    assert (found.state, found.remedy) == ("missing", "use Python 3.11 to 3.13")


def test_geoid_grids_are_fetched_where_they_are_not_there(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    import pyproj.datadir
    import pyproj.transformer

    fetched: list[tuple[str, str]] = []

    class Group:
        def __init__(self, source: str, target: str, always_xy: bool) -> None:
            self.target = target

        def download_grids(self, folder: str, open_license: bool) -> None:
            fetched.append((self.target, folder))

    monkeypatch.setattr(pyproj.transformer, "TransformerGroup", Group)
    monkeypatch.setattr(pyproj.datadir, "get_user_data_dir", lambda: str(tmp_path / "proj"))
    monkeypatch.setattr(datum, "has_grid", lambda name: name == "egm2008")
    said: list[str] = []
    doctor.fetch_geoids(said.append)
    assert fetched == [("EPSG:4326+5773", str(tmp_path / "proj"))]
    assert said == [f"EGM96 geoid: {tmp_path}/proj/us_nga_egm96_15.tif", "EGM2008 geoid: there already"]


def test_what_is_missing_before_it_is_fetched_is_no_warning(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    import pyproj.datadir
    import pyproj.transformer

    class Group:
        def __init__(self, *_: str, always_xy: bool) -> None:
            warnings.warn("Best transformation is not available due to missing Grid", UserWarning, stacklevel=2)

        def download_grids(self, folder: str, open_license: bool) -> None:
            """Nothing."""

    monkeypatch.setattr(pyproj.transformer, "TransformerGroup", Group)
    monkeypatch.setattr(pyproj.datadir, "get_user_data_dir", lambda: str(tmp_path))
    monkeypatch.setattr(datum, "has_grid", lambda name: False)
    said: list[str] = []
    with warnings.catch_warnings(record=True) as shown:
        warnings.simplefilter("always")
        doctor.fetch_geoids(said.append)
    assert len(said) == 2
    assert shown == []


def test_no_network_is_one_line_with_the_address(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    import pyproj.datadir
    import pyproj.transformer

    class Group:
        def __init__(self, *_: str, always_xy: bool) -> None:
            pass

        def download_grids(self, folder: str, open_license: bool) -> None:
            raise OSError("Name or service\nnot known")

    monkeypatch.setattr(pyproj.transformer, "TransformerGroup", Group)
    monkeypatch.setattr(pyproj.datadir, "get_user_data_dir", lambda: str(tmp_path))
    monkeypatch.setattr(datum, "has_grid", lambda name: False)
    with pytest.raises(SattoolsError, match=r"EGM96 geoid: cannot be fetched \(Name or service not known\)"):
        doctor.fetch_geoids(print)


class Steps:
    """Stands in for the commands of `try_out`: notes them, and one of them fails."""

    def __init__(self, failing: str, error: str = "why") -> None:
        self.calls: list[list[str]] = []
        self.given: list[bytes] = []
        self.failing, self.error = failing, error

    def __call__(self, call: list[str], *, input: bytes, **_: Any) -> Any:
        step = call[4]
        self.calls.append(call[4:])
        self.given.append(input)
        if step == "compare":
            folder = Path(self.calls[0][-1]) / "TRY/compare"
            folder.mkdir(parents=True)
            (folder / "errors.json").write_text('{"mae": 0.5}')
        status = int(step == self.failing)
        said = f"warning: x\nsattools: error: {self.error}\n"
        return SimpleNamespace(returncode=status, stdout=step.encode(), stderr=said.encode())


def test_a_small_scene_goes_through_every_step(monkeypatch: pytest.MonkeyPatch) -> None:
    steps = Steps("none")
    monkeypatch.setattr(doctor.subprocess, "run", steps)
    found = doctor.try_out(lambda text: None)
    assert [call[0] for call in steps.calls] == ["simulate", "prep", "fit", "export", "compare"]
    assert steps.calls[1][1].endswith("SIM/images")
    assert steps.given[2:] == [b"prep", b"fit", b"export"], "each step gets what the one before printed"
    assert found.state == "ok"
    assert "DSM 0.50 m off" in found.text
    assert not Path(steps.calls[0][-1]).exists()


def test_a_step_that_fails_is_named_by_its_last_line(monkeypatch: pytest.MonkeyPatch) -> None:
    steps = Steps("fit")
    monkeypatch.setattr(doctor.subprocess, "run", steps)
    found = doctor.try_out(lambda text: None)
    assert (found.state, found.text) == ("missing", "sattools: error: why")
    assert [call[0] for call in steps.calls] == ["simulate", "prep", "fit"]


@pytest.mark.parametrize(
    ("error", "remedy"),
    [
        ("why", "reinstall sattools"),
        ("a.tif: cannot be written (No space left on device)", "make room in /scratch, or set TMPDIR"),
        ("found too little memory (all is taken), expected a smaller area or coarser cells", "end other programs"),
    ],
)
def test_what_the_machine_lacks_is_no_reason_to_reinstall(
    error: str, remedy: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(doctor.subprocess, "run", Steps("fit", error))
    monkeypatch.setattr(doctor.tempfile, "gettempdir", lambda: "/scratch")
    monkeypatch.setattr(doctor.tempfile, "TemporaryDirectory", lambda prefix: contextlib.nullcontext("/scratch/x"))
    assert remedy in (doctor.try_out(lambda text: None).remedy or "")
