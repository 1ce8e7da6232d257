"""RPC projection and localisation, rays, sun direction, tie points and bundle adjustment."""

from sattools.camera.rpc import RPC

__all__ = ["RPC"]
