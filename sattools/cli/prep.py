"""`sattools prep`: images with RPC cameras become a scene."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from sattools.cli.kinds import Finite, NamedPath, PathText
from sattools.cli.options import as_usage, build, common_options, dataclass_options
from sattools.cli.pipe import Run, report_error, run_source
from sattools.cli.plans import of_prep
from sattools.errors import InputError, counted
from sattools.prep.options import PrepOptions
from sattools.progress import Progress

if TYPE_CHECKING:
    from sattools.scene import Scene
    from sattools.scene.jsonio import JsonObject


@click.command("prep")
@click.argument("images", nargs=-1, type=NamedPath(path_type=str), metavar="IMAGE...")
@dataclass_options(PrepOptions)
@click.option(
    "--aoi",
    type=PathText("file"),
    help="Vector file (GeoJSON, GeoPackage, shapefile, FlatGeobuf, KML, KMZ) of the area of interest; "
    "with --dfc2019 the name of an area such as JAX_068.",
)
@click.option(
    "--bounds",
    nargs=4,
    type=Finite(),
    metavar="W S E N",
    help="Area of interest, in --crs if that is given, else in degrees; across 180 degrees W is larger than E.",
)
@click.option("--dfc2019", type=NamedPath(path_type=Path), help="Root of the Data Fusion Contest 2019, track 3.")
@common_options
def command(
    *,
    images: tuple[str, ...],
    aoi: str | None,
    bounds: tuple[float, float, float, float] | None,
    dfc2019: Path | None,
    overwrite: bool,
    dry_run: bool,
    print_config: bool,
    **values: Any,
) -> None:
    """Correct the cameras of images that show one place, find the height range, and print the scene.

    Images: GeoTIFF with RPC tags, NITF, or any raster with DIMAP or DigitalGlobe XML, .RPB, _RPC.TXT or Sat-NeRF JSON
    beside it or in --metadata; a folder stands for the images in it (.tif, .tiff, .ntf, .nitf, .jp2, .img;
    JPEG and PNG are quick looks, as a rule) that have one of these. They, and areas and masks in GeoJSON, may
    also be addresses (https://, s3://) or lie in archives (/vsizip/FILE.zip/NAME.tif).
    """
    if not images and dfc2019 is None and not print_config:
        raise click.UsageError("expected IMAGE... or --dfc2019 ROOT --aoi AREA")
    if images and dfc2019 is not None:
        raise click.UsageError("expected either IMAGE... or --dfc2019, found both")
    options = replace(build(PrepOptions, values), aoi=aoi, bounds=list(bounds or ()))
    _check_crs(options.crs)
    paths: list[Path] = []
    if dfc2019 is not None:
        from sattools.prep.dfc2019 import find_images

        if aoi is None:
            raise click.UsageError("--dfc2019 expects --aoi with the name of an area such as JAX_068")
        try:
            paths, folder = find_images(dfc2019, aoi)
        except InputError as error:
            report_error("prep", error)
            raise SystemExit(1) from None
        metadata = options.metadata or (str(folder) if folder else None)
        options = replace(options, id=options.id or aoi, metadata=metadata, aoi=None)

    def check() -> str:
        """Everything that can be checked without work; what it will take."""
        from sattools.prep.stage import check_inputs

        where = Path(options.out) / options.id if options.id else options.out
        return f"{of_prep(check_inputs(paths, options, overwrite))}; writes {where}/"

    def make(progress: Progress) -> tuple[Scene, JsonObject]:
        from sattools.prep.stage import prepare
        from sattools.scene.memory import keep_freed

        keep_freed()
        return prepare(paths, options, progress, overwrite)

    from sattools.prep.folders import images_with_cameras

    try:
        paths = paths or images_with_cameras(images, options.metadata)
    except InputError as error:
        report_error("prep", error)
        raise SystemExit(1) from None
    label = options.id or f"a scene of {counted(len(paths), 'images')}"
    run_source(Run("prep", options, dry_run, print_config, overwrite, tuple(paths)), make, label, check)


def _check_crs(crs: str | None) -> None:
    """A CRS that is none, or not in metres, is wrong usage whatever the images are."""
    if crs is not None:
        from sattools.camera.ground import check_ground_crs

        with as_usage():
            check_ground_crs(crs)
