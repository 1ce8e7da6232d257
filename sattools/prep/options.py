"""Options of the prep stage, apart from its code so that the command line starts fast."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal

from sattools.settings import option


@dataclass
class PrepOptions:
    """Options of `sattools prep`."""

    metadata: str | None = option(
        None, "Folder with metadata files named like the images (JSON, XML, RPB, RPC.TXT).", path="folder"
    )
    out: str = option(".", "Folder in which the scene's own folder is made.", path="new folder")
    id: str | None = option(None, "Name of the scene [default: what the image names have in common].")
    crs: str | None = option(None, "Ground CRS, projected in metres [default: UTM zone of the place].")
    cell_size: float | None = option(
        None, "Cell size of the ground grid in metres [default: from the pixels].", minimum=1e-3, maximum=1e4
    )
    correction: Literal["auto", "shift", "affine", "none"] = option(
        "auto", "Camera correction: a shift per image, an affine map, what tie points ask for (auto), or none."
    )
    min_height: float | None = option(
        None, "Lowest height of the surface, m above the ellipsoid [default: found].", minimum=-12_000, maximum=12_000
    )
    max_height: float | None = option(
        None, "Highest height of the surface, m above the ellipsoid [default: found].", minimum=-12_000, maximum=12_000
    )
    holdout: list[str] = option([], "Id of an image to keep for testing; repeatable.")
    mask: list[str] = option(
        [], "Vector file of polygons (water, clouds) in which no surface is wanted; repeatable.", path="file"
    )
    clouds: Literal["mask", "keep"] = option(
        "mask",
        "Clouds and glare, which an image shows where the others show darker ground: no data, or kept as they are.",
    )
    colours: str | None = option(
        None,
        "Folder with multispectral images of the same acquisitions as the images, which are panchromatic then: the "
        "surface is made of these, the orthophoto's colours come from those.",
        path="folder",
    )
    copy: bool | None = option(
        None,
        "Copy the pixels into the scene's folder, or refer to the original files by window and corrected camera "
        "[default: copy up to 2 GiB in all].",
    )
    aoi: str | None = field(default=None, metadata={"path": "file"})  # vector file of the area of interest
    bounds: list[float] | None = field(default_factory=list)  # west, south, east, north


__all__ = ["PrepOptions"]
