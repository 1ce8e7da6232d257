"""Samples along rays, compositing, sun visibility, shading."""

from sattools.render.surface import render
from sattools.render.view import Quadrature, Rays
from sattools.render.visibility import plate_slopes, sun_visibility

__all__ = ["Quadrature", "Rays", "plate_slopes", "render", "sun_visibility"]
