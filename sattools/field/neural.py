"""The suite's own fast field: every column may choose between heights, and walls have colours of their own."""

from __future__ import annotations

import math

import torch
from torch import Tensor
from torch.nn.functional import grid_sample, pad

from sattools.field.constants import constant
from sattools.field.kernels import EMPTY, LEAST, Colours, Density, runs_here
from sattools.field.penalty import Penalty, plain_penalty
from sattools.field.protocol import Box
from sattools.field.surface_base import SurfaceBase, before_sigmoid

REACH = 6  # cells within which a column finds its low and its high height
OUTLIERS = 0.05  # share of the heights around it that are lower than its low one, and higher than its high one
BLOCK = 64  # rows whose surroundings are searched at once
LEAST_STEP_M = 0.25  # between two heights of a column; below it a share means nothing
START = 4.0  # logit of what the prior says is there, and the negative one of what it says is not
SHADES_M = (4.0, 2.0, 1.0)  # cells of the grids of colours
# steps of Adam: logits of shares and of colours
RATES = {"presence": 0.1, "colour": 0.02} | {f"grid.{k}": 0.02 for k in range(len(SHADES_M))}
BEGIN = {"presence": 0.35}  # share of the training that colours have to themselves: they explain much that is no shape
HIDDEN = 1e-3  # transmittance below which a sample's colour is not asked for
EPSILON = 1e-15  # of Adam: the gradient of a share that is not there yet is very small (Müller et al. 2022, section 4)


class NeuralField:
    """Columns with three heights, the parts between them, and colours that vary along walls.

    Beside steps the heights of a surface cannot learn by small steps: a column that must become ground has to cross all
    heights between roof and ground, at which it fits no image. So each has three heights, its own in the prior and the
    low and the high one around it, and the density (1/s) ((1 - p) S(low) + (p - pq) S(own) + pq S(high)) per metre
    with S(h) = sigmoid((h - z) / s) and trainable shares p of the part between low and own, q of that between own and
    high. Transmittance lets a gradient reach what lies behind, so a roof's rim can become air. At the start p is nearly
    1 and q nearly 0: the prior's surface. The logit of a share is counted from where the part lets half of the light
    through from above. All is bilinear between the middles of cells: the step of a share from cell to cell is a wall.

    The logit of a colour is the mean of those of the three heights, by their parts of the density, and the sum of grids
    of several cell sizes in space (as the encoding of Müller et al. 2022, "Instant neural graphics primitives", dense
    instead of hashed and read as colours without a network), so that a wall can have colours of its own.

    Args:
        box: the part of space.
        base: the surface it starts from; its grid is that of the columns.
    """

    heads = frozenset({"albedo"})

    def __init__(self, box: Box, base: SurfaceBase) -> None:
        self.box, self.base, self.bands = box, base, base.colour.shape[-1]
        self.heights, colours = columns(base.height, base.colour)
        steps = self.heights.diff(dim=0).clamp_min(LEAST_STEP_M)
        self.optical = steps / base.softness  # depths of the parts where they are solid
        self.half = torch.log(math.log(2) / self.optical)
        self.presence = self._first_presence()
        # values of a place side by side in memory, as the kernels read them
        self.colour = before_sigmoid(colours, 0.0, 1.0).permute(1, 2, 0, 3).flatten(2).movedim(-1, 0)
        size = [(high - low) for low, high in zip(box.low, box.high, strict=True)][::-1]
        self.grids = [
            base.colour.new_zeros(*(math.ceil(edge / cell) + 1 for edge in size), self.bands).movedim(-1, 0)
            for cell in SHADES_M
        ]

    def _first_presence(self) -> Tensor:
        presence = START * torch.ones_like(self.half)
        presence[0] -= self.half[0]  # solid, not just there
        presence[1] *= -1
        return presence

    def density(self, points: Tensor) -> tuple[Tensor, Tensor]:
        """See `Field.density` [1/m] at points [m]; features: the point [m] and the parts of the three heights."""
        logits = self.presence + self.half
        if runs_here(points, logits):
            sigma, parts = Density.apply(logits, self.heights, points, self.box, self.base.softness)
        else:
            sigma, parts = self.plain_density(logits, points)
        return sigma, torch.cat([points, parts], dim=1)

    def plain_density(self, logits: Tensor, points: Tensor) -> tuple[Tensor, Tensor]:
        """Density ``[N]`` [1/m] and parts ``[N, 3]``: the twin of the kernel.

        Args:
            logits: ``[2, H, W]`` of the shares.
            points: ``[N, 3]`` [m].
        """
        read = self._over(torch.cat([self.heights, logits]), points)
        share = torch.sigmoid(read[3:5])
        low, own, high = torch.sigmoid((read[:3] - points[:, 2]) / self.base.softness)
        lower, upper = share[0], share[0] * share[1]
        parts = torch.stack([low * (1 - lower), own * (lower - upper), high * upper])
        parts = parts * (points[:, 2] <= read[2] + EMPTY * self.base.softness)
        total = parts.sum(dim=0)
        return total / self.base.softness, (parts / total.clamp_min(LEAST)).T

    def shown(self, features: Tensor, transmittance: Tensor) -> Tensor:
        """Features ``[N, F]``, without parts where a transmittance ``[N]`` is too small for their colours to matter."""
        seen = transmittance > HIDDEN
        return torch.cat([features[:, :3], features[:, 3:] * seen[:, None]], dim=1)

    def look(self, features: Tensor, sun: Tensor | None, embedding: Tensor | None) -> dict[str, Tensor]:
        """See `Field.look`: colours; none where there are no parts."""
        if runs_here(features.detach(), self.colour):
            return {"albedo": Colours.apply(features, self.colour, self.box, *self.grids)}
        return {"albedo": self.plain_colours(features)}

    def plain_colours(self, features: Tensor) -> Tensor:
        """Colours ``[N, C]`` of features ``[N, 6]``, unitless: the twin of the kernel."""
        points, parts = features[:, :3], features[:, 3:]
        raw = (self._over(self.colour, points).reshape(3, self.bands, -1) * parts.T[:, None]).sum(dim=0).T
        shade = torch.stack([self._within(grid, points) for grid in self.grids]).sum(dim=0).T
        return torch.sigmoid(raw + shade) * (parts.sum(dim=1, keepdim=True) > 0)

    def choices(self, points: Tensor) -> Tensor:
        """The three heights ``[3, N]`` [m] over or under points ``[N, 3]`` [m], in ascending order."""
        return self._over(self.heights, points)

    def _over(self, maps: Tensor, points: Tensor) -> Tensor:
        """Values ``[K, N]`` of maps ``[K, H, W]`` over or under points."""
        where = self.box.scaled(points)[:, :2] * constant((1.0, -1.0), points)  # rows run south
        return grid_sample(maps[None], where[None, None], padding_mode="border", align_corners=False)[0, :, 0]

    def _within(self, grid: Tensor, points: Tensor) -> Tensor:
        """Values ``[K, N]`` of a grid ``[K, D, H, W]`` at points; its outermost values lie on the box."""
        where = self.box.scaled(points) * constant((1.0, -1.0, 1.0), points)
        read = grid_sample(grid[None], where[None, None, None], padding_mode="border", align_corners=True)
        return read[0, :, 0, 0]

    def penalty(self) -> Tensor:
        """What an unfounded change costs, unitless: parts that are no more, new ones as far as they hide, edges."""
        if runs_here(self.half, self.presence) and min(self.half.shape) > 1:
            return Penalty.apply(self.presence, self.half, self.optical)
        return plain_penalty(self.presence, self.half, self.optical)

    def start_density(self) -> dict[str, Tensor]:
        """See `Field.start_density`: every column at its own height."""
        return {"presence": self._first_presence()}

    def named_tensors(self) -> dict[str, Tensor]:
        """Logits of shares and colours."""
        named = {"presence": self.presence, "colour": self.colour}
        return named | {f"grid.{k}": grid for k, grid in enumerate(self.grids)}


def columns(height: Tensor, colour: Tensor) -> tuple[Tensor, Tensor]:
    """Low, own and high height of every column, and the colours of the cells they are taken from.

    Args:
        height: ``[H, W]`` [m].
        colour: ``[H, W, C]``.

    Returns:
        ``[3, H, W]`` [m] in ascending order, ``[3, H, W, C]``.
    """
    (rows, cols), size = height.shape, 2 * REACH + 1
    padded = pad(height[None, None], (REACH,) * 4, mode="replicate")[0, 0]
    left_out = round(OUTLIERS * size**2)
    heights, colours = height.repeat(3, 1, 1), colour.repeat(3, 1, 1, 1)
    across = torch.arange(cols, device=height.device)
    for first in range(0, rows, BLOCK):
        part = slice(first, min(first + BLOCK, rows))
        around = padded[first : part.stop + 2 * REACH].unfold(0, size, 1).unfold(1, size, 1).flatten(2)
        down = torch.arange(first, part.stop, device=height.device)[:, None]
        for layer, rank in ((0, left_out + 1), (2, size**2 - left_out)):
            value = around.kthvalue(rank, dim=2, keepdim=True).values
            where = (around == value).byte().argmax(dim=2)  # the first: which one `kthvalue` finds is the device's
            row, col = (down + where // size - REACH), (across + where % size - REACH)
            heights[layer, part] = value[..., 0]
            colours[layer, part] = colour[row.clamp(0, rows - 1), col.clamp(0, cols - 1)]
    # the height of a lonely peak or pit is beyond those around it
    for layer, beyond in ((0, heights[0] > height), (2, heights[2] < height)):
        heights[layer] = torch.where(beyond, height, heights[layer])
        colours[layer] = torch.where(beyond[..., None], colour, colours[layer])
    return heights, colours


__all__ = ["BEGIN", "EPSILON", "RATES", "NeuralField", "columns"]
