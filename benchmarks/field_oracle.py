"""Do the images say which surface is right? Colours alone are trained on the prior's surface and on the true one.

    python benchmarks/field_oracle.py [--steps 300] [--seed 1] [--size 64]

The same simulated city as in field_speed.py; the neural field with its shapes held, once over the prior and once over
the truth, the same rays in the same order. Then every second ray is rendered with evenly spread samples and its squared
residual compared, by how far apart the two surfaces are along it. If the true surface is no better where they differ,
or worse where they do not, training the shape by these residuals has nothing to gain.
"""

from __future__ import annotations

import argparse
import tempfile
from pathlib import Path
from typing import Any


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--steps", type=int, default=300)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--size", type=float, default=64.0)
    options = parser.parse_args()

    from sattools.cli import set_threads

    set_threads(1)
    import torch

    torch.set_num_threads(1)
    from sattools.fit.depth_prior import DepthPrior
    from sattools.fit.rays.start import filled_prior
    from sattools.prior import PriorOptions
    from sattools.prior.files import read_prior
    from sattools.prior.stage import prior
    from sattools.scene.raster import read_raster
    from sattools.simulate import SimulateOptions, simulate

    with tempfile.TemporaryDirectory() as folder:
        scene = simulate(SimulateOptions(size=options.size, views=6, dates=3, seed=options.seed), Path(folder) / "S")
        prior(scene, PriorOptions())
        grid = scene.require_grid()
        matched = filled_prior(DepthPrior.from_arrays(*read_prior(scene)), grid)
        true, true_grid = read_raster(scene.path(scene.products["truth_dsm"]))
        height = torch.from_numpy(true[0]).float()
        truth = filled_prior(DepthPrior(height, torch.ones_like(height), true_grid), grid)
        seen = {
            name: residuals(scene, at, matched, options.steps) for name, at in (("prior", matched), ("truth", truth))
        }
    low, high = scene.require_height_range()
    apart = (seen["prior"][1] - seen["truth"][1]).abs() * (high - low)
    print("| surfaces apart along the ray | rays | prior: mean, median | truth: mean, median |\n|---|---|---|---|")
    for nearest, furthest in ((0.0, 0.5), (0.5, 2.0), (2.0, 1e9)):
        chosen = (apart >= nearest) & (apart < furthest)
        figures = [f"{e[chosen].mean():.5f}, {e[chosen].median():.6f}" for e, _ in seen.values()]
        name = f"{nearest:g} to {furthest:g} m" if furthest < 1e9 else f"over {nearest:g} m"
        print(f"| {name} | {100 * float(chosen.float().mean()):.1f} % | " + " | ".join(figures) + " |")


def residuals(scene: Any, surface: Any, matched: Any, steps: int) -> tuple[Any, Any]:
    """Squared residual of every second ray after the colours have been trained, and its depth as share of the path."""
    from dataclasses import replace

    import torch

    from sattools.field import neural
    from sattools.fit.depth_prior import reference_height
    from sattools.fit.losses import photometric
    from sattools.fit.presets import resolve
    from sattools.fit.rays.start import base_surface, make_field, ray_set
    from sattools.fit.rays.trainer import FieldSteps, RayTrainer
    from sattools.views import load_sources, match_colours, views_on

    options = resolve("fast", {"field": "neural", "steps": steps})
    grid, z_range = scene.require_grid(), scene.require_height_range()
    z_ref = reference_height(matched, z_range)  # for both, or the rays would not be the same
    views = views_on(load_sources(scene, scene.train_items()), grid, z_ref, z_range)
    rays = ray_set(views, grid, z_range, surface)
    gain, offset = (torch.from_numpy(a) for a in match_colours(views))
    base = base_surface(views, surface, z_range, gain.numpy(), offset.numpy(), shaded=True)
    field = make_field(options, grid, z_range, z_ref, views[0].target.shape[-1], surface, base=base)
    held = FieldSteps({**neural.RATES, "presence": 0.0}, epsilon=neural.EPSILON)
    trainer = RayTrainer(field, rays, options, gain, offset, held)
    for number in range(steps):
        trainer.step(number)
    trainer.options = replace(options, samples=32, guided=48)
    found = []
    with torch.no_grad():
        for part in torch.arange(0, len(rays.target), 2).split(4096):
            shown = trainer.predict(part, 10**6, 1.0, None).colour
            found.append(photometric(options.loss, shown, rays.target[part]).mean(dim=1))
    return torch.cat(found), rays.depth[::2]


if __name__ == "__main__":
    main()
