"""Adam without the compiler that nobody asks for."""

from __future__ import annotations

import inspect

import torch


class Adam(torch.optim.Adam):
    """torch's Adam, as it is where nothing is compiled.

    torch marks its methods as not to be compiled, and imports its compiler to do so: more than a second of every fit.
    What the marks are around is the same code.
    """

    add_param_group = inspect.unwrap(torch.optim.Adam.add_param_group)
    zero_grad = inspect.unwrap(torch.optim.Adam.zero_grad)
    _warned_capturable_if_run_uncaptured = True  # steps that are recorded follow one that is not
    step = torch.no_grad()(inspect.unwrap(torch.optim.Adam.step))


__all__ = ["Adam"]
