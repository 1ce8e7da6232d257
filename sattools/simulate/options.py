"""Options of `sattools simulate`."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Literal

from sattools.errors import InputError
from sattools.settings import option

CITY = {"size": 128.0, "views": 12, "gsd": 0.5, "off_nadir": 26.0, "bits": 11, "bias_px": 0.0, "cars": 0}
# the same with cameras as they are delivered (one view is off by five to twelve times as much) and traffic
DOWNTOWN = {**CITY, "bias_px": 3.0, "cars": 40}
NATURAL = {"size": 512.0, "views": 21, "gsd": 2.0, "off_nadir": 45.0, "bits": 12, "bias_px": 0.0, "cars": 0}


@dataclass
class SimulateOptions:
    """Options of `sattools simulate`."""

    id: str = option("SIM_001", "Name of the scene.")
    out: str = option(".", "Folder in which the scene's own folder is made.", path="new folder")
    terrain: Literal["city", "downtown", "natural"] = option(
        "city",
        "What is built: city (streets, houses, courtyards, a tower), downtown (towers of 50 to 150 m, narrow streets, "
        "roofs of all shapes, porous trees, a canal; facades, mirrors, seasons, haze, also with --dsm), or natural "
        "(relief with geological units).",
    )
    dsm: str | None = option(None, "Surface to take instead: the middle of this DSM, --size wide.", path="file")
    classes: str | None = option(
        None, "Class map of --dsm on the same grid: 2 ground, 5 trees, 6 building, 9 water.", path="file"
    )
    size: float = option(None, "Edge of the square scene [m] (default: 128; natural 512).", minimum=32, maximum=1024)
    views: int = option(None, "Number of images (default: 12; natural 21, in one pass).", minimum=1, maximum=200)
    dates: int = option(6, "Number of dates over which they are spread.", minimum=1, maximum=200)
    test_views: int = option(0, "How many of them are held out (role test).", minimum=0)
    gsd: float = option(
        None, "Edge of a pixel across the line of sight [m] (default: 0.5; natural 2).", minimum=0.1, maximum=10
    )
    off_nadir: float = option(
        None, "Largest off-nadir angle [degrees] (default: 26; natural 45).", minimum=0, maximum=60
    )
    bias_px: float = option(
        None,
        "Error of the RPCs in the images' tags, radius per view [px] (default: 0; downtown 3, and one view 5 to 12 "
        "times as much).",
        minimum=0,
    )
    noise: float = option(1.0, "Sensor noise relative to a usual one.", minimum=0)
    bits: int = option(
        None,
        "11: linear numbers in 16-bit files; 8: tone-mapped (default: 11; natural always 12).",
        minimum=8,
        maximum=12,
    )
    trees: bool = option(True, "Plant trees.")
    cars: int = option(
        None,
        "Cars on the streets, elsewhere in every image; not in the truth (default: 0; downtown 40).",
        minimum=0,
        maximum=2000,
    )
    clouds: float = option(
        0.0,
        "Share of the sky under clouds on every other date, other ones in every image; not over natural ground.",
        minimum=0,
        maximum=0.95,
    )
    pan: int | None = option(
        None,
        "Panchromatic images, and beside them in colours/ what a multispectral sensor with so many times larger pixels "
        "sees at the same moment; not of natural ground.",
        minimum=2,
        maximum=8,
    )
    hdr: bool = option(False, "Deep shadows, white roofs, and dates whose light differs by a factor of up to 2.3.")
    lon: float = option(-81.66, "Longitude of the city [degrees].", minimum=-180, maximum=180)
    lat: float = option(30.35, "Latitude of the city [degrees].", minimum=-60, maximum=60)
    reflectance: Literal["lambert", "rpv", "hapke"] = option("hapke", "Reflectance model of natural ground.")
    units: int = option(5, "Geological units of natural ground.", minimum=1, maximum=6)
    plain_units: int = option(
        0, "Units, of those, that reflect as Lambert's law has it, whatever the others' model.", minimum=0, maximum=6
    )
    slope: float = option(15.0, "Mean slope of the fractal relief of natural ground [degrees].", minimum=0, maximum=60)
    sun_azimuth: float = option(135.0, "Sun over natural ground, from north [degrees].", minimum=0, maximum=360)
    sun_elevation: float = option(48.0, "Sun over natural ground, above the horizon [degrees].", minimum=2, maximum=90)
    passes: int = option(
        1,
        "Passes over natural ground at one time of day, spread over the year; the views take turns. The first has the "
        "sun given, the others the sun of their days.",
        minimum=1,
        maximum=12,
    )
    sky: float = option(
        0.0,
        "Sky light on natural ground: irradiance of level ground in green over that of the sun across its beam (red "
        "has 0.75, blue 1.3 times as much).",
        minimum=0,
        maximum=1,
    )
    train: int = option(
        7, "Most nadir views of natural ground that are for training; the others are held out.", minimum=2
    )
    seed: int = option(0, "Seed of everything that is drawn.", minimum=0)

    def __post_init__(self) -> None:
        usual: dict[str, float] = {"city": CITY, "downtown": DOWNTOWN, "natural": NATURAL}[self.terrain]
        if self.dsm is not None:
            usual = {**usual, "cars": 0}  # a given surface has no streets
        for name, value in usual.items():
            if getattr(self, name) is None:
                setattr(self, name, value)
        if self.pan and self.terrain == "natural":
            raise InputError("--pan: found natural ground, expected a city")
        if self.cars and self.dsm is not None and self.terrain != "natural":
            raise InputError("--cars: found --dsm, expected none: a given surface has no streets")
        if self.passes > 1 and self.terrain != "natural":
            raise InputError(f"--passes: found --terrain {self.terrain}, expected natural (a city has --dates)")
        if self.terrain == "natural":
            if self.plain_units > self.units:
                raise InputError(f"--plain-units: found {self.plain_units}, expected at most --units, {self.units}")
            self.bits = 12
        elif self.bits not in (8, 11):
            raise InputError(f"--bits: found {self.bits}, expected 8 or 11 for a city")


NATURAL_ONLY = ("reflectance", "units", "plain_units", "slope", "sun_azimuth", "sun_elevation", "sky", "train")
TOWN_ONLY = ("dates", "test_views", "bits", "trees", "cars", "clouds", "hdr", "classes")
WITHOUT_DSM_ONLY = ("lon", "lat", "slope", "trees")


def without_effect(options: SimulateOptions, given: Iterable[str]) -> dict[str, str]:
    """Those of some options that do nothing beside the others, each with what was found and expected.

    Args:
        options: of the simulation.
        given: names of options that the user gave.
    """
    natural, found = options.terrain == "natural", f"found --terrain {options.terrain}, expected"
    idle = dict.fromkeys(TOWN_ONLY, f"{found} city or downtown") if natural else {}
    idle |= {} if natural else dict.fromkeys(NATURAL_ONLY, f"{found} natural")
    if natural and options.reflectance == "lambert":
        idle["plain_units"] = "found --reflectance lambert, expected rpv or hapke"
    if options.dsm is not None:
        idle = dict.fromkeys(WITHOUT_DSM_ONLY, "found --dsm, expected none") | idle
    elif not natural:
        idle["classes"] = "found no --dsm, expected one with it"
    return {name: idle[name] for name in given if name in idle}


__all__ = ["SimulateOptions", "without_effect"]
