"""How `fuzz.py` damages files, and cameras in vendors' formats for it to damage."""

from __future__ import annotations

import json
import os
import random
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

ODD_VALUES: list[Any] = [
    None, True, 0, -1, 1.5, 1e308, -1e308, float("nan"), float("inf"), "", "x", "nan", [], {}, [1], [None] * 3,
    {"a": 1}, 10**400, "../..", "/dev/zero", "/vsicurl/http://127.0.0.1:9/x.tif", "\x1b[31m", [[[]]],
    "2014-13-45T99:99:99Z",
]  # fmt: skip


def damage(path: Path, rng: random.Random) -> str:
    """Replace a file by a damaged one; what was done."""
    data = path.read_bytes()
    kinds: list[Callable[[bytes, random.Random], tuple[str, bytes]]] = [flip, cut, repeat, overwrite, insert]
    if path.suffix in (".json", ".geojson"):
        kinds = [structure, structure, structure, numbers, *kinds]
    elif path.suffix.lower() in (".txt", ".csv", ".toml", ".xml", ".rpb"):
        kinds = [numbers, numbers, lines, *kinds]
    if rng.random() < 0.05:
        what, new = other(data, rng)
    else:
        what, new = rng.choice(kinds)(data, rng)
        if rng.random() < 0.3:
            more, new = rng.choice(kinds)(new, rng)
            what += f", {more}"
    path.unlink()
    path.write_bytes(new)
    return what


def flip(data: bytes, rng: random.Random) -> tuple[str, bytes]:
    new, count = bytearray(data), rng.choice((1, 1, 2, 8, 64))
    # headers are where formats are decided
    for _ in range(count if data else 0):
        end = len(data) if rng.random() < 0.5 else min(len(data), 600)
        new[rng.randrange(end)] ^= 1 << rng.randrange(8)
    return f"{count} bits flipped", bytes(new)


def cut(data: bytes, rng: random.Random) -> tuple[str, bytes]:
    end = rng.choice((0, 1, 4, rng.randrange(len(data) + 1), max(0, len(data) - 1)))
    return f"cut to {end} bytes", data[:end]


def repeat(data: bytes, rng: random.Random) -> tuple[str, bytes]:
    start = rng.randrange(len(data) + 1)
    piece = data[start : start + rng.choice((1, 16, 300))]
    return f"{len(piece)} bytes repeated at {start}", data[:start] + piece * rng.choice((2, 50)) + data[start:]


def overwrite(data: bytes, rng: random.Random) -> tuple[str, bytes]:
    start = rng.randrange(max(1, min(len(data), rng.choice((64, 1000, 10**9)))))
    fill = rng.choice((b"\0", b"\xff", b"9", b"\x7f"))
    length = rng.choice((1, 2, 4, 8, 200))
    return f"{length} bytes {fill!r} at {start}", data[:start] + fill * length + data[start + length :]


def insert(data: bytes, rng: random.Random) -> tuple[str, bytes]:
    start = rng.choice((0, rng.randrange(len(data) + 1)))
    piece = rng.choice((b"\0", b"\xef\xbb\xbf", b"\xff\xfe", os.urandom(0), b"\r\n", b"{" * 2000, b"[" * 100_000,
                        b"<!DOCTYPE a [<!ENTITY b SYSTEM 'file:///etc/passwd'>]>", b"9" * 5000))  # fmt: skip
    return f"{piece[:20]!r} inserted at {start}", data[:start] + piece + data[start:]


def other(data: bytes, rng: random.Random) -> tuple[str, bytes]:
    vrt = (b"<VRTDataset rasterXSize='32' rasterYSize='32'><VRTRasterBand dataType='Byte' band='1'><SimpleSource>"
           b"<SourceFilename>/etc/passwd</SourceFilename></SimpleSource></VRTRasterBand></VRTDataset>")  # fmt: skip
    name, new = rng.choice((
        ("empty", b""), ("random", rng.randbytes(2000)), ("VRT", vrt), ("zip", b"PK\x03\x04" + bytes(300)),
        ("JSON", b'{"type": "FeatureCollection", "features": []}'), ("null", b"null"), ("number", b"1e999"),
        ("WMS", b"<GDAL_WMS><Service name='TMS'><ServerUrl>http://127.0.0.1:9/</ServerUrl></Service></GDAL_WMS>"),
        ("UTF-16", data[:2000].decode("latin-1").encode("utf-16")), ("long line", b"a" * 3_000_000),
    ))  # fmt: skip
    return f"replaced by {name}", new


def numbers(data: bytes, rng: random.Random) -> tuple[str, bytes]:
    """One number of a text becomes another."""
    found = list(re.finditer(rb"-?\d+\.?\d*(?:[eE][-+]?\d+)?", data))
    if not found:
        return flip(data, rng)
    spot = rng.choice(found)
    odd = (b"nan", b"inf", b"-1", b"0", b"1e308", b"-1e308", b"1e-320", b"9" * 400, b"x", b"", b"65536", b"4294967296")
    new = rng.choice((*odd, b"null", b'"1"', b"-" + spot[0], spot[0] + b"0", b"1" + spot[0]))
    return f"{spot[0][:20]!r} at {spot.start()} becomes {new[:20]!r}", data[: spot.start()] + new + data[spot.end() :]


def lines(data: bytes, rng: random.Random) -> tuple[str, bytes]:
    rows = data.split(b"\n")
    a, b = rng.randrange(len(rows)), rng.randrange(len(rows))
    what = rng.choice(("removed", "exchanged", "doubled"))
    if what == "removed":
        del rows[a]
    elif what == "doubled":
        rows.insert(a, rows[a])
    else:
        rows[a], rows[b] = rows[b], rows[a]
    return f"lines {a}, {b} {what}", b"\n".join(rows)


def structure(data: bytes, rng: random.Random) -> tuple[str, bytes]:
    """One member of a JSON document is replaced, removed, renamed, doubled or nested."""
    try:
        document = json.loads(data)
    except (ValueError, RecursionError):
        return flip(data, rng)
    places: list[tuple[Any, Any]] = []

    def walk(value: Any) -> None:
        items = value.items() if isinstance(value, dict) else enumerate(value) if isinstance(value, list) else ()
        for key, inner in items:
            places.append((value, key))
            walk(inner)

    walk(document)
    if not places:
        return flip(data, rng)
    # members near the root are few and matter most
    holder, key = rng.choice(places if rng.random() < 0.7 else places[:30])
    what = rng.choice(("replaced", "replaced", "replaced", "removed", "renamed", "nested", "doubled", "copied"))
    if what == "replaced":
        holder[key] = rng.choice(ODD_VALUES)
    elif what == "removed":
        del holder[key]
    elif what == "renamed" and isinstance(holder, dict):
        holder[f"{key}x"] = holder.pop(key)
    elif what == "nested":
        depth = rng.choice((1, 50, 900))
        for _ in range(depth):
            holder[key] = [holder[key]]
    elif what == "doubled" and isinstance(holder, list):
        holder.insert(key, json.loads(json.dumps(holder[key])))
    else:
        source, name = rng.choice(places)
        holder[key] = json.loads(json.dumps(source.get(name) if isinstance(source, dict) else source[name - 1]))
    try:
        return f"{key!r} {what}", json.dumps(document).encode()
    except (ValueError, RecursionError):
        return flip(data, rng)


def rpb(rpc: Any) -> str:
    """The camera as DigitalGlobe's .RPB."""
    tags = rpc.to_tags()
    names = {
        "lineOffset": "LINE_OFF", "sampOffset": "SAMP_OFF", "latOffset": "LAT_OFF", "longOffset": "LONG_OFF",
        "heightOffset": "HEIGHT_OFF", "lineScale": "LINE_SCALE", "sampScale": "SAMP_SCALE", "latScale": "LAT_SCALE",
        "longScale": "LONG_SCALE", "heightScale": "HEIGHT_SCALE",
    }  # fmt: skip
    vectors = {"lineNumCoef": "LINE_NUM_COEFF", "lineDenCoef": "LINE_DEN_COEFF", "sampNumCoef": "SAMP_NUM_COEFF",
               "sampDenCoef": "SAMP_DEN_COEFF"}  # fmt: skip
    rows = ['satId = "QB02";', 'bandId = "P";', 'SpecId = "RPC00B";', "BEGIN_GROUP = IMAGE"]
    rows += ["\terrBias = 0.0;", "\terrRand = 0.0;", *(f"\t{name} = {tags[tag]};" for name, tag in names.items())]
    rows += [f"\t{n} = (\n\t\t\t" + ",\n\t\t\t".join(tags[tag].split()) + ");" for n, tag in vectors.items()]
    return "\n".join([*rows, "END_GROUP = IMAGE", "END;\n"])


def xml(rpc: Any) -> str:
    """The camera as DigitalGlobe's XML."""
    tags = rpc.to_tags()
    names = {
        "LINEOFFSET": "LINE_OFF", "SAMPOFFSET": "SAMP_OFF", "LATOFFSET": "LAT_OFF", "LONGOFFSET": "LONG_OFF",
        "HEIGHTOFFSET": "HEIGHT_OFF", "LINESCALE": "LINE_SCALE", "SAMPSCALE": "SAMP_SCALE", "LATSCALE": "LAT_SCALE",
        "LONGSCALE": "LONG_SCALE", "HEIGHTSCALE": "HEIGHT_SCALE",
    }  # fmt: skip
    vectors = {"LINENUMCOEF": "LINE_NUM_COEFF", "LINEDENCOEF": "LINE_DEN_COEFF", "SAMPNUMCOEF": "SAMP_NUM_COEFF",
               "SAMPDENCOEF": "SAMP_DEN_COEFF"}  # fmt: skip
    inner = "".join(f"<{name}>{tags[tag]}</{name}>\n" for name, tag in names.items())
    inner += "".join(f"<{n}List><{n}>{tags[tag]}</{n}></{n}List>\n" for n, tag in vectors.items())
    return f'<?xml version="1.0"?>\n<isd><RPB><SATID>WV03</SATID><IMAGE>\n{inner}</IMAGE></RPB></isd>\n'
