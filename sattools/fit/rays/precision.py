"""How a network's layers are multiplied in training, and where that is of use."""

from __future__ import annotations

import logging
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Literal

import torch

from sattools.errors import SceneError
from sattools.field.mlp import MlpField
from sattools.field.protocol import Field
from sattools.fit.options import FitOptions

log = logging.getLogger(__name__)
Precision = Literal["float32", "tf32", "bf16"]
TF32_SINCE = (8, 0)  # compute capability of the first cards with tensor cores for TF32 and bfloat16


def check_precision(options: FitOptions, device: torch.device) -> None:
    """Raise SceneError for TF32 where there is none.

    Args:
        options: of the fit.
        device: where the field is trained.
    """
    if options.precision == "tf32" and options.field == "mlp" and device.type != "cuda":
        raise SceneError(
            "--precision tf32: found a training on the CPU, which has none, expected a CUDA device (or bf16, float32)"
        )


def warn_of_precision(options: FitOptions, device: torch.device) -> None:
    """Warn of a device that multiplies no faster in the precision asked for; arguments as of `check_precision`."""
    if options.precision == "float32" or options.field != "mlp":  # of others it is told that it does nothing
        return
    if device.type == "cuda":
        if torch.cuda.get_device_capability(device) < TF32_SINCE:
            log.warning("--precision %s: this GPU has no units for it, float32 is as fast", options.precision)
    elif not _has_amx():
        log.warning("--precision bf16: found a CPU without AMX for it, where it takes longer than float32")


def _has_amx() -> bool:
    """Whether this x86 CPU has AMX for bfloat16; True for other kinds, and where PyTorch is too old to tell.

    Without it, by AVX-512's instructions for bfloat16 alone, a trunk of 256 took 1.5 times as long as in float32.
    """
    told = getattr(torch.cpu, "get_capabilities", None)
    return told is None or bool(told().get("amx_bf16", True))


@contextmanager
def multiplied(field: Field, precision: Precision) -> Iterator[None]:
    """A network whose layers are multiplied like this for a while; other fields as they are.

    Args:
        field: is float32 again afterwards, as is PyTorch.
        precision: of the products.
    """
    if precision == "float32" or not isinstance(field, MlpField):
        yield
        return
    if precision == "tf32":
        with _tf32():
            yield
        return
    field.hidden = torch.bfloat16
    try:
        yield
    finally:
        field.hidden = torch.float32


@contextmanager
def _tf32() -> Iterator[None]:
    """TF32 on GPUs for a while, whichever way the program that calls has set it before."""
    matmul = torch.backends.cuda.matmul
    if hasattr(matmul, "fp32_precision"):
        before = matmul.fp32_precision
        matmul.fp32_precision = "tf32"
        try:
            yield
        finally:
            matmul.fp32_precision = before
        return
    former = torch.get_float32_matmul_precision()  # before PyTorch 2.9
    torch.set_float32_matmul_precision("high")
    try:
        yield
    finally:
        torch.set_float32_matmul_precision(former)


__all__ = ["check_precision", "multiplied", "warn_of_precision"]
