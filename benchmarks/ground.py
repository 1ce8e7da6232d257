"""How right is the bare ground that `export --products dtm` makes?

    python benchmarks/ground.py SCENE/scene.json=X_DSM.tif[@REGION] ... [--set NAME=VALUE ...] [--picture FOLDER]

Scenes are exported ones; references those of `benchmarks/steps.py`. `X_DTM.tif` beside `X_DSM.tif` (`sattools simulate`
writes it) is the truth everywhere, else the reference DSM is on cells of class 2 (ground). The DSM is registered as by
`compare`, and the ground is moved by the same. For every class of the reference: mean absolute error of the
ground, signed median, share of the cells that count as seen ground; of class 2 the DSM's own error beside it. --set
changes constants of `sattools.export.ground`.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np
from steps import reference

from sattools.compare import compare_dsm
from sattools.export import ground
from sattools.export.options import ExportOptions
from sattools.export.products.terrain import TRUSTED
from sattools.scene import Grid, Scene
from sattools.scene.raster import read_on, read_raster
from sattools.scene.regrid import reproject_map
from sattools.scene.validity import MEASURED

NAMES = {2: "ground", 5: "trees", 6: "buildings", 9: "water"}


def maps(scene: Scene) -> tuple[np.ndarray, np.ndarray, Grid]:
    """Surface, cells that are trusted, grid."""
    surface, grid = read_raster(scene.path(scene.products["dsm"]))
    trusted = np.isfinite(surface[0])
    if "validity" in scene.products:
        trusted &= read_raster(scene.path(scene.products["validity"]))[0][0] == MEASURED
    if "probability" in scene.products:
        trusted &= read_on(scene.path(scene.products["probability"]), grid)[0] >= TRUSTED
    return surface[0], trusted, grid


def score(text: str, picture: Path | None) -> None:
    path, _, against = text.partition("=")
    scene, truth = Scene.from_file(Path(path)), reference(against)
    surface, trusted, grid = maps(scene)
    found = ground.bare_ground(surface, trusted, grid.cell_size, ExportOptions().ground_width)
    compared = compare_dsm(surface, truth, grid)
    east, north, up = compared.figures["shift_m"]
    moved = grid.moved(east, north)
    height = reproject_map(found.height, moved, truth.grid)
    seen = reproject_map(found.seen.astype(np.float32), moved, truth.grid) > 0.5
    name = Path(against.partition("@")[0])
    bare = name.with_name(name.name.replace("_DSM", "_DTM"))
    own = truth.heights.copy()
    everywhere = bare != name and bare.exists()
    if everywhere:
        own = np.where(np.isfinite(own), read_on(bare, truth.grid)[0], np.nan)
    level = float(np.nanmedian(compared.difference))  # as little as possible of what errors at walls add to the mean
    error = np.where(np.isfinite(compared.difference), height + up - own - level, np.nan)
    parts = []
    classes = truth.classes if truth.classes is not None else np.full(own.shape, 2)
    for code, word in NAMES.items():
        cells = (classes == code) & np.isfinite(error)
        if not cells.any() or (code != 2 and not everywhere):
            continue
        of = error[cells]
        parts.append(f"{word} {np.abs(of).mean():.2f} ({np.median(of):+.2f}, {100 * seen[cells].mean():.0f} %)")
        if code == 2:
            parts[-1] += f" DSM {np.nanmean(np.abs(compared.difference[cells] - level)):.2f}"
    print(f"{scene.id:10s} " + ", ".join(parts), flush=True)
    if picture is not None:
        draw(picture / f"{scene.id}.png", [surface, found.height, np.where(found.seen, found.height, np.nan)], error)


def draw(path: Path, layers: list[np.ndarray], error: np.ndarray) -> None:
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot as plt

    figure, axes = plt.subplots(2, 2, figsize=(14, 13))
    low, high = np.nanpercentile(layers[1], [1, 99])
    for axis, layer in zip(axes.flat, layers, strict=False):
        axis.imshow(layer, vmin=low - 1, vmax=high + 6, cmap="terrain")
    axes.flat[3].imshow(error, vmin=-3, vmax=3, cmap="RdBu_r")
    figure.tight_layout()
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=60)
    plt.close(figure)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("scenes", nargs="+", metavar="SCENE=REFERENCE[@REGION]")
    parser.add_argument("--set", action="append", default=[], metavar="NAME=VALUE", help="constant of the filter")
    parser.add_argument("--picture", type=Path, help="folder for a picture of each scene")
    options = parser.parse_args()
    for text in options.set:
        name, _, value = text.partition("=")
        setattr(ground, name, float(value))
    for text in options.scenes:
        score(text, options.picture)


if __name__ == "__main__":
    main()
