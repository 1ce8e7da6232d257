"""LPIPS: its arithmetic with weights of chance, since its own cannot be shipped."""

import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from safetensors.torch import save_file

from sattools.compare.metrics import image_errors, image_geometric_average
from sattools.compare.perceptual import LAYERS, distance, expected_shapes, lpips, read_weights
from sattools.errors import InputError


def random_weights(seed: int = 0) -> dict[str, torch.Tensor]:
    generator = torch.Generator().manual_seed(seed)
    weights = {name: 0.05 * torch.randn(shape, generator=generator) for name, shape in expected_shapes().items()}
    return {name: t.abs() if name.startswith("lin") else t for name, t in weights.items()}


def as_published(weights: dict[str, torch.Tensor]) -> tuple[dict[str, torch.Tensor], dict[str, torch.Tensor]]:
    """In the names of torchvision's AlexNet, with a layer that nobody needs, and of the package lpips."""
    own = {name: t for name, t in weights.items() if name.startswith("features")}
    differences = {
        name.replace(".weight", ".model.1.weight"): t for name, t in weights.items() if name.startswith("lin")
    }
    return {**own, "classifier.6.bias": torch.zeros(1000)}, differences


def images(seed: int = 1, size: int = 64) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    image = rng.uniform(0.2, 0.8, (3, size, size))
    return image, np.clip(image + rng.normal(0, 0.1, image.shape), 0, 1)


@pytest.fixture(scope="module")
def files(tmp_path_factory: pytest.TempPathFactory) -> list[str]:
    paths = [str(tmp_path_factory.mktemp("weights") / name) for name in ("alexnet.safetensors", "lpips.safetensors")]
    for path, tensors in zip(paths, as_published(random_weights()), strict=True):
        save_file(tensors, path)
    return paths


def test_the_distance_is_that_of_modules_put_together_by_the_book(files: Any) -> None:
    """Convolution, relu and pooling as torchvision stacks them; Zhang et al.'s equation 1 written out."""
    weights = random_weights()
    layers: list[torch.nn.Module] = []
    for number, ((out, into, kernel, _), stride, padding, pooled) in LAYERS.items():
        layers += [torch.nn.MaxPool2d(3, 2)] if pooled else []
        conv = torch.nn.Conv2d(into, out, kernel, stride, padding)
        conv.load_state_dict({part: weights[f"features.{number}.{part}"] for part in ("weight", "bias")})
        assert len(layers) == number  # the very place in torchvision's list
        layers += [conv, torch.nn.ReLU()]
    one, other = images()
    expected = 0.0
    with torch.no_grad():
        features: list[list[np.ndarray]] = []
        for image in (one, other):
            scaled = 2 * torch.from_numpy(image).float() - 1
            x = (scaled.permute(1, 2, 0) - torch.tensor([-0.030, -0.088, -0.188])) / torch.tensor([0.458, 0.448, 0.450])
            x, own = x.permute(2, 0, 1)[None], []
            for layer in layers:
                x = layer(x)
                if isinstance(layer, torch.nn.ReLU):
                    own.append(x[0].double().numpy())
            features.append(own)
    for k, (a, b) in enumerate(zip(*features, strict=True)):
        unit = [f / (np.sqrt((f**2).sum(0)) + 1e-10) for f in (a, b)]
        lin = weights[f"lin{k}.weight"].double().numpy()[0, :, 0, 0]
        expected += float(np.einsum("c,chw->hw", lin, (unit[0] - unit[1]) ** 2).mean())
    found = lpips(one, other, weights=files)
    assert expected > 0.01
    assert found == pytest.approx(expected, rel=1e-4)  # single precision against double


def test_the_package_lpips_says_the_same(files: Any) -> None:
    package = pytest.importorskip("lpips")
    import warnings

    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # torchvision's about its own arguments
        model = package.LPIPS(net="alex", pretrained=False, pnet_rand=True, verbose=False).eval()
    weights = random_weights()
    state = model.state_dict()
    for name in state:
        number = name.split(".")
        if number[0] == "net":
            state[name] = weights[f"features.{number[2]}.{number[3]}"]
        elif number[0].startswith("lin"):
            state[name] = weights[f"lin{re.search(r'[0-9]', name)[0]}.weight"]
    model.load_state_dict(state)
    one, other = images()
    pair = [torch.from_numpy(i).float()[None] * 2 - 1 for i in (one, other)]
    with torch.no_grad():
        assert lpips(one, other, weights=files) == pytest.approx(float(model(*pair)), rel=1e-5)


def test_equal_images_are_at_no_distance_and_the_peak_does_not_matter(files: Any) -> None:
    one, other = images()
    assert lpips(one, one, weights=files) == 0.0
    assert lpips(100 * one, 100 * other, 100.0, files) == pytest.approx(lpips(one, other, weights=files), rel=1e-4)


def test_it_is_none_where_it_means_nothing(files: Any) -> None:
    one, other = images()
    assert lpips(one[:1], other[:1], weights=files) is None
    assert lpips(one[:, :30], other[:, :30], weights=files) is None
    assert lpips(one[:, :31], other[:, :31], weights=files) is not None


def test_avg_is_known_with_the_weights(files: Any) -> None:
    one, other = images()
    figures = image_errors(other, one, weights=files)
    terms = 10 ** (-figures["psnr"] / 10), (1 - figures["ssim"]) ** 0.5, figures["lpips"]
    assert figures["avg"] == pytest.approx(sum(terms) / 3)
    assert figures["avg_geometric"] == pytest.approx(np.prod(terms) ** (1 / 3))
    assert image_geometric_average(20.0, 0.75, None) is None


def test_gradients_reach_the_image() -> None:
    weights = {name: t.double() for name, t in random_weights().items()}
    one, other = (torch.from_numpy(i)[None] for i in images(size=31))
    one.requires_grad_(True)
    (slope,) = torch.autograd.grad(distance(one, other, weights).sum(), one)
    step = torch.zeros_like(one)
    step[0, 1, 15, 15] = 1e-5
    with torch.no_grad():
        numeric = (distance(one + step, other, weights) - distance(one - step, other, weights)) / 2e-5
    assert float(slope[0, 1, 15, 15]) == pytest.approx(float(numeric), rel=1e-4)


@pytest.mark.parametrize(
    ("spoil", "message"),
    [
        (lambda t: t.pop("features.3.bias"), "found no features.3.bias"),
        (lambda t: t.update({"features.0.weight": torch.zeros(64, 3, 3, 3)}), r"found features.0.weight of shape \(64"),
    ],
)
def test_other_weights_are_refused(tmp_path: Path, spoil: Any, message: str) -> None:
    tensors, differences = as_published(random_weights())
    spoil(tensors)
    save_file({**tensors, **differences}, tmp_path / "w.safetensors")
    with pytest.raises(InputError, match=message):
        read_weights((str(tmp_path / "w.safetensors"),))


def test_a_file_that_holds_no_weights_is_one_line(tmp_path: Path) -> None:
    (tmp_path / "w.safetensors").write_bytes(b"nonsense")
    with pytest.raises(InputError, match="cannot be read"):
        read_weights((str(tmp_path / "w.safetensors"),))
    with pytest.raises(InputError, match="cannot be read"):
        read_weights((str(tmp_path / "none.safetensors"),))
