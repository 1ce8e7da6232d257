"""Which files are opened, and that nothing is sent anywhere because a file said so."""

import json
import shutil
import subprocess
import sys
import warnings
import zipfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import rasterio
from click.testing import CliRunner

from sattools.camera.ground import to_geographic
from sattools.cli import main
from sattools.errors import InputError, SceneError
from sattools.prep.area import bounds_from_file, bounds_from_geojson, wanted_area
from sattools.scene import Scene
from sattools.scene.location import (
    RemotePath,
    image_locations,
    is_remote,
    location,
    needs_network,
    remote_allowed,
)
from sattools.scene.opening import opened
from sattools.scene.raster import read_image
from sattools.scene.tables import read_table
from sattools.scene.vectors import read_features

SERVER = """
import functools, http.server, sys

class Handler(http.server.SimpleHTTPRequestHandler):
    def log_message(self, form, *arguments):
        with open(sys.argv[2], "a") as log:
            log.write(self.path + "\\n")

handler = functools.partial(Handler, directory=sys.argv[1])
with http.server.ThreadingHTTPServer(("127.0.0.1", 0), handler) as running:
    print(running.server_address[1], flush=True)
    running.serve_forever()
"""


class Asked:
    """What a server was asked for so far."""

    def __init__(self, log: Any) -> None:
        self.log = log

    def __call__(self) -> Any:
        return self.log.read_text().split() if self.log.exists() else []


@pytest.fixture
def server(town_source: Any, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Any]:
    """A web server of the town's folder on the loopback address: its address, and what it is asked for.

    It has a process of its own: rasterio holds the interpreter's lock while it opens a file.
    """
    log = tmp_path_factory.mktemp("server") / "asked"
    command = [sys.executable, "-c", SERVER, str(town_source.root), str(log)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as running:
        try:
            yield f"http://127.0.0.1:{int(running.stdout.readline())}", Asked(log)
        finally:
            running.terminate()


def run(*arguments: Any, text: Any = "") -> Any:
    return CliRunner().invoke(main, [*map(str, arguments)], input=text)


@pytest.mark.parametrize(
    ("given", "read"),
    [
        ("http://a.org/x//y.tif", "/vsicurl/http://a.org/x//y.tif"),
        ("https://a.org/y.tif?k=v", "/vsicurl/https://a.org/y.tif?k=v"),
        ("s3://bucket/y.tif", "/vsis3/bucket/y.tif"),
        ("/vsizip/a.zip/y.tif", "/vsizip/a.zip/y.tif"),
        ("/vsicurl/http://a.org/y.tif", "/vsicurl/http://a.org/y.tif"),
    ],
)
def test_addresses_keep_their_spelling(given: Any, read: Any) -> None:
    path = location(given)
    assert isinstance(path, RemotePath)
    assert str(path) == read
    assert location(path) is path
    assert path.stem == "y"
    assert is_remote(read)
    assert needs_network(read) == ("zip" not in read)


def test_paths_stay_paths(tmp_path: Path) -> None:
    assert not isinstance(location(str(tmp_path)), RemotePath)
    assert not is_remote("a:b/c.tif") or location("images/x.tif").name == "x.tif"
    assert str(location("file:///a/b.tif")) == "/a/b.tif"
    with pytest.raises(InputError, match="begins with gopher:"):
        location("gopher://x/y.tif")


HOSTILE = {
    "vrt": '<VRTDataset rasterXSize="9" rasterYSize="9"><VRTRasterBand dataType="Byte" band="1"><SimpleSource>'
    "<SourceFilename>{href}</SourceFilename></SimpleSource></VRTRasterBand></VRTDataset>",
    "wms": '<GDAL_WMS><Service name="TMS"><ServerUrl>{href}</ServerUrl></Service></GDAL_WMS>',
    "wcs": "<WCS_GDAL><ServiceURL>{href}</ServiceURL></WCS_GDAL>",
    "wmts": "WMTS:{href}",
}


@pytest.mark.parametrize("kind", HOSTILE)
def test_descriptions_of_other_files_are_no_images_whatever_their_name(
    tmp_path: Path, server: Any, town_source: Any, kind: Any
) -> None:
    address, asked = server
    image = tmp_path / "image.tif"
    image.write_text(HOSTILE[kind].format(href=f"/vsicurl/{address}/images/TOWN_001.tif"))
    with pytest.raises(InputError, match="not of a format that is read"):
        read_image(image)
    other = town_source.root / "images/TOWN_001.tif"
    result = run("prep", image, other, "--out", tmp_path / "out")
    assert result.exit_code == 1
    assert result.stderr.count("\n") == 1
    assert asked() == []


def test_a_vrt_says_what_makes_an_image_of_it(tmp_path: Path) -> None:
    mosaic = tmp_path / "mosaic.vrt"
    mosaic.write_text(HOSTILE["vrt"].format(href="tile.tif"))
    with pytest.raises(InputError, match=r"mosaic\.vrt: .*gdal_translate makes a GeoTIFF of it"):
        read_image(mosaic)


def test_references_may_be_addresses_and_are_read_without_a_word(make_town: Any, server: Any, tmp_path: Path) -> None:
    address, asked = server
    scene = make_town()
    scene.products["dsm"] = scene.products["truth_dsm"]
    scene.write()
    document, reference = scene.output("scene.json"), f"{address}/{scene.products['truth_dsm']}"
    for call in (("align", document, "--to"), ("change", scene.path(scene.products["dsm"]))):
        done = run(*call, reference, *(("--out", tmp_path / "c") if call[0] == "change" else ()))
        assert done.exit_code == 0, done.stderr
        assert not [line for line in done.stderr.splitlines() if line.startswith("sattools")]
    assert [float(v) for v in (scene.grid.left, scene.grid.top)] == pytest.approx(
        [Scene.from_file(document).grid.left, Scene.from_file(document).grid.top], abs=0.05
    )
    assert asked()


def test_a_sidecar_sends_no_requests(tmp_path: Path, server: Any, town_source: Any) -> None:
    address, asked = server
    image = tmp_path / "image.tif"
    shutil.copy(town_source.root / "images/TOWN_001.tif", image)
    (tmp_path / "image.tif.aux.xml").write_text(
        f'<PAMDataset><Metadata domain="OVERVIEWS"><MDI key="OVERVIEW_FILE">/vsicurl/{address}/images/TOWN_002.tif'
        "</MDI></Metadata></PAMDataset>"
    )
    with opened(image) as data:
        data.overviews(1)
        data.read(1, out_shape=(20, 20))
    assert asked() == []


@pytest.mark.parametrize("href", ["/vsicurl/{}/images/TOWN_001.tif", "{}/images/TOWN_001.tif", "/vsizip/a.zip/x.tif"])
def test_documents_name_remote_files_only_where_the_user_allows_it(make_town: Any, server: Any, href: Any) -> None:
    address, asked = server
    scene = make_town()
    scene.items[0].assets["image"].href = href.format(address)
    result = run("prior", text=scene.to_json())
    assert result.exit_code == 1
    assert "--allow-remote" in result.stderr
    assert result.stderr.count("\n") == 1
    assert asked() == []
    with pytest.raises(SceneError, match="remote"):
        scene.path(scene.items[0].assets["image"].href)
    with remote_allowed():
        assert isinstance(scene.path(scene.items[0].assets["image"].href), RemotePath)


def test_with_allow_remote_a_document_reads_from_there(make_town: Any, server: Any) -> None:
    address, asked = server
    scene = make_town()
    scene.items[0].assets["image"].href = f"{address}/images/TOWN_001.tif"
    arguments = ["--resolution", "2", "--rough-passes", "0"]
    result = run("prior", *arguments, "--allow-remote", text=scene.to_json())
    assert result.exit_code == 0, result.output
    assert "/images/TOWN_001.tif" in asked()
    # and the next call does not inherit it
    assert run("prior", *arguments, "--overwrite", text=scene.to_json()).exit_code == 1


def test_images_and_areas_are_read_from_the_web_and_from_archives(
    tmp_path: Path, server: Any, town_source: Any
) -> None:
    address, _ = server
    archive = tmp_path / "town.zip"
    with zipfile.ZipFile(archive, "w") as file:
        for path in sorted((town_source.root / "images").glob("*.tif")):
            file.write(path, path.name)
    west, south, east, north = town_source.items[0].bbox
    ring = [[west, south], [east, south], [east, north], [west, north], [west, south]]
    (town_source.root / "area.geojson").write_text(
        json.dumps(
            {
                "type": "FeatureCollection",
                "features": [
                    {"type": "Feature", "properties": {}, "geometry": {"type": "Polygon", "coordinates": [ring]}}
                ],
            }
        )
    )
    images = [f"/vsizip/{archive}/TOWN_001.tif", f"{address}/images/TOWN_002.tif"]
    images.append(f"/vsicurl/{address}/images/TOWN_003.tif")
    result = run("prep", *images, "--aoi", f"{address}/area.geojson", "--out", tmp_path, "--id", "WEB")
    assert result.exit_code == 0, result.output
    scene = Scene.from_file(tmp_path / "WEB/scene.json")
    assert [item.id for item in scene.items] == ["TOWN_001", "TOWN_002", "TOWN_003"]
    assert scene.items[1].properties["sattools:source"] == f"/vsicurl/{address}/images/TOWN_002.tif"
    near = bounds_from_geojson(town_source.root / "area.geojson", "EPSG:32617")
    assert bounds_from_geojson(location(f"{address}/area.geojson"), "EPSG:32617") == pytest.approx(near, abs=1e-3)


def test_areas_on_the_web_are_their_polygons_in_utf8(server: Any, town_source: Any) -> None:
    address, _ = server
    x, y, crs = 436_000.0, 3_357_000.0, "EPSG:32617"
    lon, lat = to_geographic(crs, [x, x + 100, x, x], [y, y, y + 100, y])
    text = json.dumps({"type": "Polygon", "coordinates": [np.transpose([lon, lat]).tolist()]})
    (town_source.root / "half.geojson").write_text(text)
    half, box = location(f"{address}/half.geojson"), (x, y, x + 100, y + 100)
    assert wanted_area(half, [], crs)(box).area == pytest.approx(5000.0, abs=1.0)
    assert wanted_area(None, [half], crs)(box).area == pytest.approx(5000.0, abs=1.0)
    (town_source.root / "utf16.geojson").write_text(text, encoding="utf-16")
    with pytest.raises(InputError, match=r"utf16\.geojson: cannot be read .*GeoJSON in UTF-8"):
        bounds_from_file(location(f"{address}/utf16.geojson"), crs)


def test_addresses_of_what_is_read_from_this_machine_only_are_told() -> None:
    told = r"found an address where only files of this machine are read \(download it\)"
    with pytest.raises(InputError, match=told):
        read_table(Path("https://host/points.csv"), "points")
    with pytest.raises(InputError, match=told):
        read_features(Path("https://host/points.gpkg"), "points")


def test_what_is_not_there_on_the_web_is_named(server: Any) -> None:
    address, _ = server
    with pytest.raises(InputError, match=r"none\.tif: cannot be opened"), opened(f"{address}/none.tif"):
        pass


@pytest.mark.parametrize(
    ("name", "words"),
    [("none.tif", "no such file"), (".", "found a folder"), ("x" * 300, "too long"), ("a\udcff.tif", "no such file")],
)
def test_what_is_no_image_is_named(tmp_path: Path, name: Any, words: Any) -> None:
    with pytest.raises(InputError, match=words), opened(f"{tmp_path}/{name}"):
        pass


def test_a_device_is_no_image() -> None:
    with pytest.raises(InputError, match="no regular file"), opened("/dev/zero"):
        pass


def test_an_image_of_more_bands_than_any_sensor_has_is_refused(tmp_path: Path) -> None:
    """A damaged header of 65,535 bands was read band by band, for minutes."""
    path = tmp_path / "x.tif"
    with rasterio.open(path, "w", driver="GTiff", width=1, height=1, count=1001, dtype="uint8") as data:
        data.write(np.zeros((1001, 1, 1), np.uint8))
    with pytest.raises(InputError, match="found 1001 bands, expected at most 1000"), opened(path):
        pass


def test_a_few_bytes_that_claim_to_be_gigabytes_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "bomb.tif"
    profile = {"driver": "GTiff", "width": 100_000, "height": 100_000, "count": 1, "dtype": "uint8", "tiled": True}
    with rasterio.open(path, "w", sparse_ok=True, **profile):
        pass
    with pytest.raises(InputError, match="100000 x 100000 pixels in a file of"), opened(path):
        pass


def test_an_empty_image_that_compresses_well_is_one(tmp_path: Path) -> None:
    path = tmp_path / "empty.tif"
    profile = {"driver": "GTiff", "width": 2000, "height": 2000, "count": 1, "dtype": "uint8", "compress": "deflate"}
    with rasterio.open(path, "w", **profile) as data:
        data.write(np.zeros((1, 2000, 2000), np.uint8))
    assert read_image(path).shape == (1, 2000, 2000)


def test_a_folder_stands_for_the_images_in_it(tmp_path: Path) -> None:
    for name in ("b.TIF", "a.tif", "a_RPC.TXT", "c.ntf"):
        (tmp_path / name).touch()
    (tmp_path / "more").mkdir()
    found = image_locations(["https://host/x.tif", str(tmp_path)])
    assert isinstance(found[0], RemotePath)
    assert [path.name for path in found[1:]] == ["a.tif", "b.TIF", "c.ntf"]
    with pytest.raises(InputError, match=r"more: found a folder without images, expected some \(\.tif"):
        image_locations([str(tmp_path / "more")])


def test_images_in_their_own_geometry_are_opened_without_a_warning(tmp_path: Path) -> None:
    path = tmp_path / "image.tif"
    with rasterio.open(path, "w", driver="GTiff", width=8, height=4, count=1, dtype="uint8") as data:
        data.write(np.ones((1, 4, 8), np.uint8))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        with opened(path) as data:
            assert data.read().sum() == 32
    with pytest.warns(rasterio.errors.NotGeoreferencedWarning), rasterio.open(path):
        pass  # which rasterio says otherwise


@pytest.mark.skipif(sys.platform == "win32", reason="names have no colons there")
@pytest.mark.parametrize("name", ["file:2/image.tif", "zip:image.tif", "2024-05-01T10:20:30.tif"])
def test_a_colon_in_the_name_of_a_file_makes_no_address_of_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str
) -> None:
    path = tmp_path / name
    path.parent.mkdir(exist_ok=True)
    with rasterio.open(path, "w", driver="GTiff", width=8, height=4, count=1, dtype="uint8") as data:
        data.write(np.ones((1, 4, 8), np.uint8))
    monkeypatch.chdir(tmp_path)
    assert read_image(location(name)).sum() == 32
