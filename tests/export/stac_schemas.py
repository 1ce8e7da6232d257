"""JSON schemas of the fields that we write of three STAC extensions, so that pystac validates without a network.

Written after the extensions' own texts (projection 2.0, raster 2.0, eo 2.0), as far as our files use them: an unknown
field of an extension's prefix is an error.
"""

from typing import Any

BASE = "https://stac-extensions.github.io"
COLOURS = ["pan", "coastal", "blue", "green", "yellow", "red", "rededge", "nir", "nir08", "nir09", "cirrus"]


def numbers(*counts: int) -> Any:
    return {"type": "array", "items": {"type": "number"}, "oneOf": [{"minItems": n, "maxItems": n} for n in counts]}


def schema(name: str, version: str, fields: Any) -> Any:
    prefix = {"projection": "proj"}.get(name, name)
    address = f"{BASE}/{name}/{version}/schema.json"
    closed = {
        "type": "object",
        "properties": fields,
        "patternProperties": {f"^(?!{prefix}:)": {}},
        "additionalProperties": False,
    }
    with_bands = {"allOf": [closed, {"properties": {"bands": {"type": "array", "items": closed}}}]}
    return {
        "$schema": "http://json-schema.org/draft-07/schema#",
        "$id": address,
        "type": "object",
        "required": ["stac_extensions", "assets"],
        "properties": {
            "stac_extensions": {"type": "array", "contains": {"const": address}},
            "properties": with_bands,
            "assets": {"type": "object", "additionalProperties": with_bands},
        },
    }


SCHEMAS = {
    found["$id"]: found
    for found in (
        schema(
            "projection",
            "v2.0.0",
            {
                "proj:code": {"type": ["string", "null"], "pattern": "^[A-Z]+:[0-9]+$"},
                "proj:wkt2": {"type": ["string", "null"]},
                "proj:bbox": numbers(4, 6),
                "proj:shape": {"type": "array", "minItems": 2, "maxItems": 2, "items": {"type": "integer"}},
                "proj:transform": numbers(6, 9),
            },
        ),
        schema("raster", "v2.0.0", {"raster:spatial_resolution": {"type": "number", "exclusiveMinimum": 0}}),
        schema(
            "eo",
            "v2.0.0",
            {
                "eo:common_name": {"type": "string", "enum": COLOURS},
                "eo:center_wavelength": {"type": "number", "exclusiveMinimum": 0},
            },
        ),
    )
}
