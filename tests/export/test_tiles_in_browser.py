"""3D Tiles in a real browser, by a viewer that shares no code with what wrote them."""

import functools
import html
import json
import re
import shutil
import subprocess
import threading
from collections.abc import Iterator
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from patience import HANGING_S

from sattools.camera.ground import to_geographic
from sattools.export.products.maps import Maps
from sattools.export.products.model3d import Model3D, make_model, write_glb, write_tileset
from sattools.scene import Grid
from sattools.scene.raster import write_cog

VIEWER = Path(__file__).parents[2] / "examples/viewer.html"
BROWSER = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)
GRID = Grid("EPSG:32617", 436000.0, 3358000.0, 1.0, 60, 60)
FLAGS = (
    *("--headless", "--no-sandbox", "--disable-dev-shm-usage", "--no-first-run", "--disable-background-networking"),
    *("--disable-component-update", "--disable-sync", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"),
    *("--window-size=400,400", "--dump-dom"),
)
BUDGETS_MS = (20_000, 200_000, 2_000_000)  # of the page's own time; on a busy machine drawing falls behind it


class Quiet(SimpleHTTPRequestHandler):
    def log_message(self, format: str, *args: Any) -> None:
        """Nothing."""


@pytest.fixture
def served(tmp_path: Path) -> Iterator[tuple[Path, str]]:
    """A folder and the address at which this machine alone can see it."""
    server = ThreadingHTTPServer(("127.0.0.1", 0), functools.partial(Quiet, directory=str(tmp_path)))
    thread = threading.Thread(target=server.serve_forever, daemon=True)
    thread.start()
    yield tmp_path, f"http://127.0.0.1:{server.server_port}"
    server.shutdown()
    server.server_close()
    thread.join()


def look(address: str, profile: Path) -> Any:
    page = f"{address}/viewer.html?tileset.json"
    for budget in BUDGETS_MS:
        command = [str(BROWSER), *FLAGS, f"--virtual-time-budget={budget}", f"--user-data-dir={profile}", page]
        done = subprocess.run(command, capture_output=True, text=True, timeout=HANGING_S)
        title = re.search(r"<title>(.*?)</title>", done.stdout)
        assert title, done.stderr
        if title[1] != "loading":
            break
    return json.loads(html.unescape(title[1]))


def tiles_of(height: np.ndarray, grid: Grid, folder: Path) -> Model3D:
    """Heights ``[H, W]``, red in the north-east, blue in the south-west, else green, as 3D Tiles beside the viewer."""
    rows, cols = grid.height // 2, grid.width // 2
    albedo = np.zeros((3, *grid.shape), np.float32)
    albedo[1] = 0.5
    albedo[:, :rows, cols:] = np.array([1.0, 0.0, 0.0])[:, None, None]
    albedo[:, rows:, :cols] = np.array([0.0, 0.0, 1.0])[:, None, None]
    write_cog(folder / "dsm.tif", height[None], grid)
    write_cog(folder / "albedo.tif", albedo, grid)
    maps = Maps.of({name: folder / f"{name}.tif" for name in ("dsm", "albedo")})
    model = make_model(maps, "WGS84 ellipsoid")
    write_glb(folder / "mesh.glb", model)
    write_tileset(folder / "tileset.json", "mesh.glb", model, "ellipsoid")
    shutil.copy(VIEWER, folder / "viewer.html")
    return model


def assert_coloured(seen: Any) -> None:
    red, blue = seen["north_east"], seen["south_west"]
    assert red[0] > 200
    assert max(red[1:]) < 60
    assert blue[2] > 200
    assert max(blue[:2]) < 60


@pytest.mark.skipif(BROWSER is None, reason="no Chromium or Chrome on this machine")
def test_a_tileset_is_drawn_in_its_place_and_its_colours(served: Any, tmp_path_factory: pytest.TempPathFactory) -> None:
    folder, address = served
    height = np.full(GRID.shape, 5.0, np.float32)
    height[10:25, 35:50] = 20.0  # a house in the north-east
    model = tiles_of(height, GRID, folder)

    seen = look(address, tmp_path_factory.mktemp("profile"))
    assert "failed" not in seen, seen
    assert seen["error"] == 0
    assert seen["faces"] == len(model.mesh.faces)
    lon, lat = to_geographic(GRID.crs, np.array([436030.0]), np.array([3357970.0]))
    assert (seen["lon"], seen["lat"]) == pytest.approx((float(lon[0]), float(lat[0])), abs=2e-7)  # 2 cm
    assert (seen["lowest"], seen["highest"]) == pytest.approx((5.0, 20.0), abs=0.01)
    assert_coloured(seen)


@pytest.mark.skipif(BROWSER is None, reason="no Chromium or Chrome on this machine")
def test_a_mesh_of_more_points_than_16_bits_count_and_a_call_takes_is_drawn(
    served: Any, tmp_path_factory: pytest.TempPathFactory
) -> None:
    """The four cells at a corner differ in height, so that walls stand around each and no face can be spared."""
    folder, address = served
    grid = Grid("EPSG:32617", 436000.0, 3358000.0, 1.0, 200, 200)
    row, col = np.indices(grid.shape)
    model = tiles_of((5.0 + 10.0 * (row % 2) + 5.0 * (col % 2)).astype(np.float32), grid, folder)
    assert len(model.mesh.vertices) > 130_000  # of which 65 535 can be counted in 16 bits

    seen = look(address, tmp_path_factory.mktemp("profile"))
    assert "failed" not in seen, seen
    assert seen["error"] == 0
    assert seen["faces"] == len(model.mesh.faces)
    assert (seen["lowest"], seen["highest"]) == pytest.approx((5.0, 20.0), abs=0.01)
    assert_coloured(seen)
