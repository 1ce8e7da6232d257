"""Is everything there that the suite can use, and does it work? Versions, torch, geoid grids, QGIS, a small scene."""

from __future__ import annotations

import importlib.metadata
import importlib.util
import json
import shutil
import subprocess
import sys
import tempfile
import time
import warnings
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Literal

from sattools.errors import SattoolsError
from sattools.processors import cores
from sattools.scene.jsonio import JsonObject

State = Literal["ok", "note", "missing"]
PYTHON = ((3, 11), (3, 13))
DRIVERS = ("GTiff", "COG", "NITF", "JP2OpenJPEG")
EXTRAS = {
    "dask": ("`batch`, on this machine or several", "pip install 'sattools[batch]'"),
    "xarray": ("products as DataArray", "pip install 'sattools[notebook]'"),
    "laspy": ("point clouds of `export --products laz`", "pip install 'sattools[products]'"),
    "trimesh": ("meshes of `export --products mesh`", "pip install 'sattools[products]'"),
    "lpips": (
        "LPIPS in `compare --views`",
        "--lpips-weights, or pip install lpips with its weights on disk",
    ),
}


@dataclass(frozen=True)
class Finding:
    """One thing that was looked at.

    Attributes:
        name: of the thing.
        state: ``ok``; ``note`` for what only some work needs; ``missing`` for what the suite cannot do without.
        text: what was found.
        remedy: what to do about it, or empty.
    """

    name: str
    state: State
    text: str
    remedy: str = ""

    def to_dict(self) -> JsonObject:
        """JSON form."""
        return asdict(self)


def examine() -> list[Finding]:
    """Everything, in the order in which it matters."""
    checks: list[Callable[[], list[Finding]]] = [
        _python, _packages, _torch, _drivers, _geoids, _kernels, _machine, _qgis, _extras,
    ]  # fmt: skip
    findings = []
    for check in checks:
        try:
            findings += check()
        except Exception as error:  # a broken library is what this is about
            text = " ".join(f"{type(error).__name__}: {error}".split())[:200]
            findings.append(Finding(check.__name__.lstrip("_"), "missing", text, "reinstall sattools"))
    return findings


def try_out(say: Callable[[str], None]) -> Finding:
    """Take a simulated scene of 64 m through every step, in a folder that is removed again.

    Kernels that a first run would compile are compiled by this, so installation is the time for it.

    Args:
        say: told what is done.
    """
    with tempfile.TemporaryDirectory(prefix="sattools-try-") as place:
        folder = Path(place)
        steps = [
            ["simulate", "--size", "64", "--views", "6", "--id", "SIM", "--out", place],
            [
                "prep",
                str(folder / "SIM/images"),
                "--metadata",
                str(folder / "SIM/metadata"),
                "--id",
                "TRY",
                "--out",
                place,
            ],
            ["fit"],
            ["export"],
            ["compare", "--dsm", str(folder / "SIM/truth/SIM_DSM.tif")],
        ]
        document = b""
        begun = time.perf_counter()
        for step in steps:
            say(f"trying {step[0]}")
            call = [sys.executable, "-m", "sattools", "--quiet", *step]
            done = subprocess.run(call, input=document, capture_output=True, check=False)
            if done.returncode:
                last = (done.stderr.decode(errors="replace").strip().splitlines() or ["no message"])[-1]
                return Finding("a small scene", "missing", last[:200], _remedy(last))
            document = done.stdout
        error = json.loads((folder / "TRY/compare/errors.json").read_text())["mae"]
        took = time.perf_counter() - begun
    text = f"simulate, prep, fit, export and compare in {took:.0f} s, DSM {error:.2f} m off, kernels compiled"
    return Finding("a small scene", "ok", text)


def _remedy(message: str) -> str:
    """What helps against an error of a small scene: the machine's want of something, or else a new installation."""
    if any(words in message for words in ("No space left", "quota", "cannot be written", "Read-only")):
        return f"make room in {tempfile.gettempdir()}, or set TMPDIR to a folder that has some"
    if "too little memory" in message or "GiB of memory" in message:
        return "end other programs"
    return "reinstall sattools"


def fetch_geoids(say: Callable[[str], None]) -> None:
    """Download the grids of the geoids that are not there from PROJ's network into the user's folder.

    Args:
        say: told what is done.

    Raises:
        SattoolsError: the network or the folder does not allow it.
    """
    from pyproj.datadir import get_user_data_dir
    from pyproj.transformer import TransformerGroup

    from sattools.export.datum import GEOIDS, has_grid

    for name, (code, title, file) in GEOIDS.items():
        if has_grid(name):
            say(f"{title}: there already")
            continue
        folder = Path(get_user_data_dir())
        try:
            folder.mkdir(parents=True, exist_ok=True)
            with warnings.catch_warnings():
                # pyproj warns that the best transformation is not available: that is why its grid is fetched
                warnings.simplefilter("ignore", UserWarning)
                group = TransformerGroup("EPSG:4979", code, always_xy=True)
            group.download_grids(str(folder), open_license=True)
        except Exception as error:  # of urllib and of the system, many kinds
            text = " ".join(str(error).split())[:200]
            raise SattoolsError(
                f"{title}: cannot be fetched ({text}), expected https://cdn.proj.org/{file} to be reachable, or the "
                f"file in {folder}"
            ) from error
        say(f"{title}: {folder / file}")


def _python() -> list[Finding]:
    found = sys.version_info[:2]
    text = f"{sys.version.split()[0]} ({sys.executable})"
    if PYTHON[0] <= found <= PYTHON[1]:
        return [Finding("Python", "ok", text)]
    wanted = f"use Python {'.'.join(map(str, PYTHON[0]))} to {'.'.join(map(str, PYTHON[1]))}"
    return [Finding("Python", "missing" if found < PYTHON[0] else "note", text, wanted)]


def _packages() -> list[Finding]:
    from packaging.requirements import Requirement

    findings = []
    for line in importlib.metadata.requires("sattools") or []:
        wanted = Requirement(line)
        if wanted.marker is not None and not wanted.marker.evaluate({"extra": ""}):
            continue  # of an extra, or of another system
        name = wanted.name
        try:
            findings.append(Finding(name, "ok", importlib.metadata.version(name)))
        except importlib.metadata.PackageNotFoundError:
            findings.append(Finding(name, "missing", "not installed", f"pip install {line!r}"))
    return findings


def _torch() -> list[Finding]:
    import torch

    build = f"built for CUDA {torch.version.cuda}" if torch.version.cuda else "built for the CPU"
    if torch.cuda.is_available():
        return [Finding("GPU", "ok", f"{torch.cuda.get_device_name(0)} (torch {build})")]
    if torch.version.cuda:
        smaller = "the CPU build is gigabytes smaller: see the README's installation"
        return [Finding("GPU", "note", f"none (torch {build})", smaller)]
    return [Finding("GPU", "note", f"none (torch {build}); the surface and its prior do not need one")]


def _drivers() -> list[Finding]:
    import rasterio
    from rasterio.drivers import raster_driver_extensions
    from rasterio.env import Env

    with Env() as env:
        there = set(env.drivers()) | set(raster_driver_extensions().values())
    lacking = [name for name in DRIVERS if name not in there]
    text = f"{rasterio.__gdal_version__}, formats {', '.join(name for name in DRIVERS if name in there)}"
    if not lacking:
        return [Finding("GDAL", "ok", text)]
    state: State = "missing" if {"GTiff", "COG"} & set(lacking) else "note"
    return [Finding("GDAL", state, f"{text}; without {', '.join(lacking)}", "install rasterio's own wheel")]


def _geoids() -> list[Finding]:
    from sattools.export.datum import GEOIDS, has_grid

    findings = []
    for name, (_, title, _) in GEOIDS.items():
        if has_grid(name):
            findings.append(Finding(title, "ok", f"`export --vertical {name}` works"))
        else:
            findings.append(Finding(title, "note", "no grid in PROJ", "sattools doctor --fetch-geoids"))
    return findings


def _kernels() -> list[Finding]:
    from sattools.compiled import cache_folder

    folder = cache_folder()
    if folder is None:
        return [Finding("compiled kernels", "ok", "kept from run to run")]
    text = f"kept in {folder}: compiled anew when that is emptied"
    return [Finding("compiled kernels", "note", text, "set NUMBA_CACHE_DIR to a folder that stays")]


def _machine() -> list[Finding]:
    from sattools.scene.memory import available

    there = available()
    memory = "unknown memory" if there is None else f"{there / 2**30:.1f} GiB of memory free"
    text = f"{cores()} cores, {memory}"
    if there is not None and there < 2 * 2**30:
        return [Finding("machine", "note", text, "2 GiB are needed for areas of 300 m; `fit --tile` needs less")]
    return [Finding("machine", "ok", text)]


def _qgis() -> list[Finding]:
    program = shutil.which("qgis_process")
    if program is None:
        return [Finding("QGIS", "note", "no qgis_process on the PATH; only the plugin needs it")]
    return [Finding("QGIS", "ok", program)]


def _extras() -> list[Finding]:
    findings = []
    for name, (purpose, remedy) in EXTRAS.items():
        if importlib.util.find_spec(name) is None:
            findings.append(Finding(name, "note", f"not installed; for {purpose}", remedy))
        else:
            findings.append(Finding(name, "ok", f"for {purpose}"))
    return findings


__all__ = ["Finding", "examine", "fetch_geoids"]
