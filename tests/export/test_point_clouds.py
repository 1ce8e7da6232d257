"""Point clouds of the exported surface: every cell with a height, where it is, in formats that other programs read."""

from pathlib import Path
from typing import Any

import laspy
import numpy as np
import pytest
import torch
import trimesh

from sattools.errors import InputError, SattoolsError
from sattools.export.options import ExportOptions
from sattools.export.products import points
from sattools.export.products.colours import Palette, rgb_bands
from sattools.export.products.maps import Maps
from sattools.export.products.points import las_wkt, write_laz, write_ply
from sattools.export.stage import export
from sattools.fit.checkpoint import save
from sattools.progress import silent
from sattools.scene import Grid, Item, Scene
from sattools.scene.raster import read_raster, write_cog

GRID = Grid("EPSG:32617", 436000.0, 3358000.0, 0.5, 60, 40)
CONFIDENCE = Grid("EPSG:32617", 436000.0, 3358000.0, 1.0, 30, 20)


@pytest.fixture
def maps(tmp_path: Path) -> Maps:
    """A ramp rising 0.1 m a column eastwards with a hole, two filled cells, and a prior on cells twice as wide."""
    height = np.tile(np.arange(60) * 0.1, (40, 1)).astype(np.float32)
    height[5:10, 5:10] = np.nan
    validity = np.where(np.isfinite(height), 1, 0).astype(np.uint8)
    validity[20, 30:32] = 2
    albedo = np.stack([np.full(GRID.shape, value, np.float32) for value in (0.1, 0.2, 0.3)])
    albedo[:, :, 30:] += 0.1
    write_cog(tmp_path / "dsm.tif", height, GRID)
    write_cog(tmp_path / "validity.tif", validity, GRID, nodata=None)
    write_cog(tmp_path / "albedo.tif", albedo, GRID, descriptions=["albedo blue", "albedo green", "albedo red"])
    write_cog(tmp_path / "prior.tif", np.full(CONFIDENCE.shape, 0.75, np.float32), CONFIDENCE)
    names = {"dsm": "dsm", "validity": "validity", "albedo": "albedo", "prior_confidence": "prior"}
    return Maps.of({name: tmp_path / f"{file}.tif" for name, file in names.items()})


def test_a_laz_has_a_point_at_the_centre_of_every_cell_with_a_height(maps: Any, tmp_path: Path) -> None:
    count = write_laz(tmp_path / "a.laz", maps, None, silent)
    found = laspy.read(tmp_path / "a.laz")
    assert count == len(found.x) == 60 * 40 - 25
    assert found.x.min() == pytest.approx(436000.25, abs=1e-3)
    assert found.y.max() == pytest.approx(3357999.75, abs=1e-3)
    # on the surface: the ramp's height follows from the easting
    assert np.abs(np.asarray(found.z) - (np.asarray(found.x) - 436000.25) * 0.2).max() < 1e-3
    assert np.asarray(found["confidence"]) == pytest.approx(0.75)


def test_a_laz_says_what_was_filled(maps: Any, tmp_path: Path) -> None:
    write_laz(tmp_path / "a.laz", maps, None, silent)
    found = laspy.read(tmp_path / "a.laz")
    filled = np.asarray(found.classification) == 64
    assert filled.sum() == 2
    assert np.array_equal(filled, np.asarray(found.synthetic) == 1)
    assert np.array_equal(filled, np.asarray(found["validity"]) == 2)
    assert set(np.asarray(found.classification)[~filled]) == {1}


def test_heights_that_no_image_has_seen_are_filled_ones_in_a_laz(maps: Any, tmp_path: Path) -> None:
    validity = np.ones(GRID.shape, np.uint8)
    validity[30:, :] = 0  # `export --fill` keeps their heights
    write_cog(tmp_path / "validity.tif", validity, GRID, nodata=None)
    write_laz(tmp_path / "a.laz", maps, None, silent)
    found = laspy.read(tmp_path / "a.laz")
    unseen = np.asarray(found["validity"]) == 0
    assert unseen.sum() == 600
    assert set(np.asarray(found.classification)[unseen]) == {64}
    assert set(np.asarray(found.synthetic)[unseen]) == {1}
    assert set(np.asarray(found.classification)[~unseen]) == {1}
    assert set(np.asarray(found.synthetic)[~unseen]) == {0}


def test_colours_are_red_green_and_blue_by_the_bands_names(maps: Any, tmp_path: Path) -> None:
    write_laz(tmp_path / "a.laz", maps, None, silent)
    found = laspy.read(tmp_path / "a.laz")
    east = np.asarray(found.x) > 436015
    # red is the third band, from 0.3 to 0.4; black is 0.1 and white 0.4
    assert set(np.asarray(found.red)[east]) == {65535}
    assert set(np.asarray(found.blue)[~east]) == {0}
    assert np.asarray(found.green)[~east] == pytest.approx(65535 / 3, rel=0.01)
    assert Palette.of(maps, "albedo").bands == (2, 1, 0)


@pytest.mark.parametrize(
    ("names", "shown"),
    [
        ([f"albedo {number}" for number in range(1, 9)], (4, 2, 1)),  # WorldView's: coastal, blue, green, yellow, red
        ([f"albedo {name}" for name in ("red", "a", "b", "green", "c", "d", "e", "blue")], (0, 3, 7)),
        ([f"albedo {name}" for name in "abcdefgh"], (0, 1, 2)),
        (["albedo 1", "albedo 2", "albedo 3", "albedo 4"], (0, 1, 2)),
        (["albedo 1"], (0, 0, 0)),
    ],
)
def test_eight_bands_without_names_are_worldviews(names: Any, shown: Any, tmp_path: Path) -> None:
    bands = np.zeros((len(names), *GRID.shape), np.float32)
    write_cog(tmp_path / "albedo.tif", bands, GRID, descriptions=names)
    assert rgb_bands(tmp_path / "albedo.tif") == shown


def test_the_crs_of_a_laz_has_a_vertical_part(maps: Any, tmp_path: Path) -> None:
    write_laz(tmp_path / "a.laz", maps, None, silent)
    write_laz(tmp_path / "b.laz", maps, "EPSG:5773", silent)
    ellipsoidal = laspy.read(tmp_path / "a.laz").header.parse_crs()
    assert [axis.name for axis in ellipsoidal.axis_info] == ["Easting", "Northing", "Ellipsoidal height"]
    assert ellipsoidal.to_2d().to_epsg() == 32617
    geoid = laspy.read(tmp_path / "b.laz").header.parse_crs()
    assert [part.to_epsg() for part in geoid.sub_crs_list] == [32617, 5773]
    assert las_wkt("EPSG:32617", None).startswith('COMPD_CS["WGS 84 / UTM zone 17N + ellipsoidal height",PROJCS[')


def test_a_ply_has_the_same_points(maps: Any, tmp_path: Path) -> None:
    assert write_ply(tmp_path / "a.ply", maps, "WGS84 ellipsoid", silent) == 2375
    found = trimesh.load(tmp_path / "a.ply", process=False)
    assert found.vertices.shape == (2375, 3)
    assert found.vertices[0] == pytest.approx([436000.25, 3357999.75, 0.0], abs=1e-3)
    assert found.vertices[-1] == pytest.approx([436029.75, 3357980.25, 5.9], abs=1e-3)
    assert found.colors[-1].tolist()[:3] == [255, 170, 85]


def test_blocks_give_the_points_of_the_whole(maps: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    write_laz(tmp_path / "whole.laz", maps, None, silent)
    blocks = Maps.blocks
    monkeypatch.setattr(Maps, "blocks", lambda self, size=16: blocks(self, 16))
    write_laz(tmp_path / "blocks.laz", maps, None, silent)
    whole, pieces = (laspy.read(tmp_path / f"{name}.laz") for name in ("whole", "blocks"))
    one, other = (np.stack([p.X, p.Y, p.Z, p.red, p.green, p.blue, p.classification]) for p in (whole, pieces))
    assert np.array_equal(one[:, np.lexsort(one)], other[:, np.lexsort(other)])


def test_no_more_than_a_block_is_read_at_a_time(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    grid = Grid("EPSG:32617", 436000.0, 3358000.0, 1.0, 1300, 1100)
    write_cog(tmp_path / "dsm.tif", np.zeros(grid.shape, np.float32), grid)
    most = 0

    def watched(*arguments: Any, **named: Any) -> Any:
        nonlocal most
        array, own = read_raster(*arguments, **named)
        most = max(most, array.size)
        return array, own

    monkeypatch.setattr("sattools.export.products.maps.read_raster", watched)
    assert write_laz(tmp_path / "a.laz", Maps.of({"dsm": tmp_path / "dsm.tif"}), None, silent) == 1300 * 1100
    assert most == 512 * 512


@pytest.fixture
def scene(tmp_path: Path) -> Scene:
    scene = Scene("BLOCK", tmp_path, [Item("a", None, None, {})], GRID)
    tensors = {
        "height": torch.zeros(GRID.shape),
        "height_std": torch.full(GRID.shape, 0.3),
        "albedo": torch.full((*GRID.shape, 3), 0.25),
    }
    save(tmp_path / "model", tensors, {"grid": GRID.to_dict(), "items": ["a"], "suns": [None], "shadow": "geometric"})
    scene.products["model"] = "model"
    return scene


def test_export_writes_the_points_that_are_asked_for(scene: Any) -> None:
    export(scene, ExportOptions(products=["laz,ply", "dsm"]))
    assert len(laspy.read(scene.path(scene.products["points"])).x) == 2400
    assert scene.products["points_ply"] == "export/points.ply"
    assert laspy.read(scene.path("export/points.laz"))["height_std"].max() == pytest.approx(0.3)


def test_a_new_fit_makes_the_points_of_the_old_one_disappear(scene: Any) -> None:
    from sattools.scene.dependencies import drop

    export(scene, ExportOptions(products=["laz"]))
    assert "points" in drop(scene, "fit")
    assert "points" not in scene.products


def test_an_unknown_product_is_named_with_what_was_meant() -> None:
    with pytest.raises(InputError, match=r"--products: found 'lazz', expected some of .*did you mean 'laz'"):
        ExportOptions(products=["ply,lazz"])


def test_without_laspy_the_extra_is_named_and_nothing_is_written(scene: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(__import__("sys").modules, "laspy", None)
    with pytest.raises(SattoolsError, match=r"found no laspy, expected the extra: pip install 'sattools\[products\]'"):
        export(scene, ExportOptions(products=["laz"]))
    assert not (scene.root / "export").exists()


def test_points_that_did_not_arrive_are_an_error(maps: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(points._Sums, "__eq__", lambda self, other: False)
    with pytest.raises(SattoolsError, match=r"a\.laz: cannot be written"):
        write_laz(tmp_path / "a.laz", maps, None, silent)
    assert not (tmp_path / "a.laz").exists()
