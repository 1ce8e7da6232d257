"""A rough surface by multi-view matching in ground geometry."""

from sattools.prior.options import PriorOptions

__all__ = ["PriorOptions"]
