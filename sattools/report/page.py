"""An HTML page that needs nothing beside itself: no script, no network, pictures inside."""

from __future__ import annotations

import base64
import io
from collections.abc import Sequence
from dataclasses import dataclass, field
from html import escape
from typing import Any

# the browser itself refuses whatever is not in the page
_POLICY = "default-src 'none'; img-src data:; style-src 'unsafe-inline'"
_STYLE = """
:root { color-scheme: light dark; }
body { font: 16px/1.5 system-ui, sans-serif; max-width: 72rem; margin: 2rem auto; padding: 0 1rem; }
nav a { margin-right: 1rem; }
section { margin-top: 2.5rem; }
figure { display: inline-block; vertical-align: top; margin: 0 1rem 1rem 0; max-width: min(100%, 46rem); }
img { max-width: 100%; height: auto; background: white; }
figcaption, .note { font-size: 0.9rem; opacity: 0.85; }
.wide { overflow-x: auto; }
table { border-collapse: collapse; font-variant-numeric: tabular-nums; }
th, td { padding: 0.2rem 0.7rem; border-bottom: 1px solid #8886; text-align: right; }
th:first-child, td:first-child { text-align: left; }
pre { overflow-x: auto; padding: 0.7rem; border: 1px solid #8886; }
"""


@dataclass(frozen=True)
class Picture:
    """A matplotlib figure with what is said about it: `alt` for who cannot see it, `caption` below it."""

    figure: Any
    alt: str
    caption: str


@dataclass(frozen=True)
class Table:
    """Rows of text under headings."""

    headings: Sequence[str]
    rows: Sequence[Sequence[str]]
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
    """The page as text; all texts are escaped."""
    shown = [section for section in sections if section.parts]
    links = "".join(f'<a href="#s{k}">{escape(section.title)}</a>' for k, section in enumerate(shown))
    body = "\n".join(
        f'<section id="s{k}"><h2>{escape(section.title)}</h2>\n' + "\n".join(map(_part, section.parts)) + "</section>"
        for k, section in enumerate(shown)
    )
    return f"""<!DOCTYPE html>
<html lang="en">
<head>
<meta charset="utf-8">
<meta http-equiv="Content-Security-Policy" content="{_POLICY}">
<meta name="viewport" content="width=device-width, initial-scale=1">
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


def _part(part: Picture | Table | Code | str) -> str:
    if isinstance(part, Picture):
        source = f"data:image/png;base64,{base64.b64encode(_png(part.figure)).decode('ascii')}"
        caption = escape(part.caption)
        return f'<figure><img src="{source}" alt="{escape(part.alt)}"><figcaption>{caption}</figcaption></figure>'
    if isinstance(part, Table):
        head = "".join(f"<th>{escape(text)}</th>" for text in part.headings)
        rows = "".join("<tr>" + "".join(f"<td>{escape(text)}</td>" for text in row) + "</tr>\n" for row in part.rows)
        note = f'<p class="note">{escape(part.caption)}</p>'
        return f'<div class="wide"><table><thead><tr>{head}</tr></thead><tbody>\n{rows}</tbody></table></div>{note}'
    if isinstance(part, Code):
        return f'<p class="note">{escape(part.caption)}</p><pre>{escape(part.text)}</pre>'
    return f"<p>{escape(part)}</p>"


def _png(figure: Any) -> bytes:
    stream = io.BytesIO()
    # without matplotlib's version in it, the same data give the same page
    figure.savefig(stream, format="png", dpi=100, bbox_inches="tight", metadata={"Software": None})
    return stream.getvalue()


__all__ = ["Code", "Picture", "Section", "Table", "render"]
