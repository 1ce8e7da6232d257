"""A simulated town whose images, cameras and metadata a test spoils, and what `prep` says of it."""

import json
import shutil
from dataclasses import replace
from typing import Any

import rasterio
from click.testing import CliRunner

from sattools.camera import RPC
from sattools.cli import main
from sattools.scene import Scene

TERMS = "1 L P H LP LH PH LL PP HH LPH LLL LPP LHH LLP PPP PHH LLH PPH HHH"


class Town:
    """Images with RPC tags, and a JSON each with time and sun, to be spoilt."""

    def __init__(self, folder: Any, source: Any, count: Any) -> None:
        shutil.copytree(source.root / "images", folder / "images")
        shutil.copytree(source.root / "metadata", folder / "metadata")
        self.folder = folder
        for number in range(count + 1, 7):
            (folder / f"images/TOWN_{number:03d}.tif").unlink()

    def images(self) -> Any:
        return sorted((self.folder / "images").glob("*.tif"))

    def image(self, number: Any) -> Any:
        return self.folder / f"images/TOWN_{number:03d}.tif"

    def metadata(self, number: Any, **members: Any) -> Any:
        """Change or (None) remove members."""
        path = self.folder / f"metadata/TOWN_{number:03d}.json"
        found = json.loads(path.read_text()) | members
        path.write_text(json.dumps({k: v for k, v in found.items() if v is not None}))
        return found

    def pixels(self, number: Any, change: Any, meanings: Any = None, palette: Any = None) -> None:
        path = self.image(number)
        with rasterio.open(path) as data:
            values, tags = change(data.read()), data.tags(ns="RPC")
        path.unlink()
        bands, height, width = values.shape
        profile = {"driver": "GTiff", "count": bands, "height": height, "width": width, "dtype": values.dtype}
        with rasterio.open(path, "w", **profile, **({"photometric": "palette"} if palette else {})) as data:
            if meanings:
                data.colorinterp = meanings
            if palette:
                data.write_colormap(1, palette)
            data.write(values)
            data.update_tags(ns="RPC", **tags)

    def camera(self, number: Any, change: Any) -> None:
        """The camera of tags and metadata alike."""
        with rasterio.open(self.image(number), "r+") as data:
            data.update_tags(ns="RPC", **change(RPC.from_tags(data.tags(ns="RPC"))).to_tags())
        self.metadata(number, rpc=None)

    def all(self, what: Any, change: Any) -> None:
        for number in range(1, len(self.images()) + 1):
            getattr(self, what)(number, change) if callable(change) else self.metadata(number, **change)


def prep(town: Any, *options: Any) -> Any:
    arguments = ["prep", *town.images(), "--metadata", town.folder / "metadata", "--out", town.folder / "out"]
    return CliRunner().invoke(main, [*map(str, arguments), "--id", "Q", *map(str, options)])


def refused(town: Any, *words: Any, options: Any = (), code: Any = 1) -> None:
    """Before any work, and in the work itself, in one line that names the right file."""
    for dry in ((), ("--dry-run",)):
        result = prep(town, *options, *dry)
        assert result.exit_code == code, result.output
        last = result.stderr.splitlines()[-1]
        for word in words:
            assert word in last
        assert result.stdout == ""
    assert not (town.folder / "out").exists() or not any(p.is_file() for p in (town.folder / "out").rglob("*"))


def warned(town: Any, *words: Any, options: Any = ("--dry-run",)) -> Any:
    result = prep(town, *options)
    assert result.exit_code == 0, result.output
    assert any(all(word in line for word in words) for line in result.stderr.splitlines()), result.stderr
    return result


def made(town: Any, *words: Any, options: Any = ()) -> Any:
    """A whole prep that warns on stderr and in the history; the scene."""
    scene = Scene.from_json(warned(town, *words, options=options).stdout)
    assert any(all(word in note for word in words) for note in scene.history[-1]["notes"])
    return scene


def roles(scene: Any) -> Any:
    return [item.role for item in scene.items]


def exchanged(rpc: Any) -> Any:
    """Longitude and latitude of a camera exchanged."""
    order = [
        next(k for k, m in enumerate(TERMS.split()) if sorted(m) == sorted(name.translate(str.maketrans("LP", "PL"))))
        for name in TERMS.split()
    ]
    polynomials = {n: getattr(rpc, n)[order] for n in ("row_num", "row_den", "col_num", "col_den")}
    return replace(
        rpc, lat_offset=rpc.lon_offset, lon_offset=rpc.lat_offset, lat_scale=rpc.lon_scale, lon_scale=rpc.lat_scale,
        **polynomials,
    )  # fmt: skip


def southern(rpc: Any) -> Any:
    return replace(rpc, lat_offset=-rpc.lat_offset)
