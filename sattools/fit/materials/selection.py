"""Which reflectance model a scene needs: the richer one only where it predicts held-out views better."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Literal

import torch
from torch import Tensor

from sattools.errors import counted
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
MOSTLY = 0.5  # abundance from which a cell is one of a material's
LEAST_BLOCKS = 12  # of a material, that say whether it needs a model
LEAST_PART, SURE_ERRORS, SURE_GAIN = 0.05, 4.0, 0.5  # of a material that alone needs a model: ground, certainty, gain
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


@dataclass(frozen=True)
class Need:
    """Whether a material needs a model, by held-out views: what it takes from the error of Lambert's law there.

    Attributes:
        material: its number.
        share: of the cells that are mostly of it.
        gain: share of the error that the model takes away; below 0 = it errs by more.
        doubt: standard error of that; infinite where too few blocks say anything.
    """

    material: int
    share: float
    gain: float
    doubt: float

    @property
    def known(self) -> bool:
        """Whether there is enough of it to tell."""
        return math.isfinite(self.doubt)

    @property
    def needed(self) -> bool:
        """Whether it keeps the model of the scene: a small material unless it surely does without."""
        doubt = STANDARD_ERRORS * self.doubt
        if not self.known or self.gain > max(doubt, LEAST_GAIN):
            return True
        return self.share < LEAST_PART and self.gain + doubt > LEAST_GAIN

    @property
    def surely(self) -> bool:
        """Whether the model is needed even if the scene as a whole does without: one material of many may look so."""
        return self.share >= LEAST_PART and self.gain > max(SURE_ERRORS * self.doubt, SURE_GAIN)

    def told(self, kind: Kind, taken: bool, *, numbered: bool = True) -> str:
        """The reason, as a line; of a material without its number where it is none of the fit's own."""
        which = f"material {self.material + 1}" if numbered else "one material"
        return (
            f"brdf auto: {which} ({100 * self.share:.0f} % of the ground): {kind} changes the "
            f"error of held-out views by {-100 * self.gain:+.1f} % (standard error {100 * self.doubt:.1f} %) of "
            + (f"lambert's: took {kind}" if taken else "lambert's, which is enough")
        )


class _Held:
    """Errors of held-out views, by model and by material."""

    def __init__(self, s: Samples, block: Tensor, relative: bool) -> None:
        self.s, self.block, self.relative = s, block, relative
        self.views = extreme_views(s)
        self.scored = (block % 2 == 1) if relative else torch.ones_like(block, dtype=torch.bool)
        self.own = s.abundances > MOSTLY
        self._modelled: dict[Kind, list[Tensor]] = {}
        self._plain: dict[Kind, list[Tensor]] = {}

    def errors(self, predicted: list[Tensor]) -> Tensor:
        """Mean error ``[N]`` over the held-out views."""
        found = [_error(p, self.s, j, self.block, self.relative) for p, j in zip(predicted, self.views, strict=True)]
        return torch.stack(found).mean(0)

    def modelled(self, kind: Kind) -> list[Tensor]:
        """Held-out views by the model."""
        if kind not in self._modelled:
            self._modelled[kind] = [_modelled(kind, self.s, j) for j in self.views]
        return self._modelled[kind]

    def mixed(self, kind: Kind, rich: Tensor) -> list[Tensor]:
        """The same where some materials ``[K]`` have the model and the others Lambert's law."""
        if kind not in self._plain:
            self._plain[kind] = [_all_plain(kind, self.s, j) for j in self.views]
        mostly = (self.s.abundances @ rich.to(self.s.abundances) > MOSTLY)[:, None]
        pairs = zip(self.modelled(kind), self._plain[kind], strict=True)
        return [torch.where(mostly, one, other) for one, other in pairs]

    def gain(self, before: Tensor, after: Tensor, cells: Tensor) -> tuple[float, float]:
        """Share of the error ``before`` ``[N]`` that is gone ``after`` in some cells, and its standard error."""
        cells = cells & self.scored
        if len(torch.unique(self.block[cells])) < LEAST_BLOCKS:
            return 0.0, math.inf
        level = max(typical(before[cells], self.block[cells])[0], 1e-12)
        usual, error = typical((before - after)[cells], self.block[cells])
        return usual / level, error / level

    def needs(self, kind: Kind) -> list[Need]:
        """What every material gains by a model."""
        count = self.own.shape[1]
        every, none = torch.ones(count, dtype=torch.bool), torch.zeros(count, dtype=torch.bool)
        with_it, without = self.errors(self.mixed(kind, every)), self.errors(self.mixed(kind, none))
        usual = torch.tensor([self.gain(without, with_it, self.own[:, k])[0] > 0 for k in range(count)])
        found = []
        for k in range(count):
            # as the others do best: a view's scale is found from all of them
            one, other = usual.clone(), usual.clone()
            one[k], other[k] = True, False
            errors = [self.errors(self.mixed(kind, rich)) for rich in (other, one)]
            gain, doubt = self.gain(errors[0], errors[1], self.own[:, k])
            found.append(Need(k, float(self.own[:, k].float().mean()), gain, doubt))
        return found


def choose_model(s: Samples, block: Tensor, relative: bool) -> Choice:
    """Climb from Lambert to RPV to Hapke on shared geometry; each is fitted without a view and has to predict it.

    Where that leaves Lambert or RPV, the materials are asked one by one: ground of which some is Lambert's errs by more
    under a richer model as a whole, whatever the rest of it gains.

    Args:
        s: cells as the views see them; at least three views.
        block: ``[N]`` number of the block that each cell lies in.
        relative: the images' scale is unknown: a held-out view gets a gain and an offset per band from every second
            block, and is scored on the others.
    """
    if len(s.views) < 3:
        return Choice("lambert", [f"brdf auto: {counted(len(s.views), 'views')} leave none to hold out; kept lambert"])
    held = _Held(s, block, relative)
    errors = {"lambert": held.errors([_plain(s, j) for j in held.views])}
    best: Model = "lambert"
    notes = []
    for kind in LADDER:
        errors[kind] = held.errors(held.modelled(kind))
        gain, doubt = held.gain(errors[best], errors[kind], torch.ones_like(held.scored))
        better = gain > max(STANDARD_ERRORS * doubt, LEAST_GAIN)
        if math.isinf(doubt):
            notes.append(f"brdf auto: too little ground is held out to tell {kind} from {best}: kept {best}")
            continue
        notes.append(
            f"brdf auto: {kind} changes the error of held-out views by {-100 * gain:+.1f} % "
            f"(standard error {100 * doubt:.1f} %) of {best}'s: " + (f"took {kind}" if better else f"kept {best}")
        )
        if better:
            best = kind
    return _by_material(held, best, notes) if s.abundances.shape[1] > 1 and best != LADDER[-1] else Choice(best, notes)


def _by_material(held: _Held, whole: Model, notes: list[str]) -> Choice:
    """The model for a scene of which some materials need none, where all ground together chose ``whole``."""
    best = whole
    rich: dict[Model, Tensor] = {}
    for kind in LADDER:
        needs = held.needs(kind)
        if whole == "lambert":
            rich[kind] = torch.tensor([need.surely for need in needs])
            told = [need for need in needs if need.surely]
        else:
            rich[kind] = torch.tensor([need.needed for need in needs])
            told = []
        if kind == whole and rich[kind].all():
            break  # all ground together has been asked
        if kind == whole or not rich[kind].any():
            continue
        if best == "lambert":
            best = kind
            notes += [need.told(kind, taken=True, numbered=False) for need in told]
            continue
        # compared where either has a say
        cells = held.own[:, rich[best] | rich[kind]].any(1)
        before, after = (held.errors(held.mixed(k, rich[k])) for k in (best, kind))
        gain, doubt = held.gain(before, after, cells)
        if gain > max(STANDARD_ERRORS * doubt, LEAST_GAIN):
            notes.append(
                f"brdf auto: without the materials that need none, {kind} changes the error of held-out views by "
                f"{-100 * gain:+.1f} % (standard error {100 * doubt:.1f} %) of {best}'s: took {kind}"
            )
            best = kind
    return Choice(best, notes)


def plain_materials(kind: Kind, s: Samples, block: Tensor, relative: bool) -> tuple[Tensor, list[str]]:
    """Which materials do without the model: 1 = Lambert's law predicts held-out views of it as well ``[K]``, else 0.

    A material of too few cells to tell keeps the model, and all do where none is found to need it: the scene does.

    Args:
        kind: model of the scene.
        s: cells as the views see them; at least three views.
        block: ``[N]`` number of the block that each cell lies in.
        relative: see `choose_model`.

    Returns:
        That, and what was found of every material.
    """
    count = s.abundances.shape[1]
    if count < 2 or len(s.views) < 3:
        return s.abundances.new_zeros(count), []
    needs = _Held(s, block, relative).needs(kind)
    plain = torch.tensor([not need.needed for need in needs]).to(s.abundances)
    if not any(need.known and need.needed for need in needs):
        return torch.zeros_like(plain), []
    return plain, [need.told(kind, need.needed) for need in needs if need.known]


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


def _all_plain(kind: Kind, s: Samples, j: int) -> Tensor:
    """View j ``[N, C]`` by Lambert's law fitted to the others, in the terms of a model."""
    flat = replace(s, plain=s.abundances.new_ones(s.abundances.shape[1]))
    endmembers = start_endmembers(kind, s.abundances.shape[-1], s.normal)
    amplitude, _ = solve_amplitudes(kind, _without(flat, j), endmembers, rounds=8)
    return predict(kind, _only(flat, j), amplitude, endmembers)[0]


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


__all__ = ["Choice", "Need", "choose_model", "draw", "extreme_views", "plain_materials"]
