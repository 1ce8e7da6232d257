"""numpy in, numpy out for functions of tensors."""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any, TypeVar

import numpy as np
import torch

F = TypeVar("F", bound=Callable[..., Any])


def numpy_too(model: F) -> F:
    """A function of tensors that takes numpy arrays as well; without any tensor among them it returns an array.

    Integers become float64, as numpy has it.
    """

    @functools.wraps(model)
    def call(*arguments: Any, **options: Any) -> Any:
        given = (*arguments, *options.values())
        if not any(isinstance(value, np.ndarray) for value in given):
            return model(*arguments, **options)
        result = model(*map(_tensor, arguments), **{name: _tensor(value) for name, value in options.items()})
        return result if any(isinstance(value, torch.Tensor) for value in given) else result.numpy()

    return call  # type: ignore[return-value]


def _tensor(value: Any) -> Any:
    if not isinstance(value, np.ndarray):
        return value
    kind = value.dtype if value.dtype in (np.float32, np.float64) else np.float64
    return torch.from_numpy(np.array(value, kind))


__all__ = ["numpy_too"]
