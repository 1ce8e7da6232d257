"""Satellite images with RPC cameras to surface models and reflectance maps by differentiable rendering."""

__version__ = "0.1.0"
