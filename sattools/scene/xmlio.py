"""Reading of XML that anybody may have written: without entities, and with one line for what cannot be read."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from sattools.errors import InputError
from sattools.scene.jsonio import read_bytes

_WIDE = (b"\xff\xfe", b"\xfe\xff")  # byte order marks of UTF-16


def parse_xml(path: Path, expected: str = "DIMAP or DigitalGlobe metadata") -> Any:
    """Root element of an XML file without entity expansion.

    Args:
        path: the file.
        expected: what it should be, for messages.

    Raises:
        InputError: it is malformed.
    """
    import defusedxml.ElementTree as ElementTree
    from defusedxml import DefusedXmlException

    data = read_bytes(path)
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


__all__ = ["find_all", "local_name", "parse_xml"]
