"""Score surfaces, parameter maps and images against references."""

from sattools.compare.metrics import height_errors, image_errors, map_errors
from sattools.compare.registration import Registration, register
from sattools.compare.stage import CompareOptions, Comparison, compare, compare_dsm, compare_file, read_truth, table
from sattools.compare.truth import Truth, read_dfc2019, read_reference

__all__ = [
    "CompareOptions",
    "Comparison",
    "Registration",
    "Truth",
    "compare",
    "compare_dsm",
    "compare_file",
    "height_errors",
    "image_errors",
    "map_errors",
    "read_dfc2019",
    "read_reference",
    "read_truth",
    "register",
    "table",
]
