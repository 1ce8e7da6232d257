"""Reflectance models of the surface: endmembers, inversion, uncertainty."""
