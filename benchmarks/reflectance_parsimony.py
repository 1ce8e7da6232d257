"""What `fit --brdf auto` picks on scenes of known reflectance.

    python benchmarks/reflectance_parsimony.py [--seeds 10] [--first 0] [--size 192] [--scenes lambert]

For every seed a scene of each kind is simulated (2 m GSD), its prior made, and the model chosen; one epoch follows, so
that the choice stands in a model file. Prints the span of the phase angles, every reason, and the table of scene
against choice. lambert, rpv and hapke have 7 training views within 18 degrees of the vertical on slopes of 15 degrees;
"lambert steep" has 30 degrees and 4 % of sky light, "hapke wide" 11 views within 45 degrees, so that the phase angles
span more than 40 degrees. "rpv half" and "hapke half" are as wide, with two of the four units Lambert's; they are
fitted to the end with `auto`, and with the model of the others for all ground. Printed are the share of the ground that
got the right one of the two, and the amplitude's RMSE over its mean where ground is Lambert's, and elsewhere.
"town" and "downtown" are simulated towns of 96 m, which are Lambert's, with images of unknown scale.
Seeds 100 to 199 were used for tuning, those below 320, and towns, for "half".
"""

from __future__ import annotations

import argparse
import shutil
import tempfile
import time
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from sattools.cli import set_threads

if TYPE_CHECKING:
    from sattools.scene import Scene

EDGE = 8  # cells at the border that are not scored
MODELS = ("lambert", "rpv", "hapke")
NARROW = {"views": 9, "off_nadir": 18.0, "units": 4}
WIDE = {"views": 11, "off_nadir": 45.0, "train": 11, "units": 4}
SCENES: dict[str, dict[str, object]] = {
    "lambert": {"reflectance": "lambert", **NARROW},
    "lambert steep": {"reflectance": "lambert", "slope": 30.0, "sky": 0.04, **NARROW},
    "rpv": {"reflectance": "rpv", **NARROW},
    "hapke": {"reflectance": "hapke", **NARROW},
    "hapke wide": {"reflectance": "hapke", **WIDE},
    "town": {"terrain": "city", "size": 96.0},
    "downtown": {"terrain": "downtown", "size": 96.0},
    "rpv half": {"reflectance": "rpv", "plain_units": 2, **WIDE},
    "hapke half": {"reflectance": "hapke", "plain_units": 2, **WIDE},
}


def told(scene: Scene) -> str:
    """How much of the ground of a fitted scene got the right kind of model, and the errors of its amplitude."""
    from sattools.fit.checkpoint import load
    from sattools.fit.materials.parameters import AMPLITUDE
    from sattools.scene.raster import read_raster

    tensors, meta = load(scene.path(scene.products["model"]))
    plain = read_raster(scene.path(scene.products["truth_lambert_share"]))[0][0] > 0.5
    inner = np.zeros_like(plain)
    inner[EDGE:-EDGE, EDGE:-EDGE] = True
    found = np.full(plain.shape, meta["brdf"] == "lambert")
    if "plain" in tensors:
        found = (tensors["abundances"] @ tensors["plain"]).numpy() > 0.5
    text = f"{meta['brdf']}, right on {100 * (found == plain)[inner].mean():.0f} % of the ground"
    name = "truth_" + AMPLITUDE[meta["brdf"]].name if meta["brdf"] != "lambert" else ""
    if name not in scene.products:
        return text
    truth = read_raster(scene.path(scene.products[name]))[0]
    error = AMPLITUDE[meta["brdf"]].bounded(tensors["amplitude"]).permute(2, 0, 1).numpy() - truth
    for kind, part in (("Lambert's", plain & inner), ("the rest", ~plain & inner)):
        text += f"; {kind} {np.sqrt((error[:, part] ** 2).mean()) / truth[:, part].mean():.3f}"
    return text


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seeds", type=int, default=10)
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--size", type=float, default=192.0)
    parser.add_argument("--scenes", nargs="+", choices=list(SCENES), default=list(SCENES))
    parser.add_argument("--threads", type=int, default=1)
    arguments = parser.parse_args()
    set_threads(arguments.threads)

    from sattools.fit.checkpoint import load
    from sattools.fit.illumination import phase_angles
    from sattools.fit.options import FitOptions
    from sattools.fit.stage import fit
    from sattools.prior import PriorOptions
    from sattools.prior.stage import prior
    from sattools.simulate import SimulateOptions, simulate

    table = {scene: dict.fromkeys(MODELS, 0) for scene in arguments.scenes}
    for seed in range(arguments.first, arguments.first + arguments.seeds):
        for model in arguments.scenes:
            folder = Path(tempfile.mkdtemp(prefix="parsimony_"))
            asked = {"terrain": "natural", "id": "AUTO", "seed": seed, "size": arguments.size, **SCENES[model]}
            simulated = SimulateOptions(**asked)  # type: ignore[arg-type]
            scene = simulate(simulated, folder / "AUTO")
            prior(scene, PriorOptions())
            start = time.perf_counter()
            half = "plain_units" in SCENES[model]
            cell = None if "terrain" in SCENES[model] else 2.0
            notes = fit(scene, FitOptions(brdf="auto", resolution=cell, epochs=None if half else [1]))["notes"]
            chosen = load(scene.path(scene.products["model"]))[1]["brdf"]
            table[model][chosen] += 1
            span = float(np.ptp(phase_angles(scene.train_items())))
            spent = time.perf_counter() - start
            print(f"{model:13s} {seed:4d} ({span:2.0f} deg) -> {chosen:8s} {spent:5.1f} s", flush=True)
            for text in notes:
                if text.startswith("brdf auto"):
                    print(f"     {text}", flush=True)
            if half:
                print(f"     auto: {told(scene)}", flush=True)
                fit(scene, FitOptions(brdf=SCENES[model]["reflectance"], resolution=2.0))  # type: ignore[arg-type]
                print(f"     all ground: {told(scene)}", flush=True)
            shutil.rmtree(folder)
    print("\nscene         " + "".join(f"{m:>9}" for m in MODELS))
    for model in arguments.scenes:
        print(f"{model:13s} " + "".join(f"{table[model][m]:9d}" for m in MODELS))


if __name__ == "__main__":
    main()
