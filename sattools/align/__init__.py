"""A scene is brought onto a reference: its surface, its maps and its cameras together."""

from sattools.callable_module import make_callable

make_callable(__name__)
