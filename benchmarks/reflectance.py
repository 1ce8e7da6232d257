"""Cost of the reflectance models: forward and backward, per sample, in units of Lambert.

    python benchmarks/reflectance.py [--samples 1000000] [--repeats 15] [--threads N] [--per-sample-directions]

Gradients flow to all parameters and, except for the bare Lambertian BRF (which does not depend on it), to the normal.
"shaded" is what a renderer evaluates: BRF times cos i. The models take turns within each repeat and medians are
compared, so that a busy machine hits all alike.
"""

from __future__ import annotations

import argparse
import platform
import statistics
import time

import torch
from torch import Tensor

from sattools.reflectance import hapke, lambert, rpv


def upper(samples: int, spread: float) -> Tensor:
    vectors = torch.randn(samples, 3) * spread + torch.tensor([0.0, 0.0, 1.0])
    vectors[:, 2].abs_()
    return vectors / vectors.norm(dim=-1, keepdim=True)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--samples", type=int, default=1_000_000)
    parser.add_argument("--repeats", type=int, default=15)
    parser.add_argument("--threads", type=int, default=0)
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--per-sample-directions", action="store_true")
    options = parser.parse_args()
    if options.threads:
        torch.set_num_threads(options.threads)
    torch.manual_seed(0)
    count, device = options.samples, torch.device(options.device)
    directions = count if options.per_sample_directions else 1
    sun, view = (upper(directions, 0.6).to(device) for _ in range(2))
    if directions == 1:
        sun, view = sun[0], view[0]
    normal = upper(count, 0.3).to(device).requires_grad_()
    seed = torch.rand(count, device=device)

    def maps(*ranges: tuple[float, float]) -> list[Tensor]:
        return [(low + (high - low) * torch.rand(count, device=device)).requires_grad_() for low, high in ranges]

    unit = (0.05, 0.8)
    models = {
        "lambert": (lambert, maps(unit)),
        "rpv": (rpv, maps(unit, (0.5, 1.2), (-0.4, 0.2), unit)),
        "hapke": (hapke, maps(unit, unit, unit, (1.0, 40.0))),
        "hapke, opposition effect": (hapke, maps(unit, unit, unit, (1.0, 40.0), unit, (0.05, 1.0))),
    }

    def run(model, parameters: list[Tensor], shaded: bool) -> tuple[float, float]:
        for tensor in (normal, *parameters):
            tensor.grad = None
        if device.type == "cuda":
            torch.cuda.synchronize()
        start = time.perf_counter()
        value = model(normal, sun, view, *parameters)
        if shaded:
            value = value * (normal * sun).sum(-1).clamp_min(0)
        middle = time.perf_counter()
        value.backward(seed)
        if device.type == "cuda":
            torch.cuda.synchronize()
        return middle - start, time.perf_counter() - start

    times: dict[tuple[str, bool], list[tuple[float, float]]] = {(name, s): [] for s in (False, True) for name in models}
    for repeat in range(options.repeats + 2):
        for name, shaded in times:
            spent = run(*models[name], shaded)
            if repeat >= 2:
                times[name, shaded].append(spent)

    machine = (
        torch.cuda.get_device_name(device) if device.type == "cuda" else f"{platform.processor() or platform.machine()}"
    )
    print(
        f"{machine}, {torch.get_num_threads()} threads, torch {torch.__version__}, {count} samples, float32, ", end=""
    )
    print(
        f"{'own directions for each sample' if directions > 1 else 'one sun and one view'}, median of {options.repeats}"
    )
    for shaded in (False, True):
        unit_time = statistics.median(total for _, total in times["lambert", shaded])
        for name in models:
            forward, total = (statistics.median(column) for column in zip(*times[name, shaded]))
            what = "shaded" if shaded else "BRF"
            cost = f"forward {1e3 * forward:7.1f} ms  both {1e3 * total:7.1f} ms  {total / unit_time:5.2f} x lambert"
            print(f"{what:7}{name:26} {cost}")


if __name__ == "__main__":
    main()
