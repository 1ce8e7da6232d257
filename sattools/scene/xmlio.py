"""Reading of XML that anybody may have written: without entities, and with one line for what cannot be read."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from sattools.errors import InputError
from sattools.scene.jsonio import read_bytes

_WIDE = (b"\xff\xfe", b"\xfe\xff")  # byte order marks of UTF-16


def parse_xml(path: Path) -> Any:
    """`xml_root` of a file of metadata."""
    return xml_root(read_bytes(path), path, "DIMAP or DigitalGlobe metadata")


def xml_root(data: bytes, path: Path, expected: str) -> Any:
    """Root element of XML without entity expansion.

    Args:
        data: the text as it is stored.
        path: where, for messages.
        expected: what it should be, likewise.

    Raises:
        InputError: it is malformed.
    """
    import defusedxml.ElementTree as ElementTree
    from defusedxml import DefusedXmlException

    try:
        # Bytes, so that the declared encoding is obeyed; the reader knows a byte order mark.
        return ElementTree.fromstring(data if data.startswith(_WIDE) else data.strip())
    except (ElementTree.ParseError, DefusedXmlException, ValueError, LookupError) as error:
        raise InputError(f"{path}: found unreadable XML ({error}), expected {expected}") from None
    except RecursionError:
        raise InputError(f"{path}: found XML nested too deeply, expected {expected}") from None


def local_name(element: Any) -> str:
    """Tag of an XML element without its namespace."""
    return str(element.tag).rsplit("}", 1)[-1]


def find_all(element: Any, name: str) -> list[Any]:
    """All descendants of that name, whatever their namespace."""
    return [e for e in element.iter() if local_name(e) == name]


__all__ = ["find_all", "local_name", "parse_xml", "xml_root"]
