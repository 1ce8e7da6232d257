"""Surfaces, their materials and fields of rays, fitted to the images of a scene at once or in tiles."""
