"""Fitted scene to georeferenced products."""

from sattools.callable_module import make_callable

make_callable(__name__)
