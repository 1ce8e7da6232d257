"""An area of interest is its polygon, not its box, and masks are cut out of it."""

import json
import zipfile
from dataclasses import replace
from pathlib import Path
from typing import Any

import geopandas
import numpy as np
import pytest
import shapely
from shapely.geometry import GeometryCollection, LineString, MultiPolygon, Point, Polygon, box

from sattools.camera.ground import to_geographic
from sattools.errors import InputError
from sattools.export.options import ExportOptions
from sattools.export.stage import export
from sattools.fit.options import FitOptions
from sattools.fit.stage import fit
from sattools.fit.tiles import crew, plan
from sattools.prep.area import bounds_from_file, wanted_area
from sattools.prep.options import PrepOptions
from sattools.prep.stage import prepare
from sattools.scene.area import wanted_cells, write_area
from sattools.scene.raster import read_raster
from sattools.scene.validity import UNWANTED
from sattools.scene.vectors import is_vector, numbered_polygons, read_features

UTM33 = "EPSG:32633"
X, Y = 500_000.0, 5_094_000.0
BOX = (X, Y, X + 100, Y + 100)
QUICK = FitOptions(resolution=2.0, coarsest=2.0, epochs=[2], prior_weight=0.0)


def written(path: Path, *shapes: Any, crs: str = UTM33) -> Path:
    geopandas.GeoDataFrame(geometry=list(shapes), crs=crs).to_file(path)
    return path


def test_the_wanted_area_is_the_polygon_without_the_masks(tmp_path: Path) -> None:
    triangle = Polygon([(X, Y), (X + 100, Y), (X, Y + 100)])
    aoi, lake = written(tmp_path / "aoi.gpkg", triangle), written(tmp_path / "lake.gpkg", box(X, Y, X + 10, Y + 20))
    assert wanted_area(aoi, [], UTM33)(BOX).area == pytest.approx(5000.0)
    assert wanted_area(aoi, [lake], UTM33)(BOX).area == pytest.approx(4800.0)
    assert wanted_area(None, [lake], UTM33)(BOX).area == pytest.approx(9800.0)


KML = """<?xml version="1.0" encoding="UTF-8"?>
<kml xmlns="http://www.opengis.net/kml/2.2"><Document><name>areas</name>
<Folder><name>A</name><Placemark><name>field</name><Style/><Polygon>
<outerBoundaryIs><LinearRing><coordinates>{outer}</coordinates></LinearRing></outerBoundaryIs>
<innerBoundaryIs><LinearRing><coordinates>{inner}</coordinates></LinearRing></innerBoundaryIs>
</Polygon></Placemark></Folder>
<Folder><name>B</name><Placemark><name>yards</name><MultiGeometry>
<Polygon><outerBoundaryIs><LinearRing><coordinates>{yard}</coordinates></LinearRing></outerBoundaryIs></Polygon>
</MultiGeometry></Placemark><Placemark><name>tree</name><Point><coordinates>15,46</coordinates></Point></Placemark>
</Folder></Document></kml>
"""


def kml_ring(west: float, south: float, east: float, north: float) -> str:
    lon, lat = to_geographic(UTM33, *np.array(box(X + west, Y + south, X + east, Y + north).exterior.coords).T)
    return "\n  ".join(f"{a:.10f},{b:.10f},0" for a, b in zip(lon, lat, strict=True))


def test_the_polygons_of_all_folders_of_a_kml_count(tmp_path: Path) -> None:
    rings = {"outer": (0, 0, 40, 40), "inner": (10, 10, 20, 20), "yard": (60, 60, 80, 70)}
    path = tmp_path / "areas.kml"
    path.write_text(KML.format(**{name: kml_ring(*ring) for name, ring in rings.items()}))
    assert wanted_area(path, [], UTM33)(BOX).area == pytest.approx(1600 - 100 + 200, abs=0.1)
    assert wanted_area(None, [path], UTM33)(BOX).area == pytest.approx(10_000 - 1700, abs=0.1)
    assert bounds_from_file(path, UTM33) == pytest.approx((X, Y, X + 80, Y + 70), abs=0.01)
    assert list(numbered_polygons(path, UTM33)) == [0, 1]


@pytest.mark.parametrize("encoding", ["utf-8", "utf-8-sig", "utf-16"])
@pytest.mark.parametrize("ending", ["geojson", "kml"])
def test_areas_and_masks_may_have_a_byte_order_mark(tmp_path: Path, ending: str, encoding: str) -> None:
    path = tmp_path / f"area.{ending}"
    if ending == "kml":
        ring = kml_ring(0, 0, 40, 30)
        text = KML.replace("UTF-8", encoding.removesuffix("-sig")).format(outer=ring, inner=ring, yard=ring)
    else:
        field = geopandas.GeoDataFrame({"name": ["Äcker"]}, geometry=[box(X, Y, X + 40, Y + 30)], crs=UTM33)
        text = field.to_crs("EPSG:4326").to_json(ensure_ascii=False)
    path.write_bytes(text.encode(encoding))
    assert bounds_from_file(path, UTM33) == pytest.approx((X, Y, X + 40, Y + 30), abs=0.01)
    assert wanted_area(path, [], UTM33)(BOX).area == pytest.approx(1200.0, abs=0.1)
    assert wanted_area(None, [path], UTM33)(BOX).area == pytest.approx(8800.0, abs=0.1)
    if ending == "geojson":
        assert list(read_features(path, "areas").columns["name"]) == ["Äcker"]


def test_a_polygon_with_a_label_beside_it_is_a_polygon(tmp_path: Path) -> None:
    label = "<MultiGeometry><Point><coordinates>15,46</coordinates></Point>"
    rings = {"outer": (0, 0, 40, 40), "inner": (10, 10, 20, 20), "yard": (60, 60, 80, 70)}
    kml = tmp_path / "areas.kml"
    kml.write_text(KML.format(**{k: kml_ring(*ring) for k, ring in rings.items()}).replace("<MultiGeometry>", label))
    assert wanted_area(kml, [], UTM33)(BOX).area == pytest.approx(1600 - 100 + 200, abs=0.1)
    triangle, yard = Polygon([(X, Y), (X + 100, Y), (X, Y + 100)]), box(X + 90, Y + 90, X + 100, Y + 100)
    nested = GeometryCollection([Point(X, Y), GeometryCollection([triangle]), MultiPolygon([yard])])
    for name in ("nested.gpkg", "nested.geojson"):
        path = tmp_path / name
        geopandas.GeoDataFrame(geometry=[nested], crs=UTM33).to_crs(UTM33 if "gpkg" in name else "EPSG:4326").to_file(
            path
        )
        assert wanted_area(path, [], UTM33)(BOX).area == pytest.approx(5100.0, abs=0.1)


@pytest.mark.parametrize(
    ("content", "told"),
    [
        ("<kml><Placemark><Polygon>", r"areas.kml: found unreadable XML \(.*\), expected KML"),
        ("<a><!-- <kml> --></a>", "areas.kml: found XML with root <a>, expected KML"),
        (KML.format(outer="15 46 15", inner="", yard=""), "areas.kml: found the place '15', expected longitude,lat"),
        (KML.format(outer="15,46 15,47", inner="", yard=""), "areas.kml: found a Polygon that is none"),
        ("<kml><Placemark><Point><coordinates>15,46</coordinates></Point></Placemark></kml>", "found no polygon"),
        ("PK\x03\x04 doc.kml", r"areas.kml: found an archive that cannot be unpacked \(.*\), expected KMZ"),
    ],
)
def test_a_kml_without_an_area_is_told(tmp_path: Path, content: str, told: str) -> None:
    (tmp_path / "areas.kml").write_text(content)
    with pytest.raises(InputError, match=told):
        wanted_area(tmp_path / "areas.kml", [], UTM33)


def kmz(path: Path, **files: str) -> Path:
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, text in files.items():
            archive.writestr(f"{name}.kml", text)
        archive.writestr("files/icon.png", b"\x89PNG")
    return path


@pytest.mark.parametrize("others", [{}, {"another": "<kml></kml>"}])
def test_a_kmz_is_the_kml_in_it(tmp_path: Path, others: dict[str, str]) -> None:
    rings = {"outer": (0, 0, 40, 40), "inner": (10, 10, 20, 20), "yard": (60, 60, 80, 70)}
    text = KML.format(**{name: kml_ring(*ring) for name, ring in rings.items()})
    path = kmz(tmp_path / "areas.kmz", **others, doc=text)
    assert is_vector(path)
    assert wanted_area(path, [], UTM33)(BOX).area == pytest.approx(1600 - 100 + 200, abs=0.1)
    assert sorted(entry.name for entry in tmp_path.iterdir()) == ["areas.kmz"]


@pytest.mark.parametrize(
    ("files", "told"),
    [
        ({}, r"areas\.kmz: found a ZIP archive without KML, expected KMZ \(or unpack it\)"),
        ({"a": "<kml/>", "b": "<kml/>"}, "found a.kml, b.kml, expected one KML file, or one of them to be doc.kml"),
        ({"doc": "<kml>" + " " * (64 << 20)}, "found KML of more than 64 MiB, expected less"),
        ({"doc": '<!DOCTYPE k [<!ENTITY e "e">]><kml>&e;</kml>'}, r"found unreadable XML \(EntitiesForbidden"),
    ],
    ids=["none", "two", "bomb", "entity"],
)
def test_a_kmz_without_an_area_is_told(tmp_path: Path, files: dict[str, str], told: str) -> None:
    with pytest.raises(InputError, match=told):
        wanted_area(kmz(tmp_path / "areas.kmz", **files), [], UTM33)


def test_rings_that_cross_lose_no_part(tmp_path: Path) -> None:
    bow = Polygon([(X, Y), (X + 60, Y + 50), (X + 60, Y), (X, Y + 50)])  # two triangles of 750 m2
    path = written(tmp_path / "bow.gpkg", bow)
    assert wanted_area(path, [], UTM33)(BOX).area == pytest.approx(1500.0)
    assert wanted_area(None, [path], UTM33)(BOX).area == pytest.approx(8500.0)


def test_ground_that_a_ring_goes_around_twice_counts_and_holes_across_a_border_are_holes(tmp_path: Path) -> None:
    corners = [(0, 0), (50, 0), (50, 50), (10, 50), (10, 10), (40, 10), (40, 40), (0, 40)]  # its end within its start
    path = written(tmp_path / "loop.gpkg", Polygon([(X + x, Y + y) for x, y in corners]))
    assert wanted_area(path, [], UTM33)(BOX).area == pytest.approx(2400.0)
    hole = box(X + 25, Y + 10, X + 75, Y + 40).exterior.coords
    path = written(tmp_path / "hole.gpkg", Polygon(box(X, Y, X + 50, Y + 50).exterior.coords, [hole]))
    assert wanted_area(path, [], UTM33)(BOX).area == pytest.approx(1750.0)


def test_polygons_of_places_that_cannot_be_projected_are_left_out_and_told(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    path = tmp_path / "world.geojson"
    lon, lat = (float(v) for v in to_geographic(UTM33, X + 10, Y + 10))
    here = [[lon, lat], [lon + 1e-4, lat], [lon + 1e-4, lat + 1e-4], [lon, lat]]
    far = [[lon, lat], [1e300, lat], [lon, lat + 1], [lon, lat]]
    shapes = [{"type": "Polygon", "coordinates": [ring]} for ring in (far, here)]
    features = [{"type": "Feature", "properties": {}, "geometry": shape} for shape in shapes]
    path.write_text(json.dumps({"type": "FeatureCollection", "features": features}))
    assert list(numbered_polygons(path, UTM33)) == [1]
    assert [one.getMessage() for one in caplog.records] == [
        f"{path}: 1 of its features left out, as far as their places cannot be brought to {UTM33}"
    ]


def test_a_file_of_several_layers_says_which_is_read(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    path = tmp_path / "places.gpkg"
    for name, side in (("town", 20), ("lake", 10)):
        frame = geopandas.GeoDataFrame(geometry=[box(X, Y, X + side, Y + side)], crs=UTM33)
        frame.to_file(path, layer=name)
    assert wanted_area(path, [], UTM33)(BOX).area == pytest.approx(400.0)
    (said,) = [one.getMessage() for one in caplog.records]
    assert said.endswith("places.gpkg: found 2 layers, of which the first is read, 'town'")


def test_a_rectangle_along_the_grid_needs_no_area(tmp_path: Path) -> None:
    assert wanted_area(written(tmp_path / "aoi.gpkg", box(*BOX)), [], UTM33)(BOX) is None
    assert wanted_area(None, [], UTM33)(BOX) is None


def test_points_and_lines_ask_for_their_box(tmp_path: Path) -> None:
    path = tmp_path / "points.geojson"
    path.write_text(json.dumps({"type": "MultiPoint", "coordinates": [[15.0, 46.0], [15.1, 46.0], [15.0, 46.1]]}))
    assert wanted_area(path, [], UTM33)(BOX) is None


@pytest.mark.parametrize("name", ["area.geojson", "area.gpkg"])
def test_points_and_lines_beside_polygons_are_left_out_and_told(
    name: str, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    path, crs = tmp_path / name, "EPSG:4326" if name.endswith("geojson") else UTM33
    shapes = [box(X, Y, X + 40, Y + 30), Point(X + 30_000, Y), LineString([(X, Y), (X, Y + 9000)])]
    geopandas.GeoDataFrame(geometry=shapes, crs=UTM33).to_crs(crs).to_file(path)
    assert bounds_from_file(path, UTM33) == pytest.approx((X, Y, X + 40, Y + 30), abs=0.01)
    assert wanted_area(path, [], UTM33)(BOX).area == pytest.approx(1200.0, abs=0.1)
    (said,) = [one.getMessage() for one in caplog.records]
    assert said == f"{path}: 2 of its features left out, as points and lines beside its polygons"


def test_a_ring_that_is_not_closed_asks_for_its_box_and_that_is_told(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    path = tmp_path / "open.geojson"
    path.write_text(json.dumps({"type": "Polygon", "coordinates": [[[15.0, 46.0], [15.1, 46.0], [15.0, 46.1]]]}))
    assert wanted_area(path, [], UTM33)(BOX) is None
    (said,) = [one.getMessage() for one in caplog.records]
    assert said.startswith(f"{path}: cannot be read (")
    assert said.endswith("(the box of all its places is taken)")


def test_a_mask_over_everything_and_one_without_polygons_are_refused(tmp_path: Path) -> None:
    sea = written(tmp_path / "sea.gpkg", box(X - 1, Y - 1, X + 200, Y + 200))
    with pytest.raises(InputError, match=r"sea\.gpkg: found no ground that is left of the scene"):
        wanted_area(None, [sea], UTM33)(BOX)
    with pytest.raises(InputError, match=r"wells\.gpkg: found no polygon, expected some"):
        wanted_area(None, [written(tmp_path / "wells.gpkg", Point(X, Y))], UTM33)


def test_ground_outside_the_area_is_no_data_in_all_products(make_town: Any) -> None:
    scene = make_town()
    west, south, east, north = scene.require_grid().bounds
    write_area(scene, Polygon([(west, south), (east, south), (west, north)]))
    fit(scene, QUICK)
    made = export(scene, ExportOptions())
    dsm, grid = read_raster(scene.path(scene.products["dsm"]))
    wanted = wanted_cells(scene, grid)
    assert wanted is not None
    # the triangle is half of the square, but for cells on its edge
    assert wanted.mean() == pytest.approx(0.5, abs=0.02)
    assert np.isfinite(dsm[0])[wanted].mean() > 0.95
    assert not np.isfinite(dsm[0])[~wanted].any()
    validity = read_raster(scene.path(scene.products["validity"]))[0][0]
    np.testing.assert_array_equal(validity == UNWANTED, ~wanted)
    assert made["validity"]["outside"] == pytest.approx((~wanted).mean(), abs=1e-3)
    assert np.isnan(read_raster(scene.path(scene.products["albedo"]))[0][:, ~wanted]).all()


def test_tiles_outside_the_area_are_not_fitted(make_town: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    scene = make_town()
    west, south, _, north = scene.require_grid().bounds
    write_area(scene, box(west, south, west + 10, north))
    fitted = []
    original = plan.fit_whole

    def seen(one: Any, *given: Any) -> Any:
        fitted.append(one.id)
        return original(one, *given)

    for module in (plan, crew):
        monkeypatch.setattr(module, "fit_whole", seen)
    fit(scene, replace(QUICK, tile=32.0, overlap=8.0))
    assert fitted == ["TOWN.coarse", "TOWN.r0c0", "TOWN.r1c0"]


def test_prep_cuts_area_and_masks_and_checks_them_first(make_town: Any, tmp_path: Path) -> None:
    town = make_town()
    images = [town.path(item.assets["image"].href) for item in town.items[:3]]
    west, south, east, north = town.require_grid().bounds
    crs = town.require_grid().crs
    aoi = written(tmp_path / "aoi.gpkg", Polygon([(west, south), (east, south), (east, north)]), crs=crs)
    lake = written(tmp_path / "lake.geojson", box(east - 20, south, east, south + 20), crs=crs)
    options = PrepOptions(out=str(tmp_path / "out"), id="A", aoi=str(aoi), mask=[str(tmp_path / "none.gpkg")])
    with pytest.raises(InputError, match=r"none\.gpkg"):
        prepare(images, options)
    assert [p for p in (tmp_path / "out").rglob("*") if p.is_file()] == []
    scene, _ = prepare(images, replace(options, mask=[str(lake)]))
    assert scene.products["area"] == "area.geojson"
    frame = geopandas.read_file(scene.path("area.geojson"))
    assert frame.crs.to_epsg() == 4326
    area = shapely.union_all(frame.to_crs(crs).geometry)
    assert area.area == pytest.approx(64 * 64 / 2 - 400, rel=0.01)
