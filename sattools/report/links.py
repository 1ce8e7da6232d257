"""The page's section of links to the scene's files."""

from __future__ import annotations

from sattools.report.page import Link, Section, Table
from sattools.report.parts import product
from sattools.runlog import NAME
from sattools.scene.document import Scene


def products_section(scene: Scene) -> Section:
    """The products that are there and the log, as links relative to the scene's folder, with their sizes."""
    rows: list[list[str | Link]] = []
    for name, href in scene.products.items():
        path = product(scene, name)
        if path is not None:
            rows.append([name, Link(href, href), _size(path.stat().st_size)])
    log = scene.path(NAME)
    if log.is_file() and not log.is_symlink():
        rows.append(["log", Link(NAME, NAME), _size(log.stat().st_size)])
    caption = "Links work where this page lies in the scene's folder."
    return Section("Files", [Table(["product", "file", "size"], rows, caption)] if rows else [])


def _size(count: int) -> str:
    return f"{count / 1e6:.1f} MB" if count >= 1e6 else f"{count / 1e3:.1f} kB"


__all__ = ["products_section"]
