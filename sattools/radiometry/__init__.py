"""From digital numbers to linear radiance, tone curves, colour relations between images."""

from sattools.radiometry.linear import DEFAULT_BITS, item_bits, linear_radiance

__all__ = ["DEFAULT_BITS", "item_bits", "linear_radiance"]
