"""Reading of text, JSON and TOML that anybody may have written: the one place where the suite does so.

What is read has a largest size, depth and length of numbers, so that no file can exhaust memory or stack, neither here
nor in the code that walks through the result.
"""

from __future__ import annotations

import json
import tomllib
from collections.abc import Callable
from pathlib import Path
from typing import Any

from sattools.errors import InputError
from sattools.scene.location import found_instead

TEXT_LIMIT = 64 << 20  # bytes; no document or metadata file of the suite is larger
CONFIG_LIMIT = 1 << 20
_DEPTH = 64  # of nesting; STAC, GeoJSON and vendors' metadata need 10
_KEY_PARTS = 10_000  # of a dotted key of TOML
_MARKS = ((b"\xff\xfe\0\0", "utf-32"), (b"\0\0\xfe\xff", "utf-32"), (b"\xff\xfe", "utf-16"), (b"\xfe\xff", "utf-16"))
_BITS = 64  # of an integer; larger ones overflow where they become floating point numbers


def read_bytes(path: Path | str, limit: int = TEXT_LIMIT) -> bytes:
    """Bytes of a file of at most `limit`. Devices that never end are read up to that only.

    Raises: InputError (cannot be read, or larger).
    """
    try:
        with open(path, "rb") as file:
            data = file.read(limit + 1)
    except (OSError, ValueError) as error:  # ValueError: a NUL in the name
        raise InputError(f"{path}: found {found_instead(path, error)}, expected a readable file") from None
    if len(data) > limit:
        raise InputError(f"{path}: found more than {limit >> 20} MiB, expected a text file of less")
    return data


def _marked(data: bytes) -> str | None:
    """Encoding of text with a byte order mark of UTF-16 or UTF-32."""
    return next((name for mark, name in _MARKS if data.startswith(mark)), None)


def as_utf8(data: bytes) -> bytes:
    """Bytes as they are, but text with a byte order mark of UTF-16 or UTF-32 in UTF-8, without what is no character."""
    encoding = _marked(data)
    return data if encoding is None else data.decode(encoding, "ignore").encode()


def decode(data: bytes, source: str, *, strict: bool = True) -> str:
    """Text of UTF-8, with or without byte order mark, or of UTF-16 or UTF-32 with one; else InputError.

    With `strict` off, bytes of another encoding are taken for Latin-1, as vendors' metadata may have them.

    Args:
        data: of the file.
        source: name for error messages.
        strict: refuse control characters.
    """
    encoding = _marked(data) or "utf-8-sig"
    try:
        text = data.decode(encoding)
    except UnicodeDecodeError as error:
        if strict or encoding != "utf-8-sig":
            name = encoding.removesuffix("-sig").upper()
            raise InputError(f"{source}: found text that is not {name} (byte {error.start}), expected UTF-8") from None
        text = data.decode("latin-1")
    return text


def read_text(path: Path | str, limit: int = TEXT_LIMIT, *, strict: bool = True) -> str:
    """Text of a file with plain line ends; see `read_bytes` and `decode` for what is refused.

    Args:
        path: of the file.
        limit: bytes, at most.
        strict: refuse control characters.
    """
    text = decode(read_bytes(path, limit), str(path), strict=strict)
    return text.replace("\r\n", "\n").replace("\r", "\n")


def parse_json(text: str, source: str, expected: str = "JSON") -> Any:
    """The value that a JSON text stands for.

    Args:
        text: of the document.
        source: name for error messages.
        expected: what it should be, for error messages.

    Raises: InputError, naming `source`: no JSON, too deeply nested, or with numbers or text that cannot be kept.
    """

    def parse() -> Any:
        return json.loads(text.removeprefix("\ufeff"))

    return _checked(parse, source, "JSON", expected)


JsonObject = dict[str, Any]  # of JSON, TOML or an options dataclass: members by name, for a schema to check


def read_json(path: Path | str, expected: str = "a JSON object") -> JsonObject:
    """A JSON object from a file. Raises InputError when it is not one; see `parse_json`."""
    document = parse_json(read_text(path, strict=False), str(path), expected)
    if not isinstance(document, dict):
        raise InputError(f"{path}: found a JSON {type(document).__name__}, expected {expected}")
    return document


def read_toml(path: Path | str) -> JsonObject:
    """A TOML file's tables. Raises InputError as `read_json` does."""
    text = read_text(path, CONFIG_LIMIT)
    if max((line.partition("=")[0].count(".") for line in text.splitlines()), default=0) > _KEY_PARTS:
        # Python's parser takes a time by the square of it: 20 s for one of 100,000
        raise InputError(f"{path}: found a key of thousands of parts, expected one of ordinary length")
    return dict(_checked(lambda: tomllib.loads(text), str(path), "TOML", "TOML"))


def _checked(parse: Callable[[], Any], source: str, kind: str, expected: str) -> Any:
    try:
        value = parse()
    except RecursionError:
        raise InputError(f"{source}: found {kind} nested too deeply, expected at most {_DEPTH} levels") from None
    except json.JSONDecodeError as error:
        where = f"line {error.lineno}, column {error.colno}"
        raise InputError(
            f"{source}: found text that is not JSON ({error.msg} at {where}), expected {expected}"
        ) from None
    except tomllib.TOMLDecodeError as error:
        raise InputError(f"{source}: found no valid TOML ({error}), expected TOML") from None
    except ValueError:  # Python refuses integers of more than some thousand digits
        raise InputError(f"{source}: found a number of thousands of digits, expected one of ordinary size") from None
    _check_values(value, source, kind)
    return value


def _check_values(value: Any, source: str, kind: str) -> None:
    """Walk through everything, without recursion, and refuse what would break the code behind."""
    level = [value]
    for _ in range(_DEPTH + 1):
        deeper: list[Any] = []
        for node in level:
            if isinstance(node, dict):
                deeper += node.keys()
                deeper += node.values()
            elif isinstance(node, list):
                deeper += node
            elif isinstance(node, str):
                if not node.isascii() and any("\ud800" <= c <= "\udfff" for c in node):
                    raise InputError(f"{source}: found half a character (a lone surrogate), expected Unicode text")
            elif isinstance(node, int) and node.bit_length() > _BITS:
                raise InputError(f"{source}: found a number of {node.bit_length()} bits, expected at most {_BITS}")
        if not deeper:
            return
        level = deeper
    raise InputError(f"{source}: found {kind} nested too deeply, expected at most {_DEPTH} levels")


__all__ = [
    "CONFIG_LIMIT",
    "TEXT_LIMIT",
    "JsonObject",
    "as_utf8",
    "decode",
    "parse_json",
    "read_bytes",
    "read_json",
    "read_text",
    "read_toml",
]
