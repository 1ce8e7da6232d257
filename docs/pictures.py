"""Run the tutorials' lines and draw what they make: `python docs/pictures.py FOLDER [PAGE...]`, with SATTOOLS_DATA.

Pictures go to docs/images/tutorials. FOLDER keeps the scenes; a page that has been run there is only drawn again.
The page `qgis` needs a QGIS and an X server (`xvfb-run -a -s '-screen 0 1440x900x24' python docs/pictures.py ...`).
"""

import os
import re
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

DOCS = Path(__file__).parent
PICTURES = DOCS / "images/tutorials"
DATA = Path(os.environ.get("SATTOOLS_DATA", "."))
SETTINGS = {
    "pleiades": {"IMAGES": " ".join(str(DATA / f"pleiades/marseille_triplet/img_0{n}.tif") for n in (1, 3))},
    "city": {"ROOT": str(DATA / "dfc2019")},
}
QUALITY = 82


def run(page: str, folder: Path, language: str = "bash") -> None:
    """Run a page's lines once."""
    if (folder / "done").exists():
        return
    text = (DOCS / f"tutorials/{page}.md").read_text(encoding="utf-8")
    code = "\n".join(re.findall(rf"(?ms)^```{language}\n(.*?)^```", text))
    for name, value in SETTINGS.get(page, {}).items():
        code = re.sub(rf"(?m)^{name}=.*$", lambda _, line=f'{name}="{value}"': line, code)  # type: ignore[misc]
    folder.mkdir(parents=True, exist_ok=True)
    path = f"{Path(sys.executable).parent}:{os.environ['PATH']}"
    command = [sys.executable, "-c", code] if language == "python" else ["bash", "-euo", "pipefail", "-c", code]
    subprocess.run(command, cwd=folder, env={**os.environ, "PATH": path}, check=True)
    (folder / "done").touch()


def save(figure: Any, name: str) -> None:
    """A figure as a JPEG of about 100 kB."""
    figure.savefig(PICTURES / f"{name}.jpg", dpi=90, bbox_inches="tight", pil_kwargs={"quality": QUALITY})


def surface(path: Path, title: str, name: str) -> None:
    """A surface model as `export` and `report` draw it."""
    from sattools.export.hillshade import picture
    from sattools.scene.raster import read_overview

    heights, grid = read_overview(path)
    save(picture(heights[0], grid, title), name)


def parameter(path: Path, label: str, name: str) -> None:
    """A map of one quantity, or an orthophoto."""
    import numpy as np

    from sattools.report.figures import map_figure
    from sattools.scene.raster import read_overview

    array, grid = read_overview(path)
    save(map_figure(array[:3].astype(np.float32), grid, label), name)


def photograph(path: Path, name: str) -> None:
    """An orthophoto of one band, as eyes would see it."""
    import numpy as np
    from matplotlib.figure import Figure

    from sattools.scene.raster import read_overview

    array, grid = read_overview(path)
    figure = Figure(figsize=(5.6, 5.6 * grid.height / grid.width), layout="constrained")
    axes = figure.subplots()
    low, high = np.nanquantile(array, [0.01, 0.99])
    axes.imshow(array[0], cmap="gray", vmin=low, vmax=high)
    axes.set_axis_off()
    save(figure, name)


def pleiades(folder: Path) -> None:
    export = folder / "work/QUARRY/export"
    surface(export / "dsm.tif", "QUARRY", "pleiades_dsm")
    photograph(export / "ortho.tif", "pleiades_ortho")


def city(folder: Path) -> None:
    from sattools.compare.picture import difference_figure
    from sattools.scene.raster import read_overview

    surface(folder / "work/JAX_068/export/dsm.tif", "JAX_068", "city_dsm")
    difference, grid = read_overview(folder / "work/JAX_068/compare/difference.tif")
    save(difference_figure(difference[0], grid, "surface minus lidar"), "city_difference")


def desert(folder: Path) -> None:
    export = folder / "DESERT/export"
    parameter(export / "w.tif", "single-scattering albedo w [1]", "desert_w")
    parameter(export / "theta.tif", "roughness theta [degrees]", "desert_theta")


def batch(folder: Path) -> None:
    from PIL import Image

    figure = Image.open(folder / "results/speed_error.png").convert("RGB")
    figure.thumbnail((900, 900))
    figure.save(PICTURES / "batch_speed.jpg", quality=QUALITY)


def pansharpening(folder: Path) -> None:
    import numpy as np
    from matplotlib.figure import Figure

    from sattools.scene.raster import read_overview

    figure = Figure(figsize=(12, 4), layout="constrained")
    for axes, name in zip(figure.subplots(1, 3), ("dsm", "albedo", "ortho"), strict=True):
        array, _ = read_overview(folder / f"work/COLOURED/export/{name}.tif")
        low, high = np.nanquantile(array, [0.01, 0.99])
        shown = np.moveaxis(np.clip((array.astype(float) - low) / (high - low), 0, 1), 0, -1)
        shown = np.nan_to_num(shown, nan=1.0) if name == "ortho" else np.ma.masked_invalid(shown)
        axes.imshow(shown if shown.shape[2] == 3 else shown[..., 0], cmap="viridis" if name == "dsm" else "gray")
        axes.set_axis_off()
        axes.set_title(name)
    save(figure, "pansharpening")


def notebook(folder: Path) -> None:
    (PICTURES / "notebook.jpg").write_bytes((folder / "notebook/hill.jpg").read_bytes())


def qgis(folder: Path) -> None:
    """QGIS itself, with what `Run all` made, and its form."""
    profile = folder / "profile"
    environment = {k: v for k, v in os.environ.items() if not k.startswith(("PYTHON", "QT_", "GDAL_", "PROJ_", "LD_"))}
    environment |= {
        "QGIS_CUSTOM_CONFIG_PATH": str(profile),
        "QGIS_PLUGINPATH": str(DOCS.parent / "qgis_plugin"),
        "PATH": f"/usr/bin:/bin:{Path(sys.executable).parent}",  # QGIS takes the first python3 for its own
        "PICTURES": str(PICTURES),
        "FOLDER": str(folder.resolve()),
    }
    program = ["qgis", "--nologo", "--noversioncheck", "--code", str(DOCS / "qgis_pictures.py")]
    if not profile.exists():
        subprocess.run(["qgis_process.bin", "plugins", "enable", "sattools_qgis"], env=environment, check=True)
    subprocess.run(program, env=environment, check=True, timeout=180)
    from PIL import Image

    for path in PICTURES.glob("qgis_*.png"):
        Image.open(path).convert("RGB").quantize(256, dither=Image.Dither.NONE).save(path, optimize=True)


PAGES: dict[str, Callable[[Path], None]] = {
    "pleiades": pleiades, "city": city, "desert": desert, "pansharpening": pansharpening, "batch": batch,
    "notebook": notebook, "qgis": qgis,
}  # fmt: skip


def main() -> None:
    """Run and draw the pages that are named, or all."""
    folder, *names = sys.argv[1:]
    PICTURES.mkdir(parents=True, exist_ok=True)
    for name in names or PAGES:
        if name == "qgis":
            os.environ["QGIS_PROCESS"] = "true"  # the page's last lines are done in the window
        run(name, Path(folder) / name, "python" if name == "notebook" else "bash")
        PAGES[name](Path(folder) / name)


if __name__ == "__main__":
    main()
