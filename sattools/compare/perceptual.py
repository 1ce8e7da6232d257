"""LPIPS, the perceptual distance of two images (Zhang et al. 2018, arXiv:1801.03924), with weights from the disk.

The network is AlexNet up to its fifth layer (Krizhevsky 2014, arXiv:1404.5997) in the layout of torchvision, the
weights of the five differences those of the `lpips` package, version 0.1. Nothing is ever downloaded.
"""

from __future__ import annotations

import functools
import importlib.util
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from sattools.errors import InputError

if TYPE_CHECKING:
    from torch import Tensor

# number in torchvision's `features`: output channels, input channels, kernel; stride, padding, pooled before
LAYERS: dict[int, tuple[tuple[int, int, int, int], int, int, bool]] = {
    0: ((64, 3, 11, 11), 4, 2, False),
    3: ((192, 64, 5, 5), 1, 2, True),
    6: ((384, 192, 3, 3), 1, 1, True),
    8: ((256, 384, 3, 3), 1, 1, False),
    10: ((256, 256, 3, 3), 1, 1, False),
}
SHIFT, SCALE = (-0.030, -0.088, -0.188), (0.458, 0.448, 0.450)  # of images in [-1, 1]
TINY = 1e-10
LEAST_PX = 31  # a smaller image leaves nothing after the second pooling


def expected_shapes() -> dict[str, tuple[int, ...]]:
    """Names and shapes of all weights: ``features.0.weight`` ..., ``lin0.weight`` ... of the five differences."""
    shapes: dict[str, tuple[int, ...]] = {}
    for number, (shape, _, _, _) in LAYERS.items():
        shapes |= {f"features.{number}.weight": shape, f"features.{number}.bias": shape[:1]}
    shapes |= {f"lin{k}.weight": (1, LAYERS[n][0][0], 1, 1) for k, n in enumerate(LAYERS)}
    return shapes


def _plain_name(name: str) -> str | None:
    """A weight's name here, of one in torchvision's AlexNet or in the `lpips` package; None = not needed."""
    if match := re.fullmatch(r"(?:net\.slice\d\.|features\.)(\d+)\.(weight|bias)", name):
        return f"features.{match[1]}.{match[2]}"
    if match := re.fullmatch(r"lin(?:s\.)?(\d)\.model\.1\.weight", name):
        return f"lin{match[1]}.weight"
    return None


@functools.lru_cache(maxsize=2)
def read_weights(paths: tuple[str, ...]) -> Mapping[str, Tensor]:
    """Weights from safetensors files with the names of torchvision's AlexNet and of the `lpips` package.

    Args:
        paths: one file, or AlexNet and the differences' weights in two.

    Raises:
        InputError: unreadable, or a weight is missing or has another shape.
    """
    from safetensors import SafetensorError
    from safetensors.torch import load_file

    found: dict[str, Tensor] = {}
    for path in paths:
        try:
            tensors = load_file(path)
        except (OSError, SafetensorError) as error:
            text = " ".join(str(error).split())
            raise InputError(f"{path}: cannot be read ({text}), expected a safetensors file of weights") from None
        found |= {plain: t for name, t in tensors.items() if (plain := _plain_name(name)) is not None}
    where = ", ".join(paths)
    for name, shape in expected_shapes().items():
        if name not in found:
            raise InputError(f"{where}: found no {name}, expected the weights of AlexNet and of LPIPS's five layers")
        if tuple(found[name].shape) != shape:
            raise InputError(f"{where}: found {name} of shape {tuple(found[name].shape)}, expected {shape}")
    return {name: found[name].float() for name in expected_shapes()}


def distance(image: Tensor, reference: Tensor, weights: Mapping[str, Tensor]) -> Tensor:
    """LPIPS of two batches ``[N, 3, H, W]`` in [-1, 1], at least 31 pixels wide: ``[N]``, 0 for equal images.

    Per layer the features of unit length (over the channels) are subtracted, squared, weighted and averaged.

    Args:
        image: one batch.
        reference: the other.
        weights: of `read_weights`.
    """
    import torch
    from torch.nn.functional import conv2d, max_pool2d, relu

    count = image.shape[0]
    x = torch.cat([image, reference])
    x = (x - x.new_tensor(SHIFT)[:, None, None]) / x.new_tensor(SCALE)[:, None, None]
    total = x.new_zeros(count)
    for k, (number, (_, stride, padding, pooled)) in enumerate(LAYERS.items()):
        if pooled:
            x = max_pool2d(x, 3, 2)
        weight, bias = (weights[f"features.{number}.{part}"].to(x) for part in ("weight", "bias"))
        x = relu(conv2d(x, weight, bias, stride, padding))
        unit = x / (x.square().sum(1, keepdim=True).sqrt() + TINY)
        squares = (unit[:count] - unit[count:]).square()
        total = total + conv2d(squares, weights[f"lin{k}.weight"].to(x)).mean((1, 2, 3))
    return total


def lpips(
    image: np.ndarray, reference: np.ndarray, peak: float = 1.0, weights: Sequence[str | Path] = ()
) -> float | None:
    """LPIPS (AlexNet) of two images ``[3, H, W]`` in [0, peak]; None of other images, or without weights on the disk.

    Without `weights` those are taken that the package `lpips` and torch's hub cache hold, where both are there.

    Args:
        image: ``[3, H, W]`` in [0, peak].
        reference: ``[3, H, W]`` in [0, peak].
        peak: largest value.
        weights: files for `read_weights`.

    Raises:
        InputError: files that hold no such weights.
    """
    if image.shape[0] != 3 or min(image.shape[1:]) < LEAST_PX:
        return None
    import torch

    one, other = (torch.from_numpy(np.asarray(array) / peak * 2 - 1).float()[None] for array in (image, reference))
    with torch.no_grad():
        if weights:
            return float(distance(one, other, read_weights(tuple(map(str, weights)))))
        if importlib.util.find_spec("lpips") is None:
            return None
        if not any((Path(torch.hub.get_dir()) / "checkpoints").glob("alexnet-*.pth")):
            return None
        import lpips as package

        return float(package.LPIPS(net="alex", verbose=False)(one, other))


__all__ = ["distance", "expected_shapes", "lpips", "read_weights"]
