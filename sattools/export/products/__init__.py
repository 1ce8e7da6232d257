"""What `export` makes of its maps when asked to: points, contours, true orthophotos, meshes."""
