"""An HTML page that needs nothing beside itself: no script, no network, pictures inside."""

from __future__ import annotations

import base64
import io
from collections.abc import Sequence
from dataclasses import dataclass, field
from html import escape
from pathlib import Path
from typing import Any
from urllib.parse import quote

# the browser itself refuses whatever is not in the page
_POLICY = "default-src 'none'; img-src data:; style-src 'unsafe-inline'"
_BEGINNING = f"""<!DOCTYPE html>
<html lang="en">
<head>
<meta charset="utf-8">
<meta http-equiv="Content-Security-Policy" content="{_POLICY}">
"""
_STYLE = """
:root { color-scheme: light dark; }
body { font: 16px/1.5 system-ui, sans-serif; max-width: 100rem; margin: 1.5rem auto; padding: 0 1rem; }
nav { display: flex; flex-wrap: wrap; gap: 0.3rem 1.2rem; position: sticky; top: 0; padding: 0.5rem 0;
  background: Canvas; border-bottom: 1px solid #8886; z-index: 1; }
section { margin-top: 2rem; scroll-margin-top: 4rem; }
.parts { display: grid; grid-template-columns: minmax(0, 1fr); gap: 1rem 2rem; align-items: start; }
.whole { grid-column: 1 / -1; margin: 0; min-width: 0; }
@media (min-width: 70rem) { .parts { grid-template-columns: minmax(0, 1fr) minmax(0, 1fr); } }
figure { margin: 0; min-width: 0; }
img { max-width: 100%; height: auto; background: white; }
figcaption, .note { font-size: 0.9rem; opacity: 0.85; overflow-wrap: anywhere; }
.wide { overflow-x: auto; }
table { border-collapse: collapse; font-variant-numeric: tabular-nums; }
th, td { padding: 0.2rem 0.7rem; border-bottom: 1px solid #8886; text-align: right; }
th:first-child, td:first-child { text-align: left; }
pre { overflow-x: auto; padding: 0.7rem; border: 1px solid #8886; }
@media (max-width: 40rem) {
  nav { position: static; }
  th, td { padding: 0.2rem 0.4rem; font-size: 0.85rem; }
}
@media print {
  @page { size: A4; margin: 14mm; }
  :root { color-scheme: light; }
  body { font-size: 9pt; max-width: none; margin: 0; padding: 0; }
  nav { display: none; }
  section { margin-top: 1rem; }
  .parts { grid-template-columns: minmax(0, 1fr) minmax(0, 1fr); gap: 0.5rem 1rem; }
  h1, h2 { break-after: avoid; margin: 0.4rem 0; }
  figure, tr, pre { break-inside: avoid; }
  img { max-height: 11cm; }
  thead { display: table-header-group; }
  .wide, pre { overflow: visible; }
  pre { white-space: pre-wrap; overflow-wrap: anywhere; }
  th, td { padding: 0.05rem 0.35rem; font-size: 7.5pt; }
}
"""


LARGEST = 3_000_000  # bytes of a page
RESOLUTIONS = (100, 75, 55, 40)  # of its pictures [dots per inch], the first with which it is small enough
_NARROW = 6  # columns of a table that fits beside something


@dataclass(frozen=True)
class Picture:
    """A matplotlib figure with what is said about it: `alt` for who cannot see it, `caption` below it.

    A `wide` one takes both columns of the page.
    """

    figure: Any
    alt: str
    caption: str
    wide: bool = False


@dataclass(frozen=True)
class Link:
    """A file beside the page."""

    href: str
    text: str


@dataclass(frozen=True)
class Table:
    """Rows of text, or links, under headings."""

    headings: Sequence[str]
    rows: Sequence[Sequence[str | Link]]
    caption: str


@dataclass(frozen=True)
class Code:
    """Lines to copy."""

    text: str
    caption: str


@dataclass
class Section:
    """A heading with its contents; one without contents is left out of the page."""

    title: str
    parts: list[Picture | Table | Code | str] = field(default_factory=list)


def render(title: str, sections: Sequence[Section]) -> str:
    """The page as text, of at most `LARGEST` bytes where coarser pictures can make it so; all texts are escaped."""
    for dpi in RESOLUTIONS:
        page = _page(title, sections, dpi)
        if len(page.encode("utf-8")) <= LARGEST:
            break
    return page


def may_be_replaced(path: Path) -> bool:
    """Whether a page may take the place of what is there: nothing that anybody would miss, or a page from here."""
    try:
        with open(path, "rb") as file:
            start = file.read(len(_BEGINNING))
    except OSError:  # told where it is written
        return True
    return not start or start == _BEGINNING.encode()


def _page(title: str, sections: Sequence[Section], dpi: int) -> str:
    shown = [section for section in sections if section.parts]
    links = "".join(f'<a href="#s{k}">{escape(section.title)}</a>' for k, section in enumerate(shown))
    body = "\n".join(
        f'<section id="s{k}"><h2>{escape(section.title)}</h2>\n<div class="parts">\n'
        + "\n".join(_part(part, dpi) for part in section.parts)
        + "\n</div></section>"
        for k, section in enumerate(shown)
    )
    return f"""{_BEGINNING}<meta name="viewport" content="width=device-width, initial-scale=1">
<link rel="icon" href="data:,">
<title>{escape(title)}</title>
<style>{_STYLE}</style>
</head>
<body>
<h1>{escape(title)}</h1>
<nav>{links}</nav>
{body}
</body>
</html>
"""


def _part(part: Picture | Table | Code | str, dpi: int) -> str:
    if isinstance(part, Picture):
        source = f"data:image/png;base64,{base64.b64encode(_png(part.figure, dpi)).decode('ascii')}"
        caption = escape(part.caption)
        kind = ' class="whole"' if part.wide else ""
        return f'<figure{kind}><img src="{source}" alt="{escape(part.alt)}"><figcaption>{caption}</figcaption></figure>'
    if isinstance(part, Table):
        head = "".join(f"<th>{escape(text)}</th>" for text in part.headings)
        rows = "".join("<tr>" + "".join(f"<td>{_cell(cell)}</td>" for cell in row) + "</tr>\n" for row in part.rows)
        note = f'<p class="note">{escape(part.caption)}</p>'
        table = f"<table><thead><tr>{head}</tr></thead><tbody>\n{rows}</tbody></table>"
        kind = ' class="whole"' if len(part.headings) > _NARROW else ""
        return f'<div{kind}><div class="wide">{table}</div>{note}</div>'
    if isinstance(part, Code):
        return f'<div class="whole"><p class="note">{escape(part.caption)}</p><pre>{escape(part.text)}</pre></div>'
    return f'<p class="whole">{escape(part)}</p>'


def _cell(cell: str | Link) -> str:
    if isinstance(cell, Link):
        return f'<a href="{escape(quote(cell.href))}">{escape(cell.text)}</a>'
    return escape(cell)


def _png(figure: Any, dpi: int) -> bytes:
    from PIL import Image

    stream, small = io.BytesIO(), io.BytesIO()
    # without matplotlib's version in it, the same data give the same page
    figure.savefig(stream, format="png", dpi=dpi, bbox_inches="tight", metadata={"Software": None})
    # maps have ramps: a palette of 256 colours is not seen, and a third of the size
    Image.open(stream).convert("RGB").quantize(256, dither=Image.Dither.NONE).save(small, "png", optimize=True)
    return small.getvalue()


__all__ = ["Code", "Link", "Picture", "Section", "Table", "may_be_replaced", "render"]
