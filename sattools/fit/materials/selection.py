"""Which reflectance model a scene needs: the richer one only where it predicts held-out views better."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal

import torch
from torch import Tensor

from sattools.fit.materials.blocks import blocks_of, typical
from sattools.fit.materials.inversion import (
    ROBUST,
    Samples,
    invert,
    noise_of,
    predict,
    solve_amplitudes,
    start_endmembers,
)
from sattools.fit.materials.parameters import Kind

Model = Literal["lambert", "rpv", "hapke"]
LADDER: tuple[Kind, ...] = ("rpv", "hapke")
CELLS = 3000
OUTLIER = 5.0  # residuals beyond this many standard deviations are something else than reflectance
STANDARD_ERRORS = 2.0  # twice what is asked for at least: a wrong step up the ladder costs more than a missing one
PLAIN_ROUNDS = 10
LEAST_GAIN = 0.01  # share of the held-out error that a richer model must take away


@dataclass(frozen=True)
class Choice:
    """The model, and why."""

    model: Model
    notes: list[str]


def extreme_views(s: Samples) -> list[int]:
    """The two views of smallest and largest phase angle: what lies outside the others must be extrapolated."""
    cosines = [float(sun @ view) for sun, view in zip(s.suns, s.views, strict=True)]
    order = sorted(range(len(cosines)), key=lambda j: cosines[j])
    return list(dict.fromkeys([order[0], order[-1]]))


def choose_model(s: Samples, block: Tensor, relative: bool) -> Choice:
    """Climb from Lambert to RPV to Hapke on shared geometry; each is fitted without a view and has to predict it.

    Args:
        s: cells as the views see them; at least three views.
        block: ``[N]`` number of the block that each cell lies in.
        relative: the images' scale is unknown: a held-out view gets a gain and an offset per band from every second
            block, and is scored on the others.
    """
    if len(s.views) < 3:
        return Choice("lambert", [f"brdf auto: {len(s.views)} views leave none to hold out; kept lambert"])
    held = extreme_views(s)
    scored = (block % 2 == 1) if relative else torch.ones_like(block, dtype=torch.bool)
    errors: dict[str, list[Tensor]] = {"lambert": [_error(_plain(s, j), s, j, block, relative) for j in held]}
    best: Model = "lambert"
    notes = []
    for kind in LADDER:
        errors[kind] = [_error(_modelled(kind, s, j), s, j, block, relative) for j in held]
        # how much less the richer model errs in every cell, over the held-out views
        gain = torch.stack(errors[best]).mean(0) - torch.stack(errors[kind]).mean(0)
        before, _ = typical(torch.stack(errors[best]).mean(0)[scored], block[scored])
        usual, error = typical(gain[scored], block[scored])
        better = usual > STANDARD_ERRORS * error and usual > LEAST_GAIN * before
        notes.append(
            f"brdf auto: {kind} changes the error of held-out views by {-100 * usual / max(before, 1e-12):+.1f} % "
            f"(standard error {100 * error / max(before, 1e-12):.1f} %) of {best}'s: "
            + (f"took {kind}" if better else f"kept {best}")
        )
        if better:
            best = kind
    return Choice(best, notes)


def _without(s: Samples, j: int) -> Samples:
    keep = [k for k in range(len(s.views)) if k != j]
    return replace(
        s, seen=s.seen[keep], weight=s.weight[keep], suns=[s.suns[k] for k in keep], views=[s.views[k] for k in keep]
    )


def _only(s: Samples, j: int) -> Samples:
    return replace(s, seen=s.seen[[j]], weight=s.weight[[j]], suns=[s.suns[j]], views=[s.views[j]])


def _plain(s: Samples, j: int) -> Tensor:
    """View j ``[N, C]`` as one colour per cell, from the others: their mean, robust and weighted by noise.

    The amplitudes of the richer models are found in the same way; were this the plain mean, their robustness alone
    would be taken for a phase function.
    """
    rest = _without(s, j)
    sigma, given = noise_of(rest), rest.weight[..., None]
    weight = given / sigma**2
    for _ in range(PLAIN_ROUNDS):
        colour = (weight * rest.seen).sum(0) / weight.sum(0).clamp_min(1e-6)
        weight = given / sigma**2 / (1 + ((rest.seen - colour) / sigma / ROBUST) ** 2)
    return colour


def _modelled(kind: Kind, s: Samples, j: int) -> Tensor:
    """View j ``[N, C]`` by a model fitted to the others."""
    rest = _without(s, j)
    solution = invert(kind, rest, start_endmembers(kind, s.abundances.shape[-1], s.normal), rounds=8)
    amplitude, _ = solve_amplitudes(kind, rest, solution.endmembers, solution.amplitude, rounds=3)
    return predict(kind, _only(s, j), amplitude, solution.endmembers)[0]


def _error(predicted: Tensor, s: Samples, j: int, block: Tensor, relative: bool) -> Tensor:
    """Bounded squared error ``[N]`` of a prediction ``[N, C]`` of view j, in units of its noise; 0 where not seen."""
    seen, weight = s.seen[j], s.weight[j] * (_without(s, j).weight.sum(0) >= 2)
    if relative:
        fitted = (weight > 0) & (block % 2 == 0)
        if int(fitted.sum()) >= 10:
            predicted = predicted.clone()
            for b in range(seen.shape[1]):
                design = torch.stack([predicted[fitted, b], torch.ones_like(predicted[fitted, b])], dim=1)
                gain, offset = torch.linalg.lstsq(design, seen[fitted, b : b + 1]).solution[:, 0]
                predicted[:, b] = gain * predicted[:, b] + offset
    residual = (predicted - seen) / noise_of(s)[j]
    return weight * residual.square().clamp_max(OUTLIER**2).mean(-1)


def draw(s: Samples, shape: tuple[int, int], seed: int) -> tuple[Samples, Tensor]:
    """`CELLS` of the cells that three views see, and their blocks.

    Args:
        s: the samples.
        shape: of their grid [cells].
        seed: of everything random.
    """
    usable = torch.nonzero((s.weight > 0).sum(0) >= min(3, len(s.views)))[:, 0]
    order = torch.randperm(len(usable), generator=torch.Generator().manual_seed(seed))[:CELLS]
    chosen = usable[order]
    return s.subset(chosen), blocks_of(shape)[chosen]


__all__ = ["Choice", "choose_model", "draw", "extreme_views"]
