"""What air costs maps of reflectance, and what `normalise --atmosphere` gives back: Hapke's maps of simulated ground.

    python benchmarks/hazy.py --scenes 210:30:0.03 211:15:0.05 [--path 0.02 0.05 0.09] [--through 0.92 0.87 0.79]

Scenes are those of `reflectance_steep.py` (SEED:SLOPE:SKY[:SUN]), their bands red, green and blue. Every image gets an
air of its own: --path times 0.8 to 1.2 of light [pi L / (E cos sun zenith)], and --through of what the ground sends.
Prints, without air and with it, by what `normalise` was asked for (--dark is its --dark-reflectance): NRMSE of w and
theta over the truth's mean, of w after one common factor, too, the DSM's MAE [m], the PSNR of image 3 [dB], and what
the air over image 8 was taken for.
"""

from __future__ import annotations

import argparse
import json
import shutil
import tempfile
from pathlib import Path

import numpy as np
import rasterio
from reflectance_steep import IMAGES, sattools

from sattools.scene import Scene

FULL = 4095
KINDS = (("no air", "none"), ("air", "none"), ("air", "dark-object"), ("air", "rayleigh"))


def with_air(images: list[Path], target: Path, path: np.ndarray, through: np.ndarray, zenith_cosine: float) -> None:
    """Copies of images of reflectance factors under an air of their own."""
    target.mkdir(exist_ok=True)
    for image, share in zip(images, np.linspace(0.8, 1.2, len(images)), strict=True):
        shutil.copy(image, target)
        with rasterio.open(target / image.name, "r+") as data:
            numbers = data.read()
            added = FULL * zenith_cosine * share * path[:, None, None]
            hazy = np.clip(np.round(numbers * through[:, None, None] + added), 1, FULL)
            data.write(np.where(numbers > 0, hazy, 0).astype(numbers.dtype))


def fitted(images: list[Path], made: Path, atmosphere: str, dark: float, out: Path) -> tuple[dict, Scene]:
    """Figures of Hapke's maps, and the scene."""
    truth, name = made / "truth", made.name
    own = ("--holdout", images[0].stem, "--id", f"{name}_P", "--out", out, "--cell-size", "2")
    scene = sattools("prep", *images, "--metadata", made / "metadata", *own)
    declared = ("--quantity", "reflectance_factor", "--scale", f"1/{FULL}", "--atmosphere", atmosphere)
    scene = sattools("normalise", *declared, "--dark-reflectance", str(dark), given=scene)
    scene = sattools("fit", "--brdf", "hapke", "--resolution", "2", given=scene)
    scene = sattools("export", "--view", images[0].stem, given=scene)
    maps = [("--map", f"{m}={truth / f'{name}_{m.upper()}.tif'}") for m in ("w", "theta")]
    score = sattools("compare", "--views", "--dsm", truth / f"{name}_DSM.tif", *sum(maps, ()), given=scene)
    return json.loads(score.splitlines()[0]), Scene.from_file(out / f"{name}_P" / "scene.json")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--scenes", nargs="+", default=["210:30:0.03"], metavar="SEED:SLOPE:SKY[:SUN]")
    parser.add_argument("--path", nargs=3, type=float, default=(0.02, 0.05, 0.09))
    parser.add_argument("--through", nargs=3, type=float, default=(0.92, 0.87, 0.79))
    parser.add_argument("--dark", type=float, default=0.01)
    arguments = parser.parse_args()
    path, through = np.array(arguments.path), np.array(arguments.through)
    for text in arguments.scenes:
        seed, slope, sky, sun = (*text.split(":"), "48")[:4]
        with tempfile.TemporaryDirectory() as temporary:
            folder = Path(temporary)
            ground = ("--terrain", "natural", "--size", "256", "--slope", slope, "--bias-px", "2", "--seed", seed)
            light = ("--sky", sky, "--sun-elevation", sun)
            sattools("simulate", *ground, *light, "--id", f"N{seed}", "--out", folder)
            made = folder / f"N{seed}"
            clear = [made / "images" / f"N{seed}_{k:03d}.tif" for k in IMAGES]
            with_air(clear, folder / "hazy", path, through, float(np.sin(np.radians(float(sun)))))
            for air, atmosphere in KINDS:
                images = clear if air == "no air" else [folder / "hazy" / image.name for image in clear]
                row, scene = fitted(images, made, atmosphere, arguments.dark, folder / f"{air} {atmosphere}")
                told = [f"{m} {v['nrmse']:.3f}" for m, v in row["parameters"].items() if v["nrmse"] is not None]
                scaled = row["parameters"]["w"]["nrmse_scaled"]
                found = scene.items[1].properties.get("sattools:atmosphere", {})
                print(
                    text, air, atmosphere, *told, f"w scaled {scaled:.3f}  DSM {row['mae']:.3f} m", flush=True, end="  "
                )
                print(f"view 3 {row['psnr']:.2f} dB ", *(f"{k} {v}" for k, v in found.items()), flush=True)


if __name__ == "__main__":
    main()
