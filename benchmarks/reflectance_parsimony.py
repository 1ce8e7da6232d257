"""What `fit --brdf auto` picks on scenes of known reflectance.

    python benchmarks/reflectance_parsimony.py [--seeds 10] [--first 0] [--size 192] [--scenes lambert]

For every seed a scene of each model is simulated (7 training views, 2 m GSD), its prior made, and the model chosen;
one epoch follows, so that the choice stands in a model file. Prints the table of scene against choice and every
reason. Seeds 100 and up were used for tuning.
"""

from __future__ import annotations

import argparse
import shutil
import tempfile
import time
from pathlib import Path

from sattools.cli import set_threads

MODELS = ("lambert", "rpv", "hapke")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seeds", type=int, default=10)
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--size", type=float, default=192.0)
    parser.add_argument("--scenes", nargs="+", choices=MODELS, default=list(MODELS))
    parser.add_argument("--threads", type=int, default=1)
    arguments = parser.parse_args()
    set_threads(arguments.threads)

    from sattools.fit.checkpoint import load
    from sattools.fit.options import FitOptions
    from sattools.fit.stage import fit
    from sattools.prior import PriorOptions
    from sattools.prior.stage import prior
    from sattools.simulate import SimulateOptions, simulate

    table = {scene: dict.fromkeys(MODELS, 0) for scene in arguments.scenes}
    for seed in range(arguments.first, arguments.first + arguments.seeds):
        for model in arguments.scenes:
            folder = Path(tempfile.mkdtemp(prefix="parsimony_"))
            simulated = SimulateOptions(
                terrain="natural",
                id="AUTO",
                seed=seed,
                size=arguments.size,
                reflectance=model,
                views=9,
                off_nadir=18.0,
                units=4,
            )
            scene = simulate(simulated, folder / "AUTO")
            prior(scene, PriorOptions())
            start = time.perf_counter()
            notes = fit(scene, FitOptions(brdf="auto", resolution=2.0, epochs=[1]))["notes"]
            chosen = load(scene.path(scene.products["model"]))[1]["brdf"]
            table[model][chosen] += 1
            print(f"{model:8s} {seed:4d} -> {chosen:8s} {time.perf_counter() - start:5.1f} s", flush=True)
            for text in notes:
                if text.startswith("brdf auto"):
                    print(f"     {text}", flush=True)
            shutil.rmtree(folder)
    print("\nscene      " + "".join(f"{m:>9}" for m in MODELS))
    for model in arguments.scenes:
        print(f"{model:10s} " + "".join(f"{table[model][m]:9d}" for m in MODELS))


if __name__ == "__main__":
    main()
