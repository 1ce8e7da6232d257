"""The mesh of the surface in files for viewers: glTF, OBJ, 3D Tiles, with the orthophoto on it."""

from __future__ import annotations

import io
import json
import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from sattools.errors import InputError, extra
from sattools.export.datum import ELLIPSOID, to_datum
from sattools.export.products.colours import Palette
from sattools.export.products.maps import Maps
from sattools.export.products.mesh import Mesh, mesh_of
from sattools.scene.files import write_bytes, write_text
from sattools.scene.grid import Grid
from sattools.scene.jsonio import JsonObject

MOST_CELLS = 4_000_000  # of a mesh; larger surfaces are made coarser
LONGEST_TEXTURE = 4096  # pixels
TOLERANCE_M = 0.25  # by which a face may miss the surface, and as much as a quarter of a cell
_ROUGH = 1.0  # material without highlights


@dataclass(frozen=True)
class Model3D:
    """A textured mesh in metres around an origin.

    Attributes:
        mesh: of the surface.
        place: ``[N, 3]`` vertices: east, north, up of the origin [m].
        uv: ``[N, 2]`` place in the texture, in [0, 1] from its lower left.
        texture: ``[h, w, 3]`` uint8.
        origin: easting, northing, height of the origin [m].
        grid: of the surface.
        datum: what heights are above.
    """

    mesh: Mesh
    place: np.ndarray
    uv: np.ndarray
    texture: np.ndarray
    origin: tuple[float, float, float]
    grid: Grid
    datum: str

    @property
    def about(self) -> dict[str, Any]:
        """Where it lies, for the files' own remarks."""
        east, north, up = self.origin
        return {"crs": self.grid.crs, "origin": [east, north, up], "heights": f"above {self.datum}"}


def make_model(maps: Maps, datum: str = ELLIPSOID) -> Model3D:
    """The mesh of a DSM with the orthophoto on it, or the albedo where there is none.

    Args:
        maps: DSM, and orthophoto or albedo.
        datum: what the heights are above.

    Raises:
        InputError: a DSM without any height.
    """
    grid = maps.grid
    longest = max(1, math.floor(max(grid.shape) * min(1.0, math.sqrt(MOST_CELLS / (grid.width * grid.height)))))
    height = maps.picture("dsm", longest)[0]
    if not np.isfinite(height).any():
        raise InputError("mesh: found a surface without any height, expected some")
    rows, cols = height.shape
    cell = grid.cell_size * grid.width / cols
    mesh = mesh_of(height, cell, max(TOLERANCE_M, 0.25 * cell))
    west, south, east, north = grid.bounds
    base = float(np.floor(np.nanmin(height)))
    share = mesh.vertices[:, :2] / (cols, rows)
    place = np.stack(
        [(share[:, 0] - 0.5) * (east - west), (0.5 - share[:, 1]) * (north - south), mesh.vertices[:, 2] - base], axis=1
    )
    name = "ortho" if "ortho" in maps.paths else "albedo"
    texture = Palette.of(maps, name).shown(maps.picture(name, LONGEST_TEXTURE))
    uv = np.stack([share[:, 0], 1.0 - share[:, 1]], axis=1)
    origin = (*grid.middle, base)
    return Model3D(mesh, place, uv, texture, origin, grid, datum)


def write_glb(path: Path, model: Model3D) -> None:
    """Write binary glTF: x east, y up, z south; `extras` of its scene say where the origin lies.

    Args:
        path: to write.
        model: the mesh.
    """
    trimesh = extra("trimesh", "products")
    from trimesh.visual.material import PBRMaterial

    material = PBRMaterial(
        baseColorTexture=_picture(model), metallicFactor=0.0, roughnessFactor=_ROUGH, doubleSided=True
    )
    upright = model.place[:, [0, 2, 1]] * (1.0, 1.0, -1.0)
    scene = trimesh.Scene(_trimesh(trimesh, upright, model, material))
    scene.metadata.update(model.about)
    write_bytes(path, scene.export(file_type="glb"))


def write_obj(files: Mapping[str, Path], model: Model3D) -> None:
    """Write OBJ, its material and its texture: x east, y north, z up.

    Args:
        files: `mesh_obj`, `mesh_mtl` and `mesh_texture`.
        model: the mesh.
    """
    lines = [f"# {name} {value}" for name, value in model.about.items()]
    lines += [f"mtllib {files['mesh_mtl'].name}", "usemtl surface"]
    lines += [f"v {x:.3f} {y:.3f} {z:.3f}" for x, y, z in model.place]
    lines += [f"vt {u:.6f} {v:.6f}" for u, v in model.uv]
    lines += [f"f {a}/{a} {b}/{b} {c}/{c}" for a, b, c in (model.mesh.faces + 1).tolist()]
    write_text(files["mesh_obj"], "\n".join(lines) + "\n")
    material = ["newmtl surface", "Ka 1 1 1", "Kd 1 1 1", "Ks 0 0 0", f"map_Kd {files['mesh_texture'].name}"]
    write_text(files["mesh_mtl"], "\n".join(material) + "\n")
    stream = io.BytesIO()
    _picture(model).save(stream, format="PNG")
    write_bytes(files["mesh_texture"], stream.getbuffer())


def write_tileset(path: Path, content: str, model: Model3D, vertical: str) -> None:
    """Write a 3D Tiles tileset of one tile that stands in its place on the globe.

    Args:
        path: to write.
        content: the tile's glTF file, relative to the tileset.
        model: the mesh.
        vertical: name of its vertical datum.
    """
    low, high = model.place.min(axis=0), model.place.max(axis=0)
    middle, half = (low + high) / 2, (high - low) / 2
    box = [*middle, half[0], 0, 0, 0, half[1], 0, 0, 0, half[2]]
    root: JsonObject = {
        "boundingVolume": {"box": [float(v) for v in box]},
        "geometricError": 0.0,
        "refine": "ADD",
        "transform": [float(v) for v in to_globe(model, vertical).T.ravel()],
        "content": {"uri": content},
    }
    whole = float(np.hypot(*(2 * half[:2])))
    tileset = {"asset": {"version": "1.1", "extras": model.about}, "geometricError": whole, "root": root}
    write_text(path, json.dumps(tileset, indent=1) + "\n")


def to_globe(model: Model3D, vertical: str) -> np.ndarray:
    """Matrix ``[4, 4]`` from the mesh's metres (east, north, up on the grid) to the Earth's (EPSG:4978).

    Args:
        model: the mesh.
        vertical: name of its vertical datum.
    """
    from pyproj import Transformer

    from sattools.camera.ground import to_geographic

    east, north, up = model.origin
    if vertical != "ellipsoid":
        point = Grid(model.grid.crs, east - 0.5, north + 0.5, 1.0, 1, 1)
        up -= float(to_datum(np.zeros((1, 1), np.float32), point, vertical)[0][0, 0])
    step = 100.0
    x = east + np.array([0.0, step, 0.0, 0.0])
    y = north + np.array([0.0, 0.0, step, 0.0])
    lon, lat = to_geographic(model.grid.crs, x, y)
    transformer = Transformer.from_crs("EPSG:4979", "EPSG:4978", always_xy=True)
    points = np.stack(transformer.transform(lon, lat, up + np.array([0.0, 0.0, 0.0, step])), axis=1)
    matrix = np.eye(4)
    matrix[:3, :3] = (points[1:] - points[0]).T / step
    matrix[:3, 3] = points[0]
    return matrix


def _picture(model: Model3D) -> Any:
    from PIL import Image

    return Image.fromarray(model.texture)


def _trimesh(trimesh: Any, vertices: np.ndarray, model: Model3D, material: Any) -> Any:
    visual = trimesh.visual.TextureVisuals(uv=model.uv, material=material)
    return trimesh.Trimesh(vertices, model.mesh.faces, visual=visual, process=False)


__all__ = ["Model3D", "make_model", "to_globe", "write_glb", "write_obj", "write_tileset"]
