"""Scenes with known truth, made by a ray tracer that shares nothing with the renderer of the fit."""

from sattools.simulate.stage import SimulateOptions, simulate

__all__ = ["SimulateOptions", "simulate"]
