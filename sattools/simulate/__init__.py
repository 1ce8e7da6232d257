"""Scenes with known truth, made by a ray tracer that shares nothing with the renderer of the fit."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from sattools.simulate.options import SimulateOptions

if TYPE_CHECKING:
    from sattools.simulate.stage import simulate


def __getattr__(name: str) -> Any:
    # imported when used: the command's help needs the options alone
    if name == "simulate":
        from sattools.simulate.stage import simulate

        return simulate
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


__all__ = ["SimulateOptions", "simulate"]
