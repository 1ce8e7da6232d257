"""A scene in a few lines for people."""

from __future__ import annotations

from sattools.errors import counted, printable
from sattools.scene.dependencies import STAGES, names_of
from sattools.scene.document import Item, Scene
from sattools.scene.jsonio import JsonObject


def summary(scene: Scene) -> str:
    """Text with the images, the grid, the products and the history."""
    lines = [f"scene {scene.id}  root {scene.root}"]
    if scene.grid:
        g = scene.grid
        lines.append(
            f"  grid {g.width} x {g.height} cells of {g.cell_size:g} m, {g.crs}, upper left {g.left:.2f} {g.top:.2f}"
        )
    if scene.height_range_m:
        lines.append("  heights {:.1f} ... {:.1f} m above the ellipsoid".format(*scene.height_range_m))
    lines.append(f"  {counted(len(scene.items), 'images')}, {len(scene.train_items())} for training{_left_out(scene)}")
    for item in scene.items:
        p = item.properties
        parts = [f"    {item.id:24s} {str(p.get('datetime') or 'no date')[:16]:16s}"]
        if item.sun:
            parts.append("sun az {:5.1f} el {:4.1f}".format(*item.sun))
        if p.get("view:off_nadir") is not None:
            parts.append(f"off-nadir {p['view:off_nadir']:4.1f}")
        if p.get("gsd") is not None:
            parts.append(f"gsd {p['gsd']:.2f} m")
        parts.append(f"{item.role}, held out by the fit" if item in _held_out_by_the_fit(scene) else item.role)
        lines.append("  ".join(parts))
    for name, href in scene.products.items():
        lines.append(f"  product {name:16s} {href}")
    for entry in scene.history:
        seconds, memory = entry.get("seconds", 0.0), entry.get("peak_memory_mb", 0.0)
        lines.append(f"  {entry['command']:10s} {seconds:8.1f} s  {memory:7.0f} MB")
        lines.extend(f"    {note}" for note in entry.get("notes", []))
    return printable("\n".join(line.replace("\n", " ") for line in lines))


def _held_out_by_the_fit(scene: Scene) -> list[Item]:
    return [item for item in scene.train_items() if item.held_out]


def _left_out(scene: Scene) -> str:
    count = len(_held_out_by_the_fit(scene))
    return f", {count} of them held out by the last fit" if count else ""


def brief(scene: Scene, entry: JsonObject | None) -> str:
    """What a command has left, in a few lines; the document's file is named for the next one.

    Args:
        scene: after the command.
        entry: of the history, None where nothing was done.
    """
    command = str((entry or {}).get("command", ""))
    lines = [f"scene {scene.id}: {counted(len(scene.items), 'images')}, {scene.path('scene.json')}"]
    if entry is not None:
        lines[0] += f" ({command} {entry.get('seconds', 0.0):.1f} s, {entry.get('peak_memory_mb', 0.0):.0f} MB)"
    made = names_of(STAGES[command]) if command in STAGES else set()
    lines += [f"  {name:16s} {scene.path(href)}" for name, href in scene.products.items() if name in made]
    lines += [f"  {note}" for note in (entry or {}).get("notes", [])]
    return printable("\n".join(line.replace("\n", " ") for line in lines))


__all__ = ["brief", "summary"]
