"""From digital numbers to linear radiance, tone curves, colour relations between images."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from sattools.radiometry.linear import DEFAULT_BITS, item_bits, linear_radiance


def __getattr__(name: str) -> Any:
    # imported when used: the command's help needs the options alone
    if name in __all__:
        from sattools.radiometry import linear

        return getattr(linear, name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


__all__ = ["DEFAULT_BITS", "item_bits", "linear_radiance"]
