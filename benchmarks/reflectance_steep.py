"""Reflectance on steep ground with camera errors and sky light: maps, and a view that took no part, by model.

    python benchmarks/reflectance_steep.py --scenes 210:30:0.03 212:40:0.02 [--brdfs hapke rpv lambert]
        [--skies none auto] [--keep FOLDER]

A scene is SEED:SLOPE:SKY or SEED:SLOPE:SKY:SUN, with the mean slope and the sun's elevation in degrees (48 by default).
Each is simulated (256 m, cameras up to 2 pixels off), prepared from images 8 to 14 with image 3 held out, normalised,
matched once and fitted with every model on cells of 2 m, by every --sky. Prints, per scene and model, the DSM's MAE
[m], the PSNR of image 3 [dB], of Hapke's maps NRMSE over the truth's mean, and the sky's light that was found.
To compare versions, keep the folder and run the other checkout on it: scenes and priors that are there are used again.
"""

from __future__ import annotations

import argparse
import json
import re
import subprocess
import sys
import tempfile
from itertools import product
from pathlib import Path

IMAGES = (3, *range(8, 15))
MAPS = ("w", "theta", "b", "c")


def sattools(*arguments: str | Path, given: str = "") -> str:
    """Standard output of a command that is given some standard input."""
    command = [sys.executable, "-m", "sattools", *map(str, arguments)]
    done = subprocess.run(command, input=given, capture_output=True, text=True, check=False)
    if done.returncode:
        raise SystemExit(done.stderr.strip().splitlines()[-1])
    return done.stdout


def matched(folder: Path, seed: str, slope: str, sky: str, sun: str) -> tuple[str, Path]:
    """The document of a scene with its prior, and the folder of the truth; made where they are not there."""
    name = f"N{seed}"
    document = folder / f"{name}.json"
    if not document.exists():
        light = ("--sky", sky, "--sun-elevation", sun)
        ground = ("--terrain", "natural", "--size", "256", "--slope", slope, "--bias-px", "2", "--seed", seed)
        sattools("simulate", *ground, *light, "--id", name, "--out", folder)
        images = [folder / name / "images" / f"{name}_{k:03d}.tif" for k in IMAGES]
        own = ("--holdout", images[0].stem, "--id", f"{name}_P", "--out", folder, "--cell-size", "2")
        scene = sattools("prep", *images, "--metadata", folder / name / "metadata", *own)
        scene = sattools("normalise", "--quantity", "reflectance_factor", "--scale", "1/4095", given=scene)
        document.write_text(sattools("prior", given=scene))
    return document.read_text(), folder / name / "truth"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--scenes", nargs="+", default=["210:30:0.03"], metavar="SEED:SLOPE:SKY[:SUN]")
    parser.add_argument("--brdfs", nargs="+", default=["hapke", "rpv", "lambert"])
    parser.add_argument("--skies", nargs="+", default=["none"], choices=["none", "fitted", "auto"])
    parser.add_argument("--keep", type=Path, metavar="FOLDER")
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory() as temporary:
        folder = (arguments.keep or Path(temporary)).absolute()
        folder.mkdir(parents=True, exist_ok=True)
        for scene in arguments.scenes:
            seed, slope, sky, sun = (*scene.split(":"), "48")[:4]
            document, truth = matched(folder, seed, slope, sky, sun)
            for brdf, sky in product(arguments.brdfs, arguments.skies):
                if brdf == "lambert" and sky != "none":
                    continue
                light = ("--brdf", brdf, *(() if sky == "none" else ("--sky", sky)))
                fitted = sattools("fit", *light, "--resolution", "2", "--overwrite", given=document)
                notes = " ".join(json.loads(fitted)["sattools"]["history"][-1].get("notes", []))
                light = re.search("sky light ([^%]*) %", notes)
                fitted = sattools("export", "--view", f"N{seed}_003", "--overwrite", given=fitted)
                maps = [("--map", f"{m}={truth / f'N{seed}_{m.upper()}.tif'}") for m in MAPS if brdf == "hapke"]
                score = ("compare", "--views", "--overwrite", "--dsm", truth / f"N{seed}_DSM.tif", *sum(maps, ()))
                row = json.loads(sattools(*score, given=fitted).splitlines()[0])
                told = [f"{m} {v['nrmse']:.3f}" for m, v in row.get("parameters", {}).items() if v["nrmse"] is not None]
                told += [f"(sky light {light[1]} %)"] if light else []
                print(
                    scene, brdf, f"sky {sky}  DSM {row['mae']:.3f} m  view 3 {row['psnr']:.2f} dB ", *told, flush=True
                )


if __name__ == "__main__":
    main()
