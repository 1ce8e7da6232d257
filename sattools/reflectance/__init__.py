"""How surfaces reflect: Lambert, Rahman-Pinty-Verstraete and Hapke as functions of directions and parameters."""

from sattools.reflectance.hapke import hapke
from sattools.reflectance.lambert import lambert
from sattools.reflectance.rpv import rpv

__all__ = ["hapke", "lambert", "rpv"]
