"""Light on the surface: learned sun visibility with shadow regularisation, and transient objects.

The sun visibility of a cell is s = tau * s_geo (geometric shadows) or s = tau * s_net (learned ones), see
`sattools.fit.surface.scene`. s_net comes from features of the cell and the sun's direction, so that it can be softer
and lighter than a geometric shadow; the regularisation ties it to what the heights would cast.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor
from torch.nn.functional import grid_sample

from sattools.fit.adam import Adam
from sattools.fit.options import FitOptions

FEATURES, HIDDEN = 8, 32
START_LOGIT = 2.0  # s_net begins at 0.88: mostly lit
RATES = {"features": 0.05, "net": 0.02, "transient": 0.02}
WEIGHT_RAW, WEIGHT_PLAIN = 0.01, 0.0005  # of the regularisation, with raw-* losses and with the others
FOLLOW_STEPS = 600
FIRST_EPOCH = 2  # counted from 1; before, the heights say little about shadows
WARM_UP_EPOCHS = 4  # after these only cells that may be shadowed are regularised
MAY_BE_SHADOWED = 0.5
TRANSIENT_COST = 0.03  # per unit of darkening, in the fit's units of loss


def shadow_weight(options: FitOptions) -> float:
    """The weight asked for, else 0.01 with a raw loss and 0.0005 with the others (HDR satellite NeRF, section 3.2)."""
    if options.shadow_weight is not None:
        return options.shadow_weight
    return WEIGHT_RAW if options.loss.startswith("raw") else WEIGHT_PLAIN


def shadow_regularisation(net: Tensor, geometric: Tensor, only_shadowed: bool, counted: Tensor | None = None) -> Tensor:
    """mean[M s_net^2 + (1 - M) (1 - s_net)^2] with M = 1 where s_geo < 0.5 (HDR satellite NeRF, eq. 9 and 10).

    Args:
        net: learned visibility in [0, 1], any shape.
        geometric: visibility by geometry, same shape; without gradient.
        only_shadowed: mean over the places with s_net <= 0.5 alone (after the warm-up); 0 if there are none.
        counted: bool, places that the mean is over; None = all.
    """
    shadowed = (geometric.detach() < 0.5).to(net.dtype)
    error = shadowed * net**2 + (1 - shadowed) * (1 - net) ** 2
    if not only_shadowed and counted is None:
        return error.mean()
    where = torch.ones_like(net) if counted is None else counted.to(net.dtype)
    if only_shadowed:
        where = where * (net.detach() <= MAY_BE_SHADOWED)
    return (error * where).sum() / where.sum().clamp_min(1)


class IlluminationModel:
    """Trainable light of all views over one grid.

    Args:
        tensors: what `start` and `state` give; leaves of the fit.
    """

    def __init__(self, tensors: dict[str, Tensor]) -> None:
        self.tensors = tensors

    @classmethod
    def start(cls, options: FitOptions, shape: tuple[int, int], views: int, device: torch.device) -> IlluminationModel:
        """Start values.

        Features ``[H, W, 8]`` and a network of 11-32-1 if shadows are learned, ``[V, H, W]`` darkening if there are
        transients.

        Args:
            options: of the fit.
            shape: (rows, columns) [cells].
            views: number of views.
            device: to compute on.
        """
        tensors: dict[str, Tensor] = {}
        random = torch.Generator().manual_seed(options.seed)
        if options.shadow == "learned":
            tensors["features"] = 0.1 * torch.randn(*shape, FEATURES, generator=random)
            for number, (rows, columns) in enumerate(((FEATURES + 3, HIDDEN), (HIDDEN, 1))):
                bound = rows**-0.5
                tensors[f"net.{number}.weight"] = bound * (2 * torch.rand(rows, columns, generator=random) - 1)
                tensors[f"net.{number}.bias"] = torch.zeros(columns) + (START_LOGIT if number else 0.0)
        if options.transient == "on":
            tensors["transient"] = torch.zeros(views, *shape)
        return cls({name: tensor.to(device) for name, tensor in tensors.items()})

    def follow(self, suns: Sequence[Sequence[float]], geometric: Sequence[Tensor], seed: int) -> None:
        """Let s_net begin at the shadows that a surface casts: `FOLLOW_STEPS` steps of `shadow_regularisation` alone.

        Args:
            suns: directions (east, north, up).
            geometric: ``[H, W]`` visibility under each of them.
            seed: of the order of the suns.
        """
        own = {name: tensor for name, tensor in self.tensors.items() if name != "transient"}
        for tensor in own.values():
            tensor.requires_grad_(True)
        adam = Adam([{"params": [tensor], "lr": self.rate(name)} for name, tensor in own.items()])
        random = torch.Generator().manual_seed(seed)
        for step in range(FOLLOW_STEPS):
            j = int(torch.randint(len(suns), (1,), generator=random))
            for group, name in zip(adam.param_groups, own, strict=True):
                group["lr"] = self.rate(name) * (1 - step / FOLLOW_STEPS)
            adam.zero_grad(set_to_none=True)
            shadow_regularisation(self.net(suns[j]), geometric[j], only_shadowed=False).backward()
            adam.step()
        for tensor in own.values():
            tensor.requires_grad_(False)

    @property
    def learned(self) -> bool:
        """Whether the sun visibility is learned."""
        return "features" in self.tensors

    def rate(self, name: str) -> float:
        """Adam step of a tensor."""
        return RATES[name.split(".")[0]]

    def net(self, sun: Sequence[float]) -> Tensor:
        """s_net ``[H, W]`` in [0, 1] for a sun (east, north, up)."""
        t = self.tensors
        direction = torch.tensor(list(sun), dtype=t["features"].dtype, device=t["features"].device)
        weight = t["net.0.weight"]
        hidden = t["features"] @ weight[:FEATURES] + (direction @ weight[FEATURES:] + t["net.0.bias"])
        return torch.sigmoid(torch.relu(hidden) @ t["net.1.weight"] + t["net.1.bias"])[..., 0]

    def transmission(self, view: int) -> Tensor | None:
        """Tau ``[H, W]`` in [0, 1] of one view; None without transients."""
        return 1 - self.tensors["transient"][view] if "transient" in self.tensors else None

    def visibility(self, view: int, sun: Sequence[float] | None, geometric: Tensor | None) -> Tensor | None:
        """S = tau * (s_net or s_geo) ``[H, W]``; None = all lit.

        Args:
            view: its index.
            sun: unit vector (east, north, up), or None.
            geometric: ``[H, W]`` cast by the heights, in [0, 1], or None.
        """
        s = self.net(sun) if self.learned and sun is not None else geometric
        tau = self.transmission(view)
        if tau is None:
            return s
        return tau if s is None else tau * s

    def cost(
        self,
        view: int,
        sun: Sequence[float] | None,
        geometric: Tensor | None,
        epoch: int,
        options: FitOptions,
        scale: float,
    ) -> Tensor | None:
        """What one view's light costs, None if nothing; epochs counted from 1.

        The weight of the shadow regularisation is meant beside the paper's photometric loss, of which the fit takes
        the ``scale`` squared as its unit.

        Args:
            view: its index.
            sun: unit vector (east, north, up), or None.
            geometric: ``[H, W]`` cast by the heights, in [0, 1], or None.
            epoch: counted from 1.
            options: of the fit.
            scale: unit of the photometric loss.
        """
        total = None
        weight = shadow_weight(options)
        if self.learned and weight > 0 and epoch >= FIRST_EPOCH and sun is not None and geometric is not None:
            warm = epoch <= FIRST_EPOCH + WARM_UP_EPOCHS
            total = weight / scale**2 * shadow_regularisation(self.net(sun), geometric, only_shadowed=not warm)
        if "transient" in self.tensors:
            sparse = TRANSIENT_COST * self.tensors["transient"][view].mean()
            total = sparse if total is None else total + sparse
        return total

    @torch.no_grad()
    def clamp(self) -> None:
        """Keep tau within [0, 1] after a step."""
        if "transient" in self.tensors:
            self.tensors["transient"].clamp_(0, 1)

    @torch.no_grad()
    def maps(self, suns: Sequence[Sequence[float] | None]) -> dict[str, Tensor]:
        """What the model file keeps: shares of light ``s_net``, ``tau`` ``[V, H, W]``; NaN where a sun is unknown."""
        model_maps = {}
        if self.learned:
            unknown = torch.full(self.tensors["features"].shape[:2], torch.nan)
            model_maps["s_net"] = torch.stack([unknown if sun is None else self.net(sun).cpu() for sun in suns])
        if "transient" in self.tensors:
            model_maps["tau"] = 1 - self.tensors["transient"].detach().cpu()
        return model_maps

    @torch.no_grad()
    def resized(self, shape: tuple[int, int], ratio: float) -> IlluminationModel:
        """The light on another grid with the same upper left corner; ``ratio`` = new cell over old."""
        tensors = {name: tensor.detach().clone() for name, tensor in self.tensors.items()}
        for name in ("features", "transient"):
            if name in tensors:
                maps = tensors[name].permute(2, 0, 1) if name == "features" else tensors[name]
                finer = _resample(maps, shape, ratio)
                tensors[name] = (finer.permute(1, 2, 0) if name == "features" else finer).contiguous()
        return IlluminationModel(tensors)


def _resample(maps: Tensor, shape: tuple[int, int], ratio: float) -> Tensor:
    """Maps ``[C, H, W]`` on another grid with the same upper left corner, bilinear."""
    rows, cols = shape
    old_rows, old_cols = maps.shape[1:]
    y = (torch.arange(rows) + 0.5) * ratio / old_rows * 2 - 1
    x = (torch.arange(cols) + 0.5) * ratio / old_cols * 2 - 1
    where = torch.stack([x.expand(rows, cols), y[:, None].expand(rows, cols)], dim=-1)[None].to(maps)
    return grid_sample(maps[None], where, padding_mode="border", align_corners=False)[0]


__all__ = ["FIRST_EPOCH", "WARM_UP_EPOCHS", "IlluminationModel", "shadow_regularisation", "shadow_weight"]
