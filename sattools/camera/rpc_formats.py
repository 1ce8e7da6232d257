"""Readers of vendors' RPC files; all return GDAL's names, with (0, 0) the centre of the first pixel."""

from __future__ import annotations

import contextlib
import re
from pathlib import Path
from typing import Any

from sattools.camera.rpc_names import SCALARS, VECTORS
from sattools.errors import InputError
from sattools.scene import jsonio
from sattools.scene.jsonio import read_json
from sattools.scene.location import RemotePath, found_instead, location
from sattools.scene.xmlio import find_all, local_name, parse_xml

Fields = dict[str, Any]

_UNITS = {"", "pixel", "pixels", "degree", "degrees", "deg", "meter", "meters", "metre", "metres", "m"}
_SATNERF = SCALARS | VECTORS  # its members are named as ours
_RPB = {
    "LINE_OFF": "LINEOFFSET",
    "SAMP_OFF": "SAMPOFFSET",
    "LAT_OFF": "LATOFFSET",
    "LONG_OFF": "LONGOFFSET",
    "HEIGHT_OFF": "HEIGHTOFFSET",
    "LINE_SCALE": "LINESCALE",
    "SAMP_SCALE": "SAMPSCALE",
    "LAT_SCALE": "LATSCALE",
    "LONG_SCALE": "LONGSCALE",
    "HEIGHT_SCALE": "HEIGHTSCALE",
    "LINE_NUM_COEFF": "LINENUMCOEF",
    "LINE_DEN_COEFF": "LINEDENCOEF",
    "SAMP_NUM_COEFF": "SAMPNUMCOEF",
    "SAMP_DEN_COEFF": "SAMPDENCOEF",
}


def read_rpc_fields(path: Path) -> Fields:
    """RPC members of any supported file, under GDAL's names. Raises InputError in one line."""
    path = location(path)
    if isinstance(path, RemotePath):
        return _from_raster(path)
    try:
        with open(path, "rb") as file:
            head = jsonio.as_utf8(file.read(512))
    except (OSError, ValueError) as error:
        raise InputError(f"{path}: found {found_instead(path, error)}, expected a readable file") from None
    start = head.removeprefix(b"\xef\xbb\xbf").lstrip()
    if start.startswith(b"<"):
        return _from_xml(path)
    if start.startswith(b"{"):
        return _from_json(path)
    if b"\0" not in head and not head.startswith((b"NITF", b"NSIF")):
        text = read_text(path)
        if re.search(r"(?im)^\s*lineOffset\s*=", text):
            return _from_rpb(text)
        if re.search(r"(?im)^\s*LINE_OFF\s*[:=]", text):
            return _from_rpc_txt(path, text)
        raise InputError(f"{path}: found text without RPC members, expected `LINE_OFF: ...` or `lineOffset = ...`")
    return _from_raster(path)


def read_text(path: Path) -> str:
    """Text of a metadata file: UTF-8 or UTF-16 with or without byte order mark, else Latin-1; any line ends."""
    return jsonio.read_text(path, strict=False)


def _from_xml(path: Path) -> Fields:
    root = parse_xml(path)
    if local_name(root) == "Dimap_Document":
        return _from_dimap(path, root)
    blocks = find_all(root, "RPB")
    if blocks:
        return _from_isd(blocks[0])
    raise InputError(
        f"{path}: found XML with root <{local_name(root)}> and no RPC that is understood, "
        "expected <Dimap_Document> or DigitalGlobe XML with <RPB>"
    )


def _from_dimap(path: Path, root: Any) -> Fields:
    """DIMAP: version 2 counts pixels from 1; version 3 (Pléiades Neo) renames members and states its first pixel."""
    inverse = find_all(root, "Inverse_Model") or find_all(root, "GroundtoImage_Values")
    validity = find_all(root, "RFM_Validity")
    if not inverse or not validity:
        raise InputError(
            f"{path}: found DIMAP without an RPC, expected <Inverse_Model> and <RFM_Validity> (the RPC_*.XML file)"
        )
    fields: Fields = {local_name(e): (e.text or "").strip() for e in [*inverse[0], *validity[0]] if len(e) == 0}
    first = {"FIRST_ROW": 1.0, "FIRST_COL": 1.0}
    for domain in find_all(root, "ImagetoGround_Validity_Domain"):
        first |= {name: _origin(path, name, e.text) for e in domain if (name := local_name(e)) in first and e.text}
    for key, origin in (("LINE_OFF", "FIRST_ROW"), ("SAMP_OFF", "FIRST_COL")):
        with contextlib.suppress(KeyError, ValueError):  # RPC.from_tags says what is missing
            fields[key] = float(fields[key]) - first[origin]
    return fields


def _origin(path: Path, name: str, text: str) -> float:
    try:
        return float(text)
    except ValueError:
        raise InputError(f"{path}: found {name} = {text.strip()[:40]!r}, expected a number") from None


def _from_isd(block: Any) -> Fields:
    texts = {local_name(e).upper(): (e.text or "").strip() for e in block.iter()}
    return {key: texts[name] for key, name in _RPB.items() if name in texts}


def _from_rpb(text: str) -> Fields:
    """`.RPB` (and `.IMD`-like) text: `name = value;`, lists in parentheses over several lines."""
    values = {m[1].upper(): m[2] for m in re.finditer(r"(\w+)\s*=\s*(\([^)]*\)|[^;\n]*)", text)}
    fields: Fields = {}
    for key, name in _RPB.items():
        if name in values:
            raw = values[name].strip()
            fields[key] = raw.strip("()").replace(",", " ") if raw.startswith("(") else raw.strip('"')
    return fields


def _from_rpc_txt(path: Path, text: str) -> Fields:
    fields: Fields = {}
    for line in text.split("\n"):
        match = re.match(r"\s*(\w+)\s*[:=]\s*(.*?)\s*;?\s*$", line)
        if match is None:
            continue
        key = match[1].upper()
        if key in VECTORS:  # one line of 20 numbers
            fields[key] = match[2]
            continue
        value, _, unit = match[2].partition(" ")
        if key in SCALARS and unit.strip().lower() not in _UNITS:
            raise InputError(f"{path}: found {key} in {unit.strip()!r}, expected pixels, degrees or meters")
        fields[key] = value
    return fields


def _from_json(path: Path) -> Fields:
    document = read_json(path)
    rpc = document.get("rpc", document)
    if not isinstance(rpc, dict) or not any(name in rpc for name in _SATNERF.values()):
        raise InputError(f"{path}: found JSON without RPC members, expected `rpc` with row_offset, col_num, ...")
    fields: Fields = {}
    for key, name in _SATNERF.items():
        if name in rpc:
            fields[key] = rpc[name]
        if key in VECTORS and not isinstance(fields.get(key, []), list):
            raise InputError(f"{path}: found {name} that is no list, expected 20 numbers")
    return fields


def _from_raster(path: Path) -> Fields:
    from sattools.scene.gdal import rpc_tags
    from sattools.scene.opening import opened

    with opened(path, "an image or metadata") as dataset:
        fields: Fields = dict(rpc_tags(dataset))
    if not fields:
        raise InputError(f"{path}: found an image without RPC, expected RPC tags or a metadata file beside it")
    return fields
