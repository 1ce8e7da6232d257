"""Options of `sattools normalise`."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from sattools.errors import InputError
from sattools.settings import option


@dataclass(frozen=True)
class NormaliseOptions:
    """How digital numbers become linear radiance."""

    bits: int | None = option(
        None, "Significant bits of the numbers (default: the scene's, by metadata or values).", minimum=1, maximum=32
    )
    black: float = option(0.0, "Digital number of no light.", minimum=0)
    saturated: Literal["auto", "mask", "keep"] = option(
        "auto",
        "Saturated pixels: masked (NaN; `prior` looks at them all the same), or kept as lower bounds (auto: kept in "
        "8-bit tone-mapped images, where white is no saturation; masked elsewhere).",
    )
    saturation: float | None = option(
        None, "Digital number from which a pixel is saturated (default: 2^bits - 1).", minimum=0
    )
    bands: list[str] = option(
        [],
        "Band to take, by its number from 1 or its name (repeatable, in order; default: 5 3 2 = RGB of eight "
        "WorldView bands, else all).",
    )
    quantity: Literal["auto", "toa_reflectance", "reflectance_factor", "radiance", "relative"] = option(
        "auto",
        "What the result is: pi L / (E cos sun zenith), pi L / E, or DN / full scale (auto: the first that the "
        "metadata of all images allow, else relative). With --scale: what the numbers are already; radiance "
        "[W / m^2 / sr / um] becomes a reflectance.",
    )
    scale: str | None = option(
        None, "Numbers that are calibrated already: quantity per DN, a number or a fraction such as 1/10000."
    )
    offset: float = option(0.0, "Added after --scale [unit of the quantity].", minimum=-1e6)
    metadata: str | None = option(
        None, "Folder with vendor metadata (.IMD, .XML, DIM_*.XML) for the calibration.", path="folder"
    )
    gamma: float | None = option(
        None, "Undo this exponent on 8-bit tone-mapped images, linear = (DN / 255)^gamma (default: leave them).",
        minimum=0.1, maximum=10,
    )  # fmt: skip
    atmosphere: Literal["none", "dark-object", "rayleigh"] = option(
        "none",
        "What the air does is taken off reflectances, image by image: dark-object = what the darkest thousandth of a "
        "band has beyond --dark-reflectance; rayleigh = that, and divided by what air that adds so much lets through.",
    )
    dark_reflectance: float = option(
        0.01, "With --atmosphere: of the darkest ground (shade, water), pi L / (E cos sun zenith).",
        minimum=0, maximum=0.2,
    )  # fmt: skip
    match: bool = option(False, "Bring all dates to the first one by gain and offset per band (16 and 84 % quantiles).")

    def __post_init__(self) -> None:
        if self.atmosphere != "none" and self.quantity == "relative":
            raise InputError(
                f"--atmosphere {self.atmosphere}: found --quantity relative, expected a reflectance to take air off"
            )


__all__ = ["NormaliseOptions"]
