"""Samples along rays, compositing, sun visibility, shading."""

from sattools.render.surface import render
from sattools.render.view import ParallelRays, Quadrature
from sattools.render.visibility import plate_slopes, sun_visibility

__all__ = ["ParallelRays", "Quadrature", "plate_slopes", "render", "sun_visibility"]
