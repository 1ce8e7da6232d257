"""The suite's own neural field: every column may choose between heights; small grids and a network shade it."""

from __future__ import annotations

import math

import torch
from torch import Tensor, nn
from torch.nn.functional import grid_sample, pad, relu

from sattools.field.protocol import Box
from sattools.field.surface_base import SurfaceBase, before_sigmoid

REACH = 6  # cells within which a column finds its low and its high height
OUTLIERS = 0.05  # share of the heights around it that are lower than its low one, and higher than its high one
BLOCK = 64  # rows whose surroundings are searched at once
LEAST_STEP_M = 0.25  # between two heights of a column; below it a share means nothing
START = 4.0  # logit of what the prior says is there, and the negative one of what it says is not
SHADES_M = (8.0, 4.0, 2.0)  # cells of the grids that a network turns into shades
FEATURES, HIDDEN = 4, 16  # per grid; of the network
STAY, EDGES, LIFT = 1e-3, 1e-3, 1e-3  # in the penalty: a changed mind, the length of edges, lifted heights
# steps of Adam: logits of shares, metres, logits of colours, features, weights
RATES = {"presence": 0.1, "lift": 0.01, "colour": 0.02}
RATES |= {f"grid.{k}": 0.01 for k in range(len(SHADES_M))}
RATES |= {f"{layer}.{part}": 1e-3 for layer in ("hidden", "shade") for part in ("weight", "bias")}
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

    A colour is the mean of the colours of the three heights, by their parts of the density, plus a shade: features of
    grids of several cell sizes through a small network (as Müller et al. 2022, "Instant neural graphics primitives",
    dense grids in place of hashed ones), so that a wall can have colours of its own.

    Args:
        box: the part of space.
        base: the surface it starts from; its grid is that of the columns.
        seed: of the features and the network's weights.
    """

    heads = frozenset({"albedo"})

    def __init__(self, box: Box, base: SurfaceBase, seed: int = 0) -> None:
        self.box, self.base, self.bands = box, base, base.colour.shape[-1]
        self.heights, colours = columns(base.height, base.colour)
        steps = self.heights.diff(dim=0).clamp_min(LEAST_STEP_M)
        # density times the part's length is ln 2 there
        self.half = torch.log(base.softness * math.log(2) / steps)
        start = START * torch.ones_like(self.half)
        start[0] -= self.half[0]  # solid, not just there
        start[1] *= -1
        self.start = torch.sigmoid(start)
        self.presence, self.lift = start, torch.zeros_like(self.heights)
        self.colour = before_sigmoid(colours, 0.0, 1.0).permute(0, 3, 1, 2).flatten(0, 1).contiguous()
        random = torch.Generator().manual_seed(seed)
        size = [(high - low) for low, high in zip(box.low, box.high, strict=True)][::-1]
        self.grids = [
            1e-2 * torch.randn(FEATURES, *(math.ceil(edge / cell) + 1 for edge in size), generator=random).to(self.half)
            for cell in SHADES_M
        ]
        self.hidden, self.shade = nn.Linear(FEATURES * len(SHADES_M), HIDDEN), nn.Linear(HIDDEN, self.bands)
        bound = self.hidden.in_features**-0.5
        with torch.no_grad():
            self.hidden.weight.copy_((2 * torch.rand(self.hidden.weight.shape, generator=random) - 1) * bound)
            for zero in (self.hidden.bias, self.shade.weight, self.shade.bias):
                zero.zero_()
        for layer in (self.hidden, self.shade):
            layer.to(self.half)

    def density(self, points: Tensor) -> tuple[Tensor, Tensor]:
        """See `Field.density` [1/m] at points [m]; features: the point [m] and the parts of the three heights."""
        read = self._over(torch.cat([self.heights + self.lift, self.presence, self.half]), points)
        share = torch.sigmoid(read[3:5] + read[5:7])
        low, own, high = torch.sigmoid((read[:3] - points[:, 2]) / self.base.softness)
        lower, upper = share[0], share[0] * share[1]
        parts = torch.stack([low * (1 - lower), own * (lower - upper), high * upper])
        total = parts.sum(dim=0)
        return total / self.base.softness, torch.cat([points, (parts / total.clamp_min(1e-12)).T], dim=1)

    def look(self, features: Tensor, sun: Tensor | None, embedding: Tensor | None) -> dict[str, Tensor]:
        """See `Field.look`: colours."""
        points, parts = features[:, :3], features[:, 3:]
        raw = (self._over(self.colour, points).reshape(3, self.bands, -1) * parts.T[:, None]).sum(dim=0).T
        codes = torch.cat([self._within(grid, points) for grid in self.grids]).T
        return {"albedo": torch.sigmoid(raw + self.shade(relu(self.hidden(codes))))}

    def choices(self, points: Tensor) -> Tensor:
        """The three heights ``[3, N]`` [m] over or under points ``[N, 3]`` [m], in ascending order at the start."""
        return self._over(self.heights + self.lift, points)

    def _over(self, maps: Tensor, points: Tensor) -> Tensor:
        """Values ``[K, N]`` of maps ``[K, H, W]`` over or under points; rows run south, the box ends at cells' edges."""
        where = self.box.scaled(points)[:, :2] * points.new_tensor([1.0, -1.0])
        return grid_sample(maps[None], where[None, None], padding_mode="border", align_corners=False)[0, :, 0]

    def _within(self, grid: Tensor, points: Tensor) -> Tensor:
        """Values ``[K, N]`` of a grid ``[K, D, H, W]`` at points; its outermost values lie on the box."""
        where = self.box.scaled(points) * points.new_tensor([1.0, -1.0, 1.0])
        read = grid_sample(grid[None], where[None, None, None], padding_mode="border", align_corners=True)
        return read[0, :, 0, 0]

    def penalty(self) -> Tensor:
        """What an unfounded change costs, unitless."""
        present = torch.sigmoid(self.presence)
        edges, rough = (m.diff(dim=1).abs().mean() + m.diff(dim=2).abs().mean() for m in (present, self.lift))
        stay = (present - self.start).abs().mean()
        return STAY * stay + EDGES * edges + LIFT * (rough + self.lift.abs().mean())

    def named_tensors(self) -> dict[str, Tensor]:
        """Logits of shares and colours, metres of lift, features and weights."""
        named = {"presence": self.presence, "lift": self.lift, "colour": self.colour}
        named |= {f"grid.{k}": grid for k, grid in enumerate(self.grids)}
        for name, layer in (("hidden", self.hidden), ("shade", self.shade)):
            named |= {f"{name}.{part}": tensor for part, tensor in layer.named_parameters()}
        return named


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
            value, where = around.kthvalue(rank, dim=2)
            row, col = (down + where // size - REACH), (across + where % size - REACH)
            heights[layer, part] = value
            colours[layer, part] = colour[row.clamp(0, rows - 1), col.clamp(0, cols - 1)]
    # the height of a lonely peak or pit is beyond those around it
    for layer, beyond in ((0, heights[0] > height), (2, heights[2] < height)):
        heights[layer] = torch.where(beyond, height, heights[layer])
        colours[layer] = torch.where(beyond[..., None], colour, colours[layer])
    return heights, colours


__all__ = ["EPSILON", "RATES", "NeuralField", "columns"]
