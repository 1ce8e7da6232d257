"""Scenes with known truth, made by a ray tracer that shares nothing with the renderer of the fit."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from sattools.simulate.options import SimulateOptions

if TYPE_CHECKING:
    from sattools.simulate.stage import simulate, world_of


def __getattr__(name: str) -> Any:
    # imported when used: the command's help needs the options alone
    if name in ("simulate", "world_of"):
        from sattools.simulate import stage

        return getattr(stage, name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


__all__ = ["SimulateOptions", "simulate", "world_of"]
