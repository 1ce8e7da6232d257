"""Names of the products that `export` makes when asked to: known without importing what makes them."""

from __future__ import annotations

from collections.abc import Sequence

from sattools.errors import InputError

# what may be asked for -> products with their files
FILES: dict[str, dict[str, str]] = {
    "laz": {"points": "export/points.laz"},
    "ply": {"points_ply": "export/points.ply"},
    "contours": {"contours": "export/contours.gpkg"},
    "dtm": {"dtm": "export/dtm.tif", "dtm_validity": "export/dtm_validity.tif", "ndsm": "export/ndsm.tif"},
    "ortho": {"ortho": "export/ortho.tif", "ortho_source": "export/ortho_source.tif"},
    "mesh": {"mesh": "export/mesh.glb"},
    "obj": {"mesh_obj": "export/mesh.obj", "mesh_mtl": "export/mesh.mtl", "mesh_texture": "export/mesh.png"},
    "tiles": {"tileset": "export/tileset.json"},
}
ALWAYS = ("dsm", "albedo")  # may be named, though they are always written
LIBRARIES = {"laz": ("laspy", "lazrs"), "mesh": ("trimesh",)}  # of the extra `products`
NEEDS = {"mesh": ("ortho",), "obj": ("ortho",), "tiles": ("mesh", "ortho")}  # what others are made of
WORDS = (*ALWAYS, *FILES)


def parse_names(given: Sequence[str], contours: float | None = None) -> list[str]:
    """Keys of `FILES` from what was given with --products, commas and repetitions allowed.

    Args:
        given: texts of the option.
        contours: interval [m] of --contours, which asks for them too.

    Raises:
        InputError: one that does not exist.
    """
    from sattools.scene.schema import meant

    names = [name.strip().lower() for text in given for name in text.split(",") if name.strip()]
    for name in names:
        if name not in WORDS:
            raise InputError(
                f"--products: found {name[:40]!r}, expected some of {', '.join(WORDS)}{meant(name, WORDS)}"
            )
    if contours is not None:
        names.append("contours")
    names += [other for name in names for other in NEEDS.get(name, ())]
    return [name for name in FILES if name in names]


def hrefs(names: Sequence[str]) -> list[str]:
    """All files that will be written."""
    return [href for name in names for href in FILES[name].values()]


__all__ = ["FILES", "LIBRARIES", "WORDS", "hrefs", "parse_names"]
