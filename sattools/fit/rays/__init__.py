"""Fields that are trained ray by ray: density grids and networks."""
