"""Does the input gate leave good scenes alone? `prep` on thirty of them, simulated and real: no error, no warning.

    SATTOOLS_DATA=... python benchmarks/valid_scenes.py --out valid

Without SATTOOLS_DATA the simulated ones alone. An image that is set aside, an error, or any word on stderr counts as
found. Prints a line a scene; the exit status is 1 where anything was found.
"""

from __future__ import annotations

import argparse
import os
import shutil
import sys
from collections.abc import Iterator
from itertools import product
from pathlib import Path

import rasterio
from forked import preload, run
from rasterio.windows import Window

from sattools.scene import Scene

KINDS = {
    "8 bit": ["--bits", "8"],
    "hdr": ["--hdr", "--cars", "20"],
    "pointing errors": ["--bias-px", "6"],
    "southern": ["--lat", "-33", "--lon", "151"],
    "far north": ["--lat", "58", "--lon", "20"],
    "coarse": ["--gsd", "1", "--size", "96"],
    "one pass": ["--dates", "1"],
    "downtown": ["--terrain", "downtown"],
    "natural": ["--terrain", "natural", "--size", "128", "--views", "7"],
    "natural, low sun": ["--terrain", "natural", "--size", "128", "--sun-elevation", "25", "--sun-azimuth", "225"],
}


def simulated(out: Path) -> Iterator[tuple[str, list[Path], list[str]]]:
    for (name, options), seed in product(KINDS.items(), (50, 51)):
        number = f"S{len(list(out.glob('S*'))):02d}"
        base = ["simulate", "--size", "64", "--views", "4", "--dates", "3", "--seed", str(seed), "--id", number]
        done = run(["-q", *base, *options, "--out", str(out)], out / "run")
        if done.status:
            sys.exit(f"{name}: {done.stderr}")
        yield f"{name}, seed {seed}", sorted((out / number / "images").glob("*.tif")), [str(out / number / "metadata")]


def real(data: Path, out: Path) -> Iterator[tuple[str, list[Path], list[str]]]:
    jax = sorted((data / "dfc2019/Track3-RGB-crops/JAX_068").glob("*.tif"))
    metadata = [str(data / "dfc2019/rpc_raw/JAX_068")]
    for name, images in {
        "all": jax, "first half": jax[::2], "second half": jax[1::2], "five": jax[:5], "three": jax[5:8],
        "two": jax[9:11],
    }.items():  # fmt: skip
        yield f"JAX_068, {name}", images, metadata
    marseille = sorted((data / "pleiades/marseille_triplet").glob("*.tif"))
    yield "Marseille, three", marseille, []
    yield "Marseille, two", marseille[:2], []
    city = sorted((data / "external/city_214/images").glob("*.tif"))
    yield "city_214", city, [str(data / "external/city_214/metadata")]
    yield "city_214, four", city[::3], [str(data / "external/city_214/metadata")]
    natural = sorted((data / "external/natural_12/images").glob("*.tif"))
    yield "natural_12", natural, [str(data / "external/natural_12/metadata")]
    (source,) = (data / "nitf").glob("*.NTF")
    yield "NITF beside a crop of itself", [source, crop(source, out / "crop.tif")], []


def crop(source: Path, path: Path) -> Path:
    """A part of an image with the RPC of its window, as `gdal_translate -srcwin` writes it."""
    with rasterio.open(source) as image:
        width, height, offset = image.width * 3 // 4, image.height * 3 // 4, 16
        tags = image.tags(ns="RPC")
        profile = {"driver": "GTiff", "width": width, "height": height, "count": image.count, "dtype": image.dtypes[0]}
        pixels = image.read(window=Window(offset, offset, width, height))
    for name in ("LINE_OFF", "SAMP_OFF"):
        tags[name] = str(float(tags[name]) - offset)
    with rasterio.open(path, "w", **profile) as image:
        image.write(pixels)
        image.update_tags(ns="RPC", **tags)
    return path


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=Path("valid"))
    out = parser.parse_args().out.absolute()
    shutil.rmtree(out, ignore_errors=True)
    out.mkdir(parents=True)
    preload()
    data = os.environ.get("SATTOOLS_DATA")
    scenes = [*simulated(out), *(real(Path(data), out) if data else ())]
    found = 0
    for number, (name, images, metadata) in enumerate(scenes):
        given = ["--metadata", *metadata] if metadata else []
        command = ["prep", *map(str, images), *given, "--id", f"P{number:02d}", "--out", str(out / "made")]
        done = run(command, out / "run")
        said = done.stderr.replace("sattools: compiling kernels, first run\n", "").strip()
        aside = [] if done.status else [i for i in Scene.from_json(done.stdout).items if i.role == "unused"]
        wrong = bool(done.status or said or aside)
        found += wrong
        print(f"{'FOUND' if wrong else 'ok':5s} {name:32s} {len(images):2d} images", *said.splitlines(), flush=True)
    print(f"{len(scenes)} valid scenes: {found} found")
    sys.exit(bool(found))


if __name__ == "__main__":
    main()
