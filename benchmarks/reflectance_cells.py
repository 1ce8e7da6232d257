"""What endmembers buy: b, c and theta per material against b, c and theta of every cell's own.

    python benchmarks/reflectance_cells.py [--seeds 40 41] [--size 384]

A scene is simulated and fitted with endmembers. On the same surface, from the same seven views, every cell then gets
its own four parameters: Gauss-Newton steps of each cell's least squares, with the priors that the endmembers have
("cells"), or with the neighbours' mean over `REACH` cells as prior ("smooth"). Prints, per scene and kind, NRMSE and
correlation of the maps, theirs of the best constant map, and the PSNR of view 3.
"""

from __future__ import annotations

import argparse
import shutil
import tempfile
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from sattools.cli import set_threads

ROUNDS = 12
REACH = 3.0  # cells
NAMES = ("w", "b", "c", "theta")


def invert_cells(s, start: Tensor, amplitude: Tensor, grid: tuple[int, int], reach: float) -> tuple[Tensor, Tensor]:
    """Amounts ``[N, C]`` and shapes ``[N, 3]`` (unbounded) of every cell alone; the amounts are eliminated.

    Args:
        s: what the views show of every cell of a grid, in its order.
        start: ``[N, 3]`` first shapes. amount: ``[N, C]`` first amounts.
        grid: its rows and columns.
        reach: the prior is the neighbours' mean over so many cells; 0 = the usual values.
    """
    from sattools.fit.materials.blur import blurred
    from sattools.fit.materials.inversion import ROBUST, STEP, noise_of, start_endmembers
    from sattools.fit.materials.parameters import AMPLITUDE, SHAPE, radiance_factor

    prior_sigma = start.new_tensor([p.prior_sigma for p in SHAPE["hapke"]])
    prior_mean = start_endmembers("hapke", 1, start).expand_as(start)
    shape, sigma = start.clone(), noise_of(s)

    def seen(a: Tensor, x: Tensor) -> Tensor:
        value = AMPLITUDE["hapke"].bounded(a)
        own = tuple(p.bounded(x[:, k]) for k, p in enumerate(SHAPE["hapke"]))
        return torch.stack([radiance_factor("hapke", s.normal, *pair, value, own) for pair in zip(s.suns, s.views)])

    for _ in range(ROUNDS):
        centre = prior_mean if reach == 0 else blurred(shape.T.reshape(3, *grid), reach).reshape(3, -1).T
        here = seen(amplitude, shape)
        residual = (s.seen - here) / sigma
        weight = s.weight[..., None] / (1 + (residual / ROBUST) ** 2)
        j_amplitude = (seen(amplitude + STEP, shape) - here) / STEP / sigma
        steps = torch.eye(3) * STEP
        j_shape = torch.stack([(seen(amplitude, shape + steps[k]) - here) / STEP / sigma for k in range(3)], -1)
        a = (weight * j_amplitude**2).sum(0) + 1e-3
        cross = (weight[..., None] * j_amplitude[..., None] * j_shape).sum(0)
        full = torch.einsum("vncp,vncq->npq", weight[..., None] * j_shape, j_shape)
        hessian = full - torch.einsum("ncp,ncq->npq", cross / a[..., None], cross) + torch.diag(1 / prior_sigma**2)
        g = torch.einsum("vncp,vnc->np", j_shape, weight * residual)
        g = g - torch.einsum("ncp,nc->np", cross, (weight * j_amplitude * residual).sum(0) / a)
        step = torch.linalg.solve(hessian, g + (centre - shape) / prior_sigma**2)
        shape = (shape + step.clamp(-0.7, 0.7)).clamp(-6, 6)
        # the amounts follow
        here = seen(amplitude, shape)
        j = (seen(amplitude + STEP, shape) - here) / STEP / sigma
        residual = (s.seen - here) / sigma
        weight = s.weight[..., None] / (1 + (residual / ROBUST) ** 2)
        move = (weight * j * residual).sum(0) / ((weight * j * j).sum(0) + 1e-3)
        amplitude = (amplitude + move.clamp(-1.5, 1.5)).clamp(-9, 9)
    return amplitude, shape


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seeds", type=int, nargs="+", default=[40, 41])
    parser.add_argument("--size", type=float, default=384.0)
    parser.add_argument("--threads", type=int, default=1)
    arguments = parser.parse_args()
    set_threads(arguments.threads)

    from sattools.compare.metrics import image_errors, map_errors
    from sattools.export.novel import render_item
    from sattools.export.parts import WholeModel
    from sattools.fit.materials.parameters import AMPLITUDE, SHAPE
    from sattools.fit.materials.scene import ReflectiveScene
    from sattools.fit.model import FittedModel
    from sattools.fit.options import FitOptions
    from sattools.fit.stage import fit
    from sattools.prior import PriorOptions
    from sattools.prior.stage import prior
    from sattools.render import sun_visibility
    from sattools.scene.raster import read_raster
    from sattools.simulate import SimulateOptions, simulate
    from sattools.views import load_sources, views_on

    class OwnShapes(ReflectiveScene):
        own: tuple[Tensor, Tensor, Tensor]

        def values(self) -> tuple[Tensor, tuple[Tensor, Tensor, Tensor]]:
            return AMPLITUDE["hapke"].bounded(self.amplitude), self.own

    rows: dict[str, list[list[float]]] = {}
    for seed in arguments.seeds:
        folder = Path(tempfile.mkdtemp(prefix="cells_"))
        name = f"NAT{seed}"
        options = SimulateOptions(terrain="natural", id=name, seed=seed, size=arguments.size)
        scene = simulate(options, folder / name)
        prior(scene, PriorOptions())
        fit(scene, FitOptions(brdf="hapke", resolution=options.gsd))
        fitted = FittedModel.load(scene.path(scene.products["model"]))
        surface, grid = fitted.surface(), fitted.grid
        assert isinstance(surface, ReflectiveScene)
        views = views_on(load_sources(scene, scene.train_items()), grid, fitted.z_ref, scene.require_height_range())
        lit = sun_visibility(surface.casting(), grid.cell_size, views[0].sun)
        s = surface.samples(views, [lit] * len(views))
        truth = {n: read_raster(scene.path(scene.products[f"truth_{n}"]))[0] for n in NAMES}
        (item,) = [i for i in scene.items if i.id == f"{name}_003"]
        target = load_sources(scene, [item])[0].radiance
        found: dict[str, ReflectiveScene] = {"endmembers": surface}
        flat = surface.amplitude.reshape(-1, surface.amplitude.shape[-1])
        first = (surface.abundances @ surface.endmembers).reshape(-1, 3)
        for kind, reach in (("cells", 0.0), ("smooth", REACH)):
            with torch.no_grad():
                amplitude, shape = invert_cells(s, first, flat, grid.shape, reach)
            other = OwnShapes(**vars(surface))
            other.amplitude = amplitude.reshape(surface.amplitude.shape)
            own = [p.bounded(shape[:, k]).reshape(grid.shape) for k, p in enumerate(SHAPE["hapke"])]
            other.own = (own[0], own[1], own[2])
            found[kind] = other
        for kind, model in found.items():
            amplitude, shape = model.values()
            maps = dict(zip(NAMES, (amplitude.permute(2, 0, 1), *(p[None] for p in shape)), strict=True))
            errors = {n: map_errors(maps[n].detach().numpy(), truth[n]) for n in NAMES}
            psnr = image_errors(np.stack(render_item(scene, item.id, WholeModel(fitted, model), None).bands), target)[
                "psnr"
            ]
            line = [errors[n][key] for n in NAMES for key in ("nrmse", "nrmse_constant", "correlation")]
            rows.setdefault(kind, []).append([*line, psnr])
            print(seed, text(kind, rows[kind][-1]), flush=True)
        shutil.rmtree(folder)
    print("\nmeans")
    for kind, lines in rows.items():
        print(text(kind, np.mean(lines, axis=0)))


def text(kind: str, line) -> str:
    parts = [
        f"{n} {line[3 * k]:.3f} (constant {line[3 * k + 1]:.3f}) r {line[3 * k + 2]:+.2f}" for k, n in enumerate(NAMES)
    ]
    return f"{kind:<12} " + "  ".join(parts) + f"  view 3 {line[-1]:.2f} dB"


if __name__ == "__main__":
    main()
