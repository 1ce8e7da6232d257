"""Damages every kind of input, at random but seeded, and runs the command that reads it: nothing may break.

    python benchmarks/fuzz.py --count 10000 --out fuzz
    python benchmarks/fuzz.py --seed 0 --only 4711 --out fuzz      # one case again, its folder is kept

A case is a tiny scene of which one file, or one option of the command line, is mutated: bytes flipped, cut, repeated
or replaced; numbers made huge, negative, NaN; members of a JSON document replaced by other types, removed, nested or
renamed; other files put in its place. What must hold:

- the command ends by itself, with status 0, 1, 2 or 3, within --limit seconds and 2 GB;
- no traceback; a failure says one line `sattools COMMAND: error: ...` (or click's usage error);
- a failure leaves every other file as it was, and no temporary file.

Prints what was found and a table per kind of input, and writes fuzz.json. The exit status is 1 where anything was.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import os
import random
import re
import shutil
import sys
from collections import Counter
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import geopandas
import shapely
from damage import damage, rpb, xml
from forked import Result, preload, run, warm

MEMORY_MB = 2048
MANY_PASSES = 5000  # over the tiny scene's images, which take the better part of a minute
FIT = ["--resolution", "4", "--coarsest", "4", "--epochs", "1", "--prior-weight", "0"]
WITH_PRIOR = ["--resolution", "4", "--coarsest", "4", "--epochs", "1"]
PREP = ["prep", "{images}", "--metadata", "{root}/metadata", "--out", "{root}/out", "--id", "S"]
SCENE = "{root}/scene.json"
CONFIG = """[fit]
resolution = 4.0
coarsest = 4.0
epochs = [1]
prior-weight = 0.0
seed = 1
holdout = ["TINY_001"]

[compare]
register = "none"
"""
POINTS = "name,easting,northing,albedo_1,albedo_2\na,{x},{y},0.2,0.3\nb,{x},{y},0.1,0.2\n"


@dataclass(frozen=True)
class Target:
    """A file of the tiny scene (a pattern; the first that fits is mutated) and the commands that read it."""

    pattern: str
    commands: tuple[tuple[str, ...], ...]


CHANGE = ("change", SCENE, "{root}/truth/TINY_DSM.tif", "--out", "{root}/changed")


def on(*command: str) -> tuple[str, ...]:
    return (*command, SCENE)


EVERYTHING = on("export", "--overwrite", "--products", "laz,ply,tiles,obj", "--contours", "2")
TARGETS = [
    Target("scene.json", (on("info"), on("fit", *FIT), on("prior", "--resolution", "4"), on("normalise"),
                          on("export", "--overwrite"), on("compare", "--overwrite"), on("report"),
                          on("fit", *WITH_PRIOR, "--overwrite"), on("export", "--overwrite", "--view", "TINY_002"),
                          ("batch", "--dry-run", "--out", "{root}/batch", SCENE))),
    Target("images/TINY_002.tif", (tuple(PREP), on("fit", *FIT, "--overwrite"), on("normalise"),
                                   on("prior", "--resolution", "4", "--overwrite"), EVERYTHING)),
    Target("metadata/TINY_002.json", (tuple(PREP),)),
    Target("colours/TINY_002_MS.tif", ((*PREP, "--colours", "{root}/colours"),)),
    Target("rpc/TINY_002_RPC.TXT", (on("fit", *FIT, "--overwrite"), on("export", "--overwrite"), EVERYTHING,
                                    ("prep", "{images}", "--metadata", "{root}/rpc", "--out", "{root}/out"))),
    Target("vendor/TINY_002.xml", (("prep", "{images}", "--metadata", "{root}/vendor", "--out", "{root}/out"),)),
    Target("vendor/TINY_002.RPB", (("prep", "{images}", "--metadata", "{root}/vendor", "--out", "{root}/out"),)),
    Target("aoi.geojson", ((*PREP, "--aoi", "{root}/aoi.geojson"),)),
    Target("area.gpkg", ((*PREP, "--aoi", "{root}/area.gpkg"), (*PREP, "--mask", "{root}/pond.gpkg", "--aoi",
                                                                "{root}/area.gpkg"))),
    Target("pond.gpkg", ((*PREP, "--mask", "{root}/pond.gpkg"),)),
    Target("area.geojson", (on("export", "--overwrite"), on("fit", *FIT, "--overwrite", "--tile", "64"))),
    Target("prior/probability.tif", (on("export", "--overwrite"), on("report"))),
    Target("config.toml", (on("fit", "--config", "{root}/config.toml", "--overwrite"),
                           on("compare", "--config", "{root}/config.toml", "--overwrite"),
                           ("batch", "--dry-run", "--config", "{root}/config.toml", "--out", "{root}/batch", SCENE))),
    Target("prior/confidence.tif", (EVERYTHING,)),
    Target("fit/model.safetensors", (EVERYTHING, on("export", "--overwrite"),
                                     on("export", "--overwrite", "--view", "TINY_002"))),
    Target("fit/checkpoint.safetensors", (on("fit", *FIT, "--resume"),)),
    Target("prior/dsm.tif", (on("fit", *WITH_PRIOR, "--overwrite"),)),
    Target("prior/confidence.tif", (on("fit", *WITH_PRIOR, "--overwrite"),)),
    Target("export/dsm.tif", (on("compare", "--overwrite"), on("report"),
                              ("compare", "--predicted", "{root}/export/dsm.tif", "--dsm",
                               "{root}/truth/TINY_DSM.tif"), CHANGE)),
    Target("export/validity.tif", (on("compare", "--overwrite"), CHANGE)),
    Target("export/dsm_std.tif", (CHANGE,)),
    Target("export/albedo.tif", (CHANGE,)),
    Target("area.gpkg", ((*CHANGE, "--polygons", "{root}/area.gpkg"),)),
    Target("aoi.geojson", ((*CHANGE, "--polygons", "{root}/aoi.geojson"),)),
    Target("truth/TINY_DSM.tif", (on("compare", "--overwrite"), on("compare", "--truth", "{root}/truth", "--overwrite"),
                                  ("simulate", "--dsm", "{root}/truth/TINY_DSM.tif", "--size", "32", "--views", "2",
                                   "--out", "{root}/made"))),
    Target("truth/TINY_CLS.tif", (on("compare", "--overwrite"),)),
    Target("truth/TINY_DSM.txt", (on("compare", "--truth", "{root}/truth", "--overwrite"),)),
    Target("points.csv", (on("compare", "--points", "{root}/points.csv", "--overwrite"),)),
    Target("compare/errors.json", (on("report"),)),
    Target("fit/trace.csv", (on("report"),)),
    Target("adjustment.json", (on("report"),)),
    Target("batch/table.csv", (("report", "{root}/batch"),)),
    Target("batch/digests.json", (("batch", "--dry-run", "--out", "{root}/batch", SCENE),)),
]  # fmt: skip
COMMANDS = ("prep", "normalise", "prior", "fit", "export", "compare", "change", "simulate", "report", "batch")
ODD_TEXT = [
    *("", " ", "nan", "inf", "-inf", "-1", "0", "1e308", "1e-308", "-1e9", "1" * 400, "0x10", "1,5", "π", "\udc80",
      "a" * 5000, "../../../etc/passwd", "/dev/zero", "/dev/full", "/vsicurl/http://127.0.0.1:9/x.tif", "-", "--", "*",
      "TINY_001", "$HOME", "%s%n", "\x1b[31m", "[]", "{}", "true", "auto"),
]  # fmt: skip


class Fuzz:
    """The tiny scene and what was found."""

    def __init__(self, out: Path, limit: float) -> None:
        self.out, self.limit = out.absolute(), limit
        self.base = self.out / "base"
        self.found: list[dict[str, Any]] = []
        self.table: dict[str, Counter[str]] = {}

    def prepare(self) -> None:
        """Make the scene with every file that a command may read."""
        shutil.rmtree(self.out, ignore_errors=True)
        self.base.parent.mkdir(parents=True)
        simulate = ["simulate", "--size", "32", "--views", "3", "--dates", "2", "--gsd", "1", "--id", "TINY"]
        self.must([*simulate, "--out", str(self.out)])
        shutil.move(self.out / "TINY", self.base)
        (self.base / "colours").mkdir()
        for image in (self.base / "images").glob("*.tif"):
            shutil.copy(image, self.base / "colours" / f"{image.stem}_MS.tif")
        document = json.loads((self.base / "scene.json").read_text())
        document["sattools"]["root"] = "."
        (self.base / "scene.json").write_text(json.dumps(document))
        for name, options in (("prior", ["--resolution", "2"]), ("fit", FIT[:-2]), ("export", []), ("compare", [])):
            self.must([name, *options, str(self.base / "scene.json")])
        document = json.loads((self.base / "scene.json").read_text())
        document["sattools"]["root"] = "."
        (self.base / "scene.json").write_text(json.dumps(document))
        (self.base / "config.toml").write_text(CONFIG)
        shutil.copy(self.base / "fit/model.safetensors", self.base / "fit/checkpoint.safetensors")
        grid = document["sattools"]["grid"]
        (self.base / "points.csv").write_text(POINTS.format(x=grid["left"] + 9, y=grid["top"] - 9))
        ring = document["features"][0]["geometry"]
        (self.base / "aoi.geojson").write_text(
            json.dumps(
                {"type": "FeatureCollection", "features": [{"type": "Feature", "properties": {}, "geometry": ring}]}
            )
        )
        geopandas.read_file(self.base / "aoi.geojson").to_file(self.base / "area.gpkg")
        left, top = grid["left"], grid["top"]
        pond = geopandas.GeoSeries([shapely.box(left + 4, top - 12, left + 12, top - 4)], crs=grid["crs"])
        pond.to_file(self.base / "pond.gpkg")
        without = shapely.box(left, top - 32, left + 32, top).difference(pond.iloc[0])
        degrees = geopandas.GeoSeries([without], crs=grid["crs"]).to_crs("EPSG:4326")
        (self.base / "area.geojson").write_text(degrees.to_json(drop_id=True))
        document["sattools"]["products"]["area"] = "area.geojson"
        (self.base / "scene.json").write_text(json.dumps(document))
        self.must([*self.filled(PREP, self.base)])
        shutil.copy(self.base / "out/S/adjustment.json", self.base / "adjustment.json")
        shutil.rmtree(self.base / "out")
        self._vendor()
        self.must(["batch", "--workers", "1", "--config", str(self.base / "config.toml"), "--out",
                   str(self.base / "batch"), str(self.base / "scene.json")])  # fmt: skip
        shutil.rmtree(self.base / "batch/runs")
        root = self.out / "warm"
        shutil.copytree(self.base, root)
        for command in ([*PREP], on("prior", "--overwrite", "--resolution", "4"), on("normalise"),
                        on("fit", *WITH_PRIOR, "--overwrite"), on("export", "--overwrite", "--view", "TINY_002"),
                        on("compare", "--overwrite"), on("report"), on("info"), CHANGE):  # fmt: skip
            warm(["--threads", "1", "-q", *self.filled(command, root)])

    def _vendor(self) -> None:
        """The same cameras in two vendors' formats."""
        from sattools.camera import RPC

        folder = self.base / "vendor"
        folder.mkdir()
        for path in sorted((self.base / "rpc").glob("*.TXT")):
            name = path.name.removesuffix("_RPC.TXT")
            rpc = RPC.from_file(path)
            (folder / f"{name}.RPB").write_text(rpb(rpc))
            (folder / f"{name}.xml").write_text(xml(rpc))

    def must(self, arguments: list[str]) -> None:
        done = run(["--threads", "1", "-q", *arguments], self.out / "run")
        if done.status:
            sys.exit(f"{arguments} failed undamaged: {done.stderr}")

    def filled(self, command: list[str] | tuple[str, ...], root: Path) -> list[str]:
        """The command line on a copy of the scene."""
        filled: list[str] = []
        for part in command:
            if part == "{images}":
                filled += sorted(str(path) for path in (root / "images").glob("*.tif"))
            else:
                filled.append(part.replace("{root}", str(root)))
        return filled

    def case(self, number: int, seed: int, keep: bool = False) -> None:
        """One case, from its number alone."""
        rng = random.Random(f"{seed}/{number}")
        root = self.out / f"case{number}"
        shutil.rmtree(root, ignore_errors=True)
        shutil.copytree(self.base, root, copy_function=os.link)  # commands replace files, they never write into them
        if rng.random() < 0.2:
            kind, what, command = "options", *self._odd_option(rng, root)
        else:
            target = rng.choice(TARGETS)
            kind, path = target.pattern, root / target.pattern
            command = self.filled(rng.choice(target.commands), root)
            what = damage(path, rng)
        before = digests(root)
        try:
            arguments = ["--threads", "1", *command]
            done = run(arguments, self.out / "run", self.limit, memory_mb=MEMORY_MB + 1024, cwd=root)
        except (ValueError, OSError) as error:  # no process can be given such arguments
            self._count(kind, f"not run ({type(error).__name__})")
            shutil.rmtree(root)
            return
        wrong = self._judge(done, root, before, command)
        self._count(kind, f"status {done.status}")
        if wrong:
            self.found.append({"case": number, "kind": kind, "damage": what, "command": command, "wrong": wrong,
                               "stderr": done.stderr[-1500:]})  # fmt: skip
            line = f"FOUND case {number}: {kind}, {what[:200]}: {wrong[:300]}\n   {' '.join(command)[:400]}"
            print(line.encode("ascii", "replace").decode(), flush=True)
        if keep:
            print(done, root)
        else:
            shutil.rmtree(root, ignore_errors=True)
            shutil.rmtree(self.out / "odd", ignore_errors=True)

    def _judge(self, done: Result, root: Path, before: dict[str, str], command: list[str]) -> str:
        if done.timed_out:
            return "" if asked_for_many_passes(root, command) else f"no end after {self.limit:g} s"
        if done.traceback:
            return "traceback: " + done.stderr.strip().splitlines()[-1][:200]
        if "internal error" in done.stderr:
            return "internal error: " + done.stderr.strip().splitlines()[-1][:300]
        if done.status not in (0, 1, 2, 3):
            return f"status {done.status}"
        if done.peak_mb > MEMORY_MB:
            return f"{done.peak_mb:.0f} MB"
        if left := [path.name for path in root.rglob(".*tmp-sattools*")]:
            return f"left {left[0]}"
        if done.status in (1, 2) and not re.search(
            r"^(sattools( [a-z]+)?: )?error: |^Error: ", done.stderr, re.I | re.M
        ):
            return "failed without a word"
        # click repeats what somebody typed
        long = [line for line in done.stderr.splitlines() if len(line) > 1500]
        if long and done.status != 2:
            return f"a line of {len(long[0])} characters"
        if done.status == 1:
            after = digests(root)
            changed = [name for name in before if after.get(name) != before[name]]
            new = [name for name in after if name not in before and not name.startswith(("batch/", "out/"))]
            if changed or new:
                return f"failed, but wrote {(changed + new)[0]}"
        return ""

    def _odd_option(self, rng: random.Random, root: Path) -> tuple[str, list[str]]:
        """A command with an option of an odd value."""
        import click

        from sattools.cli import main

        name = rng.choice(COMMANDS)
        part = main.get_command(click.Context(main), name)
        assert part is not None
        options = [p for p in part.params if isinstance(p, click.Option) and p.name not in ("help", "dry_run")]
        option = rng.choice(options)
        values = [] if option.is_flag else [rng.choice(ODD_TEXT) for _ in range(max(1, option.nargs))]
        flag = rng.choice([*option.opts, *option.secondary_opts])
        usual = {
            "prep": PREP, "fit": on("fit", *FIT, "--overwrite"),
            "prior": on("prior", "--resolution", "4", "--overwrite"),
            "simulate": ("simulate", "--size", "32", "--views", "2", "--dates", "1", "--gsd", "1", "--out",
                         "{root}/made"),
            "batch": ("batch", "--dry-run", "--out", "{root}/batch", SCENE), "info": on("info"), "report": on("report"),
            "change": CHANGE,
        }  # fmt: skip
        command = self.filled(usual.get(name, on(name, "--overwrite")), root)
        where = rng.choice([1, len(command)])
        return f"{flag} {values}", [*command[:where], flag, *values, *command[where:]]

    def _count(self, kind: str, result: str) -> None:
        self.table.setdefault(kind, Counter())[result] += 1


def asked_for_many_passes(root: Path, command: list[str]) -> bool:
    """Whether the fit was told to go over the images so often that it is still at work: that is no hanging."""
    told = " ".join(command)
    if "--config" in command:
        told += (root / "config.toml").read_text(errors="replace")
    return any(int(number) >= MANY_PASSES for number in re.findall(r"epochs\W+(\d{1,9})\b", told))


def digests(root: Path) -> dict[str, str]:
    """Content of every file below a folder; a checkpoint may change, and a log may grow."""
    found = {}
    for path in root.rglob("*"):
        if path.name == "sattools.log":  # it tells of runs that failed, too
            continue
        if path.is_file() and "checkpoint" not in path.name and "/tiles/" not in str(path):
            found[str(path.relative_to(root))] = hashlib.sha256(path.read_bytes()).hexdigest()
    return found


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--count", type=int, default=10_000)
    parser.add_argument("--first", type=int, default=0, help="number of the first case")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--only", type=int, help="run this case alone and keep its folder")
    parser.add_argument("--limit", type=float, default=600.0, help="seconds after which a case counts as hanging")
    parser.add_argument("--out", type=Path, default=Path("fuzz"))
    options = parser.parse_args()
    preload()
    fuzz = Fuzz(options.out, options.limit)
    fuzz.prepare()
    if options.only is not None:
        fuzz.case(options.only, options.seed, keep=True)
    else:
        for k in range(options.first, options.first + options.count):
            fuzz.case(k, options.seed)
            if (k + 1) % 500 == 0:
                print(f"{k + 1} cases, {len(fuzz.found)} found", flush=True)
    for kind, results in sorted(fuzz.table.items()):
        print(f"{kind:28s} " + "   ".join(f"{name} {count}" for name, count in sorted(results.items())))
    print(f"{sum(sum(r.values()) for r in fuzz.table.values())} cases, {len(fuzz.found)} found")
    (fuzz.out / "fuzz.json").write_text(json.dumps({"table": fuzz.table, "found": fuzz.found}, indent=1, default=str))
    sys.exit(bool(fuzz.found))


if __name__ == "__main__":
    main()
