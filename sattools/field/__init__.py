"""What is at a 3-D point: fields that are no height map, behind one protocol."""
