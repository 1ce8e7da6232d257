"""From digital numbers to linear radiance, tone curves, colour relations between images."""
