"""Losses, schedules, and the training loop."""

from sattools.callable_module import make_callable

make_callable(__name__)
