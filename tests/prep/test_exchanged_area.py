"""Areas whose latitudes stand where longitudes belong: refused, and told why."""

import json
from pathlib import Path
from typing import Any

import geopandas
import pytest
from shapely.geometry import box

from sattools.camera.ground import to_geographic
from sattools.errors import InputError
from sattools.prep.area import bounds_from_file, exchanged_bounds
from sattools.prep.options import PrepOptions
from sattools.prep.stage import check_inputs

HINT = r"\(with its coordinates exchanged it is there: longitude comes first\)$"
TOKYO = "EPSG:32654"


def refused(town_source: Any, tmp_path: Path, told: str, **area: Any) -> None:
    metadata = str(town_source.root / "metadata")
    options = PrepOptions(id="Q", out=str(tmp_path / "out"), metadata=metadata, **area)
    with pytest.raises(InputError, match=told):
        check_inputs(sorted((town_source.root / "images").glob("*.tif")), options)


def in_degrees(town_source: Any) -> Any:
    west, south, east, north = town_source.grid.bounds
    lon, lat = to_geographic(town_source.grid.crs, [west, east], [south, north])
    return float(lon[0]), float(lat[0]), float(lon[1]), float(lat[1])


@pytest.mark.parametrize("ending", ["geojson", "gpkg"])
def test_areas_that_are_in_the_images_once_exchanged_say_so(town_source: Any, tmp_path: Path, ending: str) -> None:
    west, south, east, north = in_degrees(town_source)
    refused(town_source, tmp_path, HINT, bounds=[south, west, north, east])
    path = tmp_path / f"area.{ending}"
    geopandas.GeoDataFrame(geometry=[box(south, west, north, east)], crs="EPSG:4326").to_file(path)
    refused(town_source, tmp_path, HINT, aoi=str(path))


def test_areas_elsewhere_have_no_such_hint(town_source: Any, tmp_path: Path) -> None:
    refused(town_source, tmp_path, "expected an area inside the images$", bounds=[10.0, 30.0, 10.1, 30.1])
    utm = {"bounds": [10.0, 30.0, 60.0, 80.0], "crs": town_source.grid.crs}
    refused(town_source, tmp_path, "expected an area inside the images$", **utm)
    path = tmp_path / "broken.geojson"
    path.write_text("{}")
    refused(town_source, tmp_path, "broken.geojson: found no polygon", aoi=str(path))


def test_longitudes_that_are_no_latitudes_can_be_exchanged(tmp_path: Path) -> None:
    path = tmp_path / "area.geojson"
    ring = [[35.0, 139.0], [35.5, 139.0], [35.5, 139.4], [35.0, 139.0]]
    path.write_text(json.dumps({"type": "Polygon", "coordinates": [ring]}))
    with pytest.raises(InputError, match="coordinates that are no degrees"):
        bounds_from_file(path, TOKYO)
    west, south, east, north = exchanged_bounds(path, TOKYO) or (0, 0, 0, 0)
    assert (west, south) == pytest.approx((317_000, 3_874_000), abs=1000)
    assert (east, north) == pytest.approx((355_000, 3_930_000), abs=1000)
    assert exchanged_bounds([35.0, 139.0, 35.5, 139.4], TOKYO) == pytest.approx((west, south, east, north))
