"""Images of a scene resampled to its ground grid."""

from sattools.views.load import (
    BALANCE_PROPERTY,
    GROUND_SHARE,
    Opened,
    RadiometricBalance,
    Source,
    check_seen,
    load_sources,
    open_images,
    used_assets,
    views_on,
    warn_of_blank,
    with_bands,
)
from sattools.views.resample import View, line_of_sight, make_view, match_colours, read_at, shown_on

__all__ = [
    "BALANCE_PROPERTY",
    "GROUND_SHARE",
    "Opened",
    "RadiometricBalance",
    "Source",
    "View",
    "check_seen",
    "line_of_sight",
    "load_sources",
    "make_view",
    "match_colours",
    "open_images",
    "read_at",
    "shown_on",
    "used_assets",
    "views_on",
    "warn_of_blank",
    "with_bands",
]
