"""What the members of a scene document may be; see docs/scene.md."""

from __future__ import annotations

from collections.abc import Mapping
from datetime import UTC, datetime
from typing import Any

from sattools.errors import InputError
from sattools.scene.schema import Anything, Items, Maybe, Number, Table, Text, meant, shown

ROLES = ("train", "test", "unused")
HEIGHT_LIMITS_M = (-12_000.0, 12_000.0)  # of any ground or water surface on Earth, with room
MAX_CELLS = 4_000_000_000
LEAST_CELLS = 8  # of a grid along each side
FINEST = 1 / 32  # cell over pixel

_ANGLE = Number(-360, 360, unit="degrees")
_HREF = Text()
_VECTOR = Items(Number(-1.001, 1.001), 3, 3)
_DIMENSIONS = {"Point": 0, "MultiPoint": 1, "LineString": 1, "MultiLineString": 2, "Polygon": 2, "MultiPolygon": 3}


def instant(text: str) -> datetime:
    """What time a text means, UTC where it names no clock; texts of other clocks, or with fractions, sort otherwise.

    Args:
        text: as `Time` has checked it.
    """
    time = datetime.fromisoformat(text)
    return time if time.tzinfo else time.replace(tzinfo=UTC)


class Time:
    """A time as ISO 8601 writes it."""

    def check(self, value: Any, where: str) -> None:
        """See `schema.Kind`."""
        try:
            datetime.fromisoformat(value)
        except (TypeError, ValueError):
            raise InputError(f"{where}: found {shown(value)}, expected a time such as 2015-03-01T16:00:00Z") from None


class Geometry:
    """A GeoJSON geometry with positions in degrees."""

    def check(self, value: Any, where: str) -> None:
        """See `schema.Kind`."""
        Table({"type": Text(tuple(_DIMENSIONS))}, ("type", "coordinates")).check(value, where)
        self._positions(value["coordinates"], _DIMENSIONS[value["type"]], f"{where}.coordinates")

    def _positions(self, value: Any, depth: int, where: str) -> None:
        if depth == 0:
            Items(Number(-1e5, 1e5), 2, 4).check(value, where)
            return
        Items(Anything(), 1).check(value, where)
        for k, part in enumerate(value):
            self._positions(part, depth - 1, f"{where}[{k}]")


# those that some command reads; a vendor's or another program's own members are passed on as they are
PROPERTIES: Mapping[str, Any] = {
    "datetime": Maybe(Time()),
    "platform": Maybe(Text(empty=True)),
    "gsd": Maybe(Number(1e-3, 1e4, unit="m")),
    "proj:code": Maybe(Text()),
    "proj:shape": Maybe(Items(Number(1, 10**7, whole=True), 2, 2)),
    "view:sun_azimuth": Maybe(_ANGLE),
    "view:sun_elevation": Maybe(Number(-90, 90, unit="degrees")),
    "view:azimuth": Maybe(_ANGLE),
    "view:off_nadir": Maybe(Number(0, 90, unit="degrees")),
    "view:incidence_angle": Maybe(Number(0, 90, unit="degrees")),
    "sattools:role": Text(ROLES),
    "sattools:bits": Maybe(Number(1, 64, whole=True)),
    "sattools:dtype": Maybe(Text()),
    "sattools:bands": Maybe(Number(1, 10_000, whole=True)),
    "sattools:value_range": Maybe(Items(Maybe(Number()), 2, 2)),
    "sattools:source": Maybe(Text()),
    "sattools:radiance": Maybe(Text(("toa_reflectance", "reflectance_factor", "relative"))),
    "sattools:tone": Maybe(Text(("linear", "tone-mapped"))),
    "sattools:atmosphere": Maybe(
        Table({"path": Items(Number(), 1), "transmittance": Items(Number(0, 1), 1)}, ("path", "transmittance"), None)
    ),
    "sattools:sun": Maybe(Text()),
    "sattools:sun_direction": Maybe(_VECTOR),
    "sattools:view_direction": Maybe(_VECTOR),
    "sattools:radiometric_balance": Maybe(
        Table(
            {
                "gain": Items(Number(), 1),
                "offset": Items(Number(), 1),
                "contrast": Number(1e-9, 1e9),
                "tone": Number(0, 1),
            },
            ("gain", "offset", "contrast"),
            None,
        )
    ),
}

_BAND = Table({"name": Text(), "common_name": Text(), "center_wavelength": Number(0, 1e3, unit="um")})

ITEM = Table(
    {
        "geometry": Maybe(Geometry()),
        "bbox": Maybe(Items(_ANGLE, 4, 4)),
        "properties": Table(PROPERTIES),
        "assets": Table(
            other=Table(
                {
                    "href": _HREF,
                    "type": Text(),
                    "roles": Items(Text()),
                    "eo:bands": Items(_BAND),
                    "sattools:window": Items(Number(0, 10**7, whole=True), 4, 4),
                    "sattools:blocks": Items(Number(0, 10**7, whole=True), 3, 3),
                    "sattools:saturated": Table(
                        {
                            "bands": Items(Number(1, 10_000, whole=True), 1),
                            "gain": Items(Number(), 1),
                            "offset": Items(Number(), 1),
                        },
                        ("bands", "gain", "offset"),
                        None,
                    ),
                },
                ("href",),
            ),
        ),
    },
    ("id", "properties", "assets"),
)

GRID = Table(
    {
        "crs": Text(longest=20_000),
        "left": Number(-1e9, 1e9, unit="m"),
        "top": Number(-1e9, 1e9, unit="m"),
        "cell_size": Number(1e-3, 1e5, unit="m"),
        "width": Number(1, 10**7, whole=True),
        "height": Number(1, 10**7, whole=True),
    },
    ("crs", "left", "top", "cell_size", "width", "height"),
    None,
)

_RECORD = Table(
    {"inputs": Text(), "items": Items(Text()), "outputs": Table(other=Maybe(Text()))}, ("inputs", "items", "outputs")
)

_ENTRY = Table(
    {
        "command": Text(),
        "options": Table(),
        "seconds": Number(0),
        "earlier_seconds": Number(0),
        "prior_seconds": Number(0),
        "albedo_seconds": Number(0),
        "peak_memory_mb": Number(0),
        "versions": Table(other=Text()),
        "notes": Items(Text(empty=True, longest=100_000)),
        "parts": Table(
            {
                "seconds": Number(0),
                "prior_seconds": Number(0),
                "albedo_seconds": Number(0),
                "peak_memory_mb": Number(0),
            },
            ("seconds", "peak_memory_mb"),
        ),
        "errors": Table({"classes": Table(other=Table())}),
        "made": Maybe(Table(other=_RECORD)),
    },
    ("command",),
)

OURS = Table(
    {
        "version": Anything(),
        "root": Text(),
        "grid": Maybe(GRID),
        "height_range_m": Maybe(Items(Number(*HEIGHT_LIMITS_M, unit="m"), 2, 2)),
        "surroundings_m": Maybe(Number(0, 1e4, unit="m")),
        "products": Maybe(Table(other=_HREF)),
        "history": Maybe(Items(_ENTRY)),
    },
    ("version",),
    None,
)


def check_members(document: Mapping[str, Any]) -> None:
    """Raise InputError, naming the place, where a member of a scene document cannot be what it is.

    The document is a FeatureCollection with a `sattools` member of the right version already.
    """
    ours = document["sattools"]
    OURS.check(ours, "sattools")
    heights = ours.get("height_range_m")
    if heights and not heights[0] < heights[1]:
        raise InputError(
            f"sattools.height_range_m: found {shown(heights)}, expected the lowest height and a greater highest one"
        )
    grid = ours.get("grid")
    if grid and grid["width"] * grid["height"] > MAX_CELLS:
        raise InputError(
            f"sattools.grid: found {grid['width']} x {grid['height']} cells, expected at most {MAX_CELLS:.0e}"
        )
    _check_items(document["features"])


def _check_items(features: list[Any]) -> None:
    """Every item by itself, and that no two share an image or a camera."""
    owners: dict[tuple[str, str], str] = {}
    for k, feature in enumerate(features):
        name = feature.get("id") if isinstance(feature, Mapping) else None
        where = f"item {name}" if isinstance(name, str) and 0 < len(name) <= 128 else f"features[{k}]"
        ITEM.check(feature, where)
        _check_names(feature["properties"], where)
        for asset in ("image", "rpc", "radiance"):
            href = (feature["assets"].get(asset) or {}).get("href")
            owner = owners.setdefault((asset, href), where) if href else where
            if owner != where:
                raise InputError(f"{where}: found the {asset} of {owner} ({href}), expected its own")


def _check_names(properties: Mapping[str, Any], where: str) -> None:
    """A misspelt property would be passed on and its default used in silence."""
    for name in properties:
        if name in PROPERTIES or not name.startswith(("sattools:", "view:")):
            continue
        # only where the right one is missing: a program's own `view:azimuths` beside `view:azimuth` is none of ours
        hint = meant(name, [known for known in PROPERTIES if known not in properties and _differ_little(name, known)])
        if hint:
            raise InputError(f"{where}: found an unknown property {name!r}, expected a known one{hint}")


def _differ_little(a: str, b: str) -> bool:
    """The same letters but for one or two: a slip of the finger, not another word."""
    return abs(len(a) - len(b)) <= 2 and len(set(a) ^ set(b)) <= 2 and a[:6] == b[:6] and a[-1:] == b[-1:]


__all__ = [
    "FINEST",
    "GRID",
    "HEIGHT_LIMITS_M",
    "ITEM",
    "LEAST_CELLS",
    "MAX_CELLS",
    "OURS",
    "PROPERTIES",
    "ROLES",
    "check_members",
    "instant",
]
