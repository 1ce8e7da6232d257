"""What has changed between two dates: heights, reflectance, volumes, and how sure that is."""

from sattools.callable_module import make_callable

make_callable(__name__)
