"""A surface scene with a reflectance model instead of a plain albedo."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from typing import Literal

import torch
from torch import Tensor

from sattools.fit.materials.blur import blurred
from sattools.fit.materials.inversion import (
    Samples,
    Solution,
    invert,
    material_mean,
    shape_of,
    shape_shares,
    solve_amplitudes,
)
from sattools.fit.materials.parameters import AMPLITUDE, Kind, diffuse, radiance_factor
from sattools.fit.materials.shading import told_apart
from sattools.fit.materials.sky import (
    LEAST_RATIO,
    LEAST_SHARE,
    deep_shade,
    light_of_ground,
    share_in_shade,
    sky_gain,
)
from sattools.fit.materials.steps import NORMAL_CELLS, smooth_heights, smooth_normals
from sattools.fit.materials.uncertainty import known_share, parameter_std, shape_correlation
from sattools.fit.surface.scene import SurfaceScene
from sattools.views import View, shown_on

Sky = Literal["none", "fitted", "auto"] | Sequence[float]

STANDARD_SUN_DEG = 15.0
# share of the cells that counts as independent: errors of slopes and cameras are alike over many of them, and a fit
# that believes every cell trades w for b and c to please them
INDEPENDENT = 0.05
LIT = 0.95  # sun visibility from which a cell tells of its reflectance
SAMPLES = 4000
SATURATED = 0.999  # a number at full scale is a lower limit, not a value,
BEYOND = 1.001  # unless the image has larger ones: reflectances of bright slopes under a low sun are above 1
TEXTURE = 0.05  # deviation of the log amplitude, beyond small texture, that one material has anyway


@dataclass
class ReflectiveScene(SurfaceScene):
    """A `SurfaceScene` whose cells reflect by a model; per cell and view it costs one evaluation.

    The radiance of a cell towards image j is gain_j scale_j (v BRF cos i + (1 - v) ambient_j r) + offset_j with the
    sun's visibility v and the surface's diffuse reflectance r; scale_j is 1 for reflectance factors pi L / E and
    1 / sin(sun elevation) for top-of-atmosphere reflectance. With a sky, which lights all ground, lit or not, the
    second term is sky_share sky r; with a bounce, r times the light of the ground around is added.

    Attributes:
        kind: model.
        amplitude: ``[H, W, C]`` w or rho0 in the unbounded form of `Parameter`.
        endmembers: ``[K, 3]`` unbounded shape parameters of the endmembers; found by `invert`, not by gradient descent.
        abundances: ``[H, W, K]`` of the endmembers in each cell; fixed.
        suns, view_vectors: ``[V, 3]`` unit vectors to sun and sensor; scale: ``[V]``.
        cell_size: [m].
        frozen: ``[H, W, 3]`` normals that do not follow the height, as given or as `finish` leaves them, or None.
        smooth: weight of the amplitudes' smoothness.
        identifiable: ``[H, W, 3]`` share of the shapes' prior variance that the images took away; or empty.
        sky: ``[H, W, C]`` gain of the sky's light, see `sattools.fit.materials.sky`; empty = no sky.
        sky_share: ``[C]`` of the sky; what shade shows at the start, or as given.
        plain: ``[K]`` 1 = the endmember reflects as Lambert's law has it, else 0; empty = none does.
        opened: ``[H, W]`` open sky of every cell, whose rest is ground that sends light as well; empty = it sends none.
    """

    kind: Kind = "hapke"
    amplitude: Tensor = field(default_factory=lambda: torch.zeros(0))
    endmembers: Tensor = field(default_factory=lambda: torch.zeros(0))
    abundances: Tensor = field(default_factory=lambda: torch.zeros(0))
    suns: Tensor = field(default_factory=lambda: torch.zeros(0))
    view_vectors: Tensor = field(default_factory=lambda: torch.zeros(0))
    scale: Tensor = field(default_factory=lambda: torch.zeros(0))
    cell_size: float = 1.0
    frozen: Tensor | None = None
    smooth: float = 0.0
    identifiable: Tensor = field(default_factory=lambda: torch.zeros(0))
    sky: Tensor = field(default_factory=lambda: torch.zeros(0))
    sky_share: Tensor = field(default_factory=lambda: torch.zeros(0))
    opened: Tensor = field(default_factory=lambda: torch.zeros(0))
    plain: Tensor = field(default_factory=lambda: torch.zeros(0))
    correlation: float = field(default=0.0, init=False)  # of the errors of the first two shape parameters
    reasons: list[str] = field(default_factory=list, init=False)  # for which materials the model was chosen
    sky_ratio: float = field(default=0.0, init=False)  # share over its standard deviation, in the surest band

    @property
    def has_sky(self) -> bool:
        """Whether the sky lights the ground."""
        return self.sky.numel() > 0

    def casting(self) -> Tensor:
        """Heights ``[H, W]`` that cast the shadows: those that the normals are taken from.

        One surface must tell both: noisy bumps shade ground that the normals call lit, and the loss takes a patch in
        false shade for an outlier.
        """
        return smooth_heights(self.height, self.cell_size)[0]

    def normals(self) -> Tensor:
        """Unit vectors ``[H, W, 3]`` normal to the surface that the light is computed with."""
        return smooth_normals(self.height, self.cell_size) if self.frozen is None else self.frozen

    def values(self) -> tuple[Tensor, tuple[Tensor, Tensor, Tensor]]:
        """Amplitude ``[H, W, C]`` in [0, 1] and the three shape parameters ``[H, W]``, within their ranges."""
        shares = shape_shares(self.abundances, self.plain if self.plain.numel() else None)
        return AMPLITUDE[self.kind].bounded(self.amplitude), shape_of(self.kind, shares, self.endmembers)

    def plain_share(self) -> Tensor | None:
        """Share ``[H, W]`` of every cell that reflects as Lambert's law has it, or None."""
        return self.abundances @ self.plain if self.plain.numel() else None

    def colour(self, index: int, visibility: Tensor | None) -> Tensor:
        """Radiance ``[H, W, C]`` of every cell towards image ``index``; visibility ``[H, W]`` or None = all lit."""
        light = self.light(self.suns[index], self.view_vectors[index], visibility, self.ambient[index])
        return self.gain[index] * self.scale[index] * light + self.offset[index]

    def light(self, sun: Tensor, towards: Tensor, visibility: Tensor | None, ambient: Tensor) -> Tensor:
        """Pi L / E ``[H, W, C]`` towards ``towards`` under ``sun`` (unit vectors).

        Args:
            sun: ``[3]`` unit vector to the sun.
            towards: ``[3]`` unit vector to the sensor.
            visibility: ``[H, W]`` of the sun, in [0, 1], or None = all lit.
            ambient: ``[C]`` share of the light that reaches shade.
        """
        amplitude, shape = self.values()
        plain = self.plain_share()
        light = radiance_factor(self.kind, self.normals(), sun, towards, amplitude, shape, plain=plain)
        if self.has_sky:
            light = light if visibility is None else visibility[..., None] * light
            around = self.sky_share * self.sky
            if self.opened.numel():
                around = around + self.bounced(sun, visibility)
            return light + around * diffuse(self.kind, amplitude)
        if visibility is None:
            return light
        v = visibility[..., None]
        return v * light + (1 - v) * ambient * diffuse(self.kind, amplitude)

    @torch.no_grad()
    def bounced(self, sun: Tensor, visibility: Tensor | None) -> Tensor:
        """Irradiance ``[H, W, C]`` by the ground around under a sun ``[3]``, of which ``[H, W]`` is visible."""
        direct = (self.normals() @ sun).clamp_min(0)
        direct = direct if visibility is None else visibility * direct
        irradiance = direct[..., None] + self.opened[..., None] * self.sky_share
        reflected = diffuse(self.kind, AMPLITUDE[self.kind].bounded(self.amplitude))
        return light_of_ground(self.opened, irradiance, reflected, self.cell_size)

    def trainable(self) -> dict[str, Tensor]:
        """Tensors that gradient descent changes: heights [m], colours, the unbounded amplitude."""
        leaves = super().trainable()
        del leaves["albedo"]
        if self.has_sky:
            leaves.pop("ambient", None)
        return {**leaves, "amplitude": self.amplitude}

    def tensors(self) -> dict[str, Tensor]:
        """All tensors, for saving: heights [m], colours, unbounded parameters, unit vectors."""
        names = ["amplitude", "endmembers", "abundances", "suns", "view_vectors", "scale"]
        own = {name: getattr(self, name) for name in names}
        if self.frozen is not None:
            own["frozen"] = self.frozen
        if self.identifiable.numel():
            own["identifiable"] = self.identifiable
        if self.has_sky:
            own |= {"sky": self.sky, "sky_share": self.sky_share}
        own |= {name: part for name in ("opened", "plain") if (part := getattr(self, name)).numel()}
        return {**super().tensors(), **own}

    def resized(self, shape: tuple[int, int], extent: tuple[float, float]) -> SurfaceScene:
        """Not possible: the model comes with the last grid."""
        raise NotImplementedError("a reflectance model lives on one grid")

    def penalty(self) -> Tensor:
        """Deviation of the log amplitude from its material's mean, over the reach of the normals.

        The bands' common change counts: it is what shading could be mistaken for. Smaller texture is free, and steps
        between materials cost nothing.
        """
        log = torch.log(AMPLITUDE[self.kind].bounded(self.amplitude)).mean(-1)
        mass = self.abundances.sum((0, 1)) + 1e-6
        mean = torch.einsum("hw,hwk->k", log.detach(), self.abundances) / mass
        deviation = blurred(log - self.abundances @ mean, NORMAL_CELLS) / TEXTURE
        return self.smooth * (torch.sqrt(1 + deviation * deviation) - 1).mean()

    @torch.no_grad()
    def samples(self, views: Sequence[View], visibility: Sequence[Tensor | None]) -> Samples:
        """What the views show of the present surface, as pi L / E; shade and what is outside weighs nothing.

        Args:
            views: the views.
            visibility: per view, ``[H, W]`` in [0, 1], or None = all lit.
        """
        height = self.height.detach()
        seen, weight, values = [], [], []
        for j, view in enumerate(views):
            east, north = self.pose[j].tolist()
            picture, shown = shown_on(view, height.cpu().numpy(), self.cell_size, (east, north))
            light = (torch.from_numpy(picture).to(height) - self.offset[j]) / (self.gain[j] * self.scale[j])
            values.append(torch.from_numpy(shown[..., 0]).to(height))
            lit = values[-1]
            v = visibility[j]
            if self.opened.numel():
                light = light - self.bounced(self.suns[j], v) * diffuse(self.kind, self.values()[0])
            seen.append(light)
            if float(view.target.max()) <= BEYOND:
                lit = lit * (torch.from_numpy(picture).to(height).amax(-1) < SATURATED)
            weight.append(lit if v is None else lit * (v > LIT))
        count = height.numel()
        return Samples(
            self.normals().detach().reshape(count, 3),
            self.abundances.reshape(count, -1),
            torch.stack(seen).reshape(len(views), count, -1),
            torch.stack(weight).reshape(len(views), count),
            list(self.suns),
            list(self.view_vectors),
            self.sky.reshape(count, -1) if self.has_sky else None,
            self.sky_share,
            torch.stack(values).reshape(len(views), count),
            self.plain if self.plain.numel() else None,
        )

    @torch.no_grad()
    def add_sky(
        self, views: Sequence[View], visibility: Sequence[Tensor | None], sky: Sky, bounce: bool = False
    ) -> None:
        """Let the sky light the ground, and find materials and amplitudes anew.

        Args:
            views: the views.
            visibility: per view, ``[H, W]`` in [0, 1], or None = all lit.
            sky: `fitted`, `auto` or its share per band, or one for all.
            bounce: so does the ground around.
        """
        bands, without = self.amplitude.shape[-1], (self.amplitude.clone(), self.endmembers.clone())
        self.sky = torch.ones_like(self.amplitude)  # until `_look_up` knows better
        self.sky_share = self.amplitude.new_tensor([0.0] if isinstance(sky, str) else sky).expand(bands).clone()
        self.opened = torch.ones_like(self.height) if bounce else torch.zeros(0)
        for _ in range(2):  # amplitudes found without the sky are too bright, and the shade beside them too dark
            whole = self._look_up(self.samples(views, visibility))
            if isinstance(sky, str):
                self._read_shade(whole, visibility)
                faint = self.sky_ratio < LEAST_RATIO or float(self.sky_share.max()) < LEAST_SHARE
                if (sky == "auto" and faint) or self.sky_ratio == 0.0:
                    self.sky, self.sky_share, self.opened = torch.zeros(0), torch.zeros(0), torch.zeros(0)
                    self.amplitude, self.endmembers = without  # as if nobody had asked
                    return
            self.solve(views, visibility, 4, amplitudes=True)

    def _read_shade(self, whole: Samples, visibility: Sequence[Tensor | None]) -> None:
        """The sky's share as deep shade shows it, taking the ground there for its material's mean."""
        told = ((whole.weight > 0).sum(0) > 0)[:, None]
        flat = self.amplitude.detach().reshape(whole.seen.shape[1:])
        usual = AMPLITUDE[self.kind].bounded(material_mean(whole.abundances, flat, told.to(flat)))
        deep = torch.stack([torch.zeros_like(self.height) if v is None else deep_shade(v) for v in visibility])
        assert whole.sky is not None  # the caller has looked up
        assert whole.shown is not None
        ratio = whole.seen / (whole.sky * diffuse(self.kind, usual)).clamp_min(1e-5)
        shape = (self.height.shape[0], self.height.shape[1])
        self.sky_share, self.sky_ratio = share_in_shade(ratio, whole.shown * deep.reshape(whole.shown.shape), shape)

    def _look_up(self, whole: Samples) -> Samples:
        """The samples with the sky's gain, for the present heights and materials."""
        amplitude, shape = self.values()
        height, normal = self.casting().detach(), self.normals().detach()
        self.sky, opened = sky_gain(
            self.kind, height, normal, self.cell_size, amplitude.detach(), shape, plain=self.plain_share()
        )
        if self.opened.numel():
            self.opened = opened
        return replace(whole, sky=self.sky.reshape(whole.normal.shape[0], -1), share=self.sky_share)

    @torch.no_grad()
    def solve(
        self,
        views: Sequence[View],
        visibility: Sequence[Tensor | None],
        rounds: int,
        amplitudes: bool,
    ) -> tuple[Samples, Solution]:
        """Find the endmembers anew, from `SAMPLES` cells, and the amplitudes of all cells if asked for.

        Args:
            views: the views.
            visibility: per view, ``[H, W]`` in [0, 1], or None = all lit.
            rounds: number of Gauss-Newton steps.
            amplitudes: find them, too.
        """
        whole = self.samples(views, visibility)
        if self.has_sky:
            whole = self._look_up(whole)
        usable = torch.nonzero((whole.weight > 0).sum(0) >= 2)[:, 0]
        if len(usable) == 0:
            usable = torch.arange(whole.normal.shape[0])
        order = torch.randperm(len(usable), generator=torch.Generator().manual_seed(0))[:SAMPLES]
        solution = invert(self.kind, whole.subset(usable[order]), self.endmembers, rounds, INDEPENDENT)
        self.endmembers.copy_(solution.endmembers)
        if amplitudes:
            amplitude, _ = solve_amplitudes(self.kind, whole, self.endmembers, rounds=4)
            # what no view shows in the sun is taken for its material: were the shade a false one, of a blunder in the
            # prior, any other start would make the patch an outlier that the loss never looks at again
            told = ((whole.weight > 0).sum(0) > 0)[:, None]
            amplitude = torch.where(told, amplitude, material_mean(whole.abundances, amplitude, told.to(amplitude)))
            self.amplitude.copy_(amplitude.reshape(self.amplitude.shape))
        return whole, solution

    def refresh(self, views: Sequence[View], visibility: Sequence[Tensor | None]) -> None:
        """The endmembers for the present heights.

        Args:
            views: the views.
            visibility: per view, ``[H, W]`` in [0, 1], or None = all lit.
        """
        self.solve(views, visibility, 2, amplitudes=False)

    @torch.no_grad()
    def finish(self, views: Sequence[View], visibility: Sequence[Tensor | None]) -> dict[str, Tensor]:
        """Endmembers for the final heights; the albedo becomes the reflectance at standard geometry.

        The amplitudes stay those of gradient descent, which undoes the blur of the images, but for what they must move
        along with the endmembers, and for what an error of the slope explains better.

        Args:
            views: the views.
            visibility: per view, ``[H, W]`` in [0, 1], or None = all lit.

        Returns:
            Standard deviation of every parameter, by name.
        """
        before, sky = self.endmembers.clone(), self.sky
        whole, solution = self.solve(views, visibility, 4, amplitudes=False)
        flat = self.amplitude.reshape(whole.normal.shape[0], -1)
        earlier = replace(whole, sky=sky.reshape(flat.shape)) if self.has_sky else whole
        old, new = (
            solve_amplitudes(self.kind, s, endmembers, flat, rounds=1)[0]
            for s, endmembers in ((earlier, before), (whole, self.endmembers))
        )
        amplitude, normal = told_apart(self.kind, whole, flat + new - old, self.endmembers, self.frozen is None)
        self.amplitude.copy_(amplitude.reshape(self.amplitude.shape))
        self.frozen = normal.reshape(*self.height.shape, 3)
        whole = replace(whole, normal=normal)
        self.identifiable = self.abundances @ known_share(self.kind, solution).to(self.abundances)
        self.correlation = shape_correlation(solution, whole.plain)
        std = parameter_std(self.kind, whole, amplitude, solution)
        self.albedo = standard_reflectance(self)
        rows, cols = self.height.shape
        return {name: t.reshape(rows, cols, *t.shape[1:]) for name, t in std.items()}


def standard_reflectance(scene: ReflectiveScene) -> Tensor:
    """BRF ``[H, W, C]`` of level ground seen from above, the sun `STANDARD_SUN_DEG` from the vertical."""
    return level_reflectance(scene.kind, *scene.values(), plain=scene.plain_share())


def level_reflectance(
    kind: Kind, amplitude: Tensor, shape: tuple[Tensor, Tensor, Tensor], *, plain: Tensor | None = None
) -> Tensor:
    """`standard_reflectance` ``[H, W, C]`` of an amplitude ``[H, W, C]`` and shape parameters ``[H, W]``.

    Args:
        kind: model.
        amplitude: w or rho0.
        shape: in their own units.
        plain: share ``[H, W]`` of the ground that reflects as Lambert's law has it, or None.
    """
    up = amplitude.new_tensor([0.0, 0.0, 1.0])
    tilt = math.radians(STANDARD_SUN_DEG)
    sun = amplitude.new_tensor([math.sin(tilt), 0.0, math.cos(tilt)])
    level = up.expand(*amplitude.shape[:-1], 3)
    return radiance_factor(kind, level, sun, up, amplitude, shape, plain=plain) / math.cos(tilt)


def restored(
    tensors: Mapping[str, Tensor], kind: Kind, cell_size: float, smooth: float, absolute: bool
) -> ReflectiveScene:
    """A scene from its own `ReflectiveScene.tensors`; others are left out.

    Args:
        tensors: by name.
        kind: reflectance model.
        cell_size: edge of a cell [m].
        smooth: weight of the amplitudes' smoothness.
        absolute: whether the images are reflectances.
    """
    names = {f.name for f in fields(ReflectiveScene)}
    own = {name: t.clone() for name, t in tensors.items() if name in names}
    return ReflectiveScene(**own, kind=kind, cell_size=cell_size, smooth=smooth, absolute=absolute)


__all__ = ["LIT", "STANDARD_SUN_DEG", "ReflectiveScene", "Sky", "level_reflectance", "restored", "standard_reflectance"]
