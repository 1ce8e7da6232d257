"""How surfaces reflect: Lambert, Rahman-Pinty-Verstraete and Hapke as functions of directions and parameters.

The models take tensors or numpy arrays and give back what they were given.
"""

from sattools.arrays import numpy_too
from sattools.reflectance import hapke as _hapke
from sattools.reflectance import lambert as _lambert
from sattools.reflectance import rpv as _rpv

hapke = numpy_too(_hapke.hapke)
lambert = numpy_too(_lambert.lambert)
rpv = numpy_too(_rpv.rpv)

__all__ = ["hapke", "lambert", "rpv"]
