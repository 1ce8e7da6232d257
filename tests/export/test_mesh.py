"""Meshes: the surface within a tolerance, with upright walls, without cracks, in files that other programs open."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pygltflib
import pytest
import trimesh
from matplotlib.tri import LinearTriInterpolator, Triangulation
from pyproj import Transformer

from sattools.camera.ground import to_geographic
from sattools.errors import InputError
from sattools.export.options import ExportOptions
from sattools.export.products import model3d
from sattools.export.products.maps import Maps
from sattools.export.products.mesh import mesh_of
from sattools.export.products.model3d import make_model, to_globe, write_glb, write_obj, write_tileset
from sattools.scene import Grid
from sattools.scene.raster import write_cog

GRID = Grid("EPSG:32617", 436000.0, 3358000.0, 0.5, 60, 40)


def house() -> np.ndarray:
    """Level ground at 3 m with a block of 12 x 7 m and 10 m height, its corner off the squares' lattice."""
    height = np.full(GRID.shape, 3.0, np.float32)
    height[9:23, 11:35] = 13.0
    return height


def solid(mesh: Any, cell: float = 0.5) -> trimesh.Trimesh:
    return trimesh.Trimesh(mesh.vertices * (cell, -cell, 1), mesh.faces, process=False)


def test_a_house_has_upright_walls_and_level_roofs() -> None:
    mesh = mesh_of(house(), 0.5, 0.25)
    found = solid(mesh)
    normals = np.round(found.face_normals, 6)
    walls = normals[-mesh.walls :]
    assert (walls[:, 2] == 0).all()
    assert (normals[: -mesh.walls] == (0, 0, 1)).all()
    assert found.area_faces[-mesh.walls :].sum() == pytest.approx(2 * (12 + 7) * 10)
    assert found.area == pytest.approx(30 * 20 + 2 * (12 + 7) * 10)
    # outwards: away from the middle of the house
    middle = np.array([11.5, -8.0])
    outwards = found.triangles_center[-mesh.walls :, :2] - middle
    assert ((outwards * walls[:, :2]).sum(axis=1) > 0).all()
    assert len(mesh.faces) < 0.2 * 2 * 40 * 60


def test_level_ground_is_a_handful_of_faces() -> None:
    mesh = mesh_of(np.zeros((64, 64)), 1.0, 0.25)
    assert (len(mesh.vertices), len(mesh.faces), mesh.walls) == (4, 2, 0)


def rough(seed: int = 0) -> np.ndarray:
    from scipy.ndimage import gaussian_filter

    rng = np.random.default_rng(seed)
    height = 30 * gaussian_filter(rng.standard_normal((96, 80)), 6)
    for row, col in ((10, 10), (13, 40), (50, 20), (57, 26)):
        height[row : row + 15, col : col + 11] += 4 + 6 * rng.random()
    height[70:80, 50:60] = np.nan
    return height


@pytest.mark.parametrize("tolerance", [0.1, 0.5])
def test_faces_miss_the_surface_by_no_more_than_the_tolerance(tolerance: float) -> None:
    height = np.where(np.isnan(rough()), 0.0, rough())
    flat = 40 * np.sin(np.arange(96) / 30)[:, None] + np.zeros(80)  # without walls: a function of the place
    for surface, walls in ((flat, False), (height, True)):
        mesh = mesh_of(surface, 1.0, tolerance)
        assert (mesh.walls > 0) == walls
        heights = mesh.vertices[:, 2]
        assert heights.min() >= surface.min() - 1e-3
        assert heights.max() <= surface.max() + 1e-3
    mesh = mesh_of(flat, 1.0, tolerance)
    x, y, z = mesh.vertices.T
    rows, cols = np.mgrid[2:94, 2:78]
    found = LinearTriInterpolator(Triangulation(x, y, mesh.faces), z)(cols + 0.5, rows + 0.5)
    # corners keep the tolerance; between them a face adds the bend of half a cell
    assert np.abs(found - flat[2:94, 2:78]).max() <= tolerance + 0.03
    assert len(mesh.faces) < (0.5 if tolerance == 0.1 else 0.1) * 2 * flat.size


def test_a_saddle_is_as_exact_as_all_other_ground() -> None:
    """Its squares have straight edges, but two triangles over 64 cells would miss its middle by 2.6 m."""
    rows, cols = np.mgrid[0:64, 0:64] - 31.5
    mesh = mesh_of(0.0025 * rows * cols, 1.0, 0.25)
    x, y, z = mesh.vertices.T
    rows, cols = np.mgrid[1:64, 1:64]
    found = LinearTriInterpolator(Triangulation(x, y, mesh.faces), z)(cols, rows)
    assert np.abs(found - 0.0025 * (rows - 32) * (cols - 32)).max() <= 0.25


def test_no_crack_is_left_within() -> None:
    """Edges of one face only lie along the border, along holes, or upright where walls of several heights meet."""
    height = rough()
    mesh = mesh_of(height, 1.0, 0.3)
    edges, count = np.unique(np.sort(solid(mesh).edges, axis=1), axis=0, return_counts=True)
    ends = mesh.vertices[edges[count == 1]]
    upright = (ends[:, 0, :2] == ends[:, 1, :2]).all(axis=1)
    middle = ends[~upright].mean(axis=1)
    border = (middle[:, 0] % 80 == 0) | (middle[:, 1] % 96 == 0)
    hole = (np.abs(middle[:, 0] - 55) <= 5) & (np.abs(middle[:, 1] - 75) <= 5)
    assert (border | hole).all()
    assert hole.sum() > 0


def test_there_is_no_face_over_cells_without_a_height() -> None:
    mesh = mesh_of(rough(), 1.0, 0.3)
    centres = mesh.vertices[mesh.faces].mean(axis=1)
    inside = (np.abs(centres[:, 0] - 55) < 5) & (np.abs(centres[:, 1] - 75) < 5)
    assert not inside.any()
    assert np.isfinite(mesh.vertices).all()


@pytest.fixture
def maps(tmp_path: Path) -> Maps:
    write_cog(tmp_path / "dsm.tif", house(), GRID)
    colours = np.zeros((3, *GRID.shape), np.float32)
    colours[0, :, 30:] = 1.0  # red in the east
    write_cog(tmp_path / "ortho.tif", colours, GRID)
    return Maps.of({name: tmp_path / f"{name}.tif" for name in ("dsm", "ortho")})


def test_gltf_opens_with_its_texture_and_says_where_it_lies(maps: Any, tmp_path: Path) -> None:
    model = make_model(maps)
    write_glb(tmp_path / "a.glb", model)
    document = pygltflib.GLTF2().load(str(tmp_path / "a.glb"))
    assert document.asset.version == "2.0"
    assert len(document.images) == len(document.textures) == 1
    assert document.materials[0].doubleSided
    assert document.scenes[0].extras["crs"] == "EPSG:32617"
    assert document.scenes[0].extras["origin"] == [436015.0, 3357990.0, 3.0]
    found = trimesh.load(tmp_path / "a.glb", force="mesh")
    # y is up, z is south
    assert found.bounds.tolist() == [[-15.0, 0.0, -10.0], [15.0, 10.0, 10.0]]
    picture = np.asarray(found.visual.material.baseColorTexture.convert("RGB"))
    assert picture.shape == (40, 60, 3)
    assert picture[5, 50].tolist() == [255, 0, 0]
    assert picture[5, 10].tolist() == [0, 0, 0]
    east = found.vertices[:, 0] > 14.9
    assert found.visual.uv[east, 0] == pytest.approx(1.0)


def test_obj_opens_with_its_material(maps: Any, tmp_path: Path) -> None:
    names = {"mesh_obj": "a.obj", "mesh_mtl": "a.mtl", "mesh_texture": "a.png"}
    model = make_model(maps)
    write_obj({name: tmp_path / file for name, file in names.items()}, model)
    found = trimesh.load(tmp_path / "a.obj", force="mesh", process=False)
    assert len(found.faces) == len(model.mesh.faces)
    assert found.bounds.tolist() == [[-15.0, -10.0, 0.0], [15.0, 10.0, 10.0]]
    assert found.visual.material.image.size == (60, 40)
    assert "# crs EPSG:32617" in (tmp_path / "a.obj").read_text()


def test_a_tileset_stands_in_its_place_on_the_globe(maps: Any, tmp_path: Path) -> None:
    model = make_model(maps)
    write_tileset(tmp_path / "tileset.json", "mesh.glb", model, "ellipsoid")
    tileset = json.loads((tmp_path / "tileset.json").read_text())
    assert tileset["asset"]["version"] == "1.1"
    assert tileset["root"]["content"]["uri"] == "mesh.glb"
    matrix = np.reshape(tileset["root"]["transform"], (4, 4)).T
    corner = matrix @ [15.0, 10.0, 10.0, 1.0]  # north-east, on the roof's height
    lon, lat, height = Transformer.from_crs("EPSG:4978", "EPSG:4979", always_xy=True).transform(*corner[:3])
    expected = to_geographic("EPSG:32617", 436030.0, 3358000.0)
    assert (lon, lat) == pytest.approx(expected, abs=1e-7)  # a centimetre
    assert height == pytest.approx(13.0, abs=0.01)
    low, high = np.array([-15, -10, 0]), np.array([15, 10, 10])
    box = np.array(tileset["root"]["boundingVolume"]["box"])
    assert box[:3] == pytest.approx((low + high) / 2)
    assert box[[3, 7, 11]] == pytest.approx((high - low) / 2)


def test_the_globe_knows_what_heights_are_above(maps: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(model3d, "to_datum", lambda heights, *_: (heights + 28.0, "EGM96 geoid"))
    model = make_model(maps)
    up = [to_globe(model, name)[:3, 3] for name in ("ellipsoid", "egm96")]
    # heights above the geoid are 28 m more than above the ellipsoid here: the place lies 28 m lower
    assert np.linalg.norm(up[1]) - np.linalg.norm(up[0]) == pytest.approx(-28.0, abs=0.1)


def test_large_surfaces_become_coarser_meshes(maps: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(model3d, "MOST_CELLS", 600)
    model = make_model(maps)
    assert model.place[:, 0].min() == -15.0
    assert model.place[:, 1].max() == 10.0
    assert len(model.mesh.faces) <= 2 * 600


def test_a_surface_without_heights_is_refused(tmp_path: Path) -> None:
    write_cog(tmp_path / "dsm.tif", np.full(GRID.shape, np.nan, np.float32), GRID)
    with pytest.raises(InputError, match="found a surface without any height"):
        make_model(Maps.of({"dsm": tmp_path / "dsm.tif"}))


def test_meshes_bring_what_they_are_made_of() -> None:
    assert ExportOptions(products=["tiles"]).wanted == ["ortho", "mesh", "tiles"]
    assert ExportOptions(products=["obj"]).wanted == ["ortho", "obj"]
