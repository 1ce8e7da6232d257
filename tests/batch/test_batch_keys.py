"""By what a batch knows a finished result again: what went into it, wherever that lies."""

import os
from pathlib import Path
from typing import Any

from planned import DEFAULT, contest, keys

from sattools.batch.configuration import Configuration
from sattools.batch.options import BatchOptions
from sattools.batch.plan import Digests
from sattools.batch.queue import make_plan


def test_a_key_follows_content_and_options_but_not_times_or_places(tmp_path: Path, make_town: Any) -> None:
    town = make_town("TOWN")
    [first] = keys(tmp_path, town)
    image = town.path(town.items[0].assets["image"].href)
    image.touch()
    town.history.append({"command": "info", "seconds": 1.0})
    assert keys(tmp_path, town) == [first]
    assert keys(tmp_path, town, Configuration("default", {}, {"fit": {"seed": 1}})) != [first]
    with open(image, "ab") as file:
        file.write(b"\0")
    assert keys(tmp_path, town) != [first]


def test_other_content_of_the_size_and_the_time_of_before_is_other_content(tmp_path: Path) -> None:
    """As `cp -p`, `rsync -t` and `tar` leave it."""
    image = tmp_path / "image.tif"
    image.write_text("one")
    known = Digests(tmp_path / "digests.json")
    first, before = known(image), image.stat()
    known.save()
    assert Digests(tmp_path / "digests.json")(image) == first
    while image.stat().st_ctime_ns == before.st_ctime_ns:  # the system's clock has ticks
        image.write_text("two")
        os.utime(image, ns=(before.st_atime_ns, before.st_mtime_ns))
    assert (image.stat().st_size, image.stat().st_mtime_ns) == (before.st_size, before.st_mtime_ns)
    assert Digests(tmp_path / "digests.json")(image) != first


def test_a_result_is_of_the_metadata_that_normalise_is_given(tmp_path: Path, make_town: Any) -> None:
    town = make_town("TOWN")
    (tmp_path / "vendor").mkdir()
    imd = tmp_path / "vendor/TOWN_001.IMD"
    imd.write_text("one")
    tables = {"normalise": {"metadata": str(tmp_path / "vendor")}}
    pair = [Configuration(name, tables, tables | {"fit": {"epochs": [n]}}) for n, name in enumerate("ab", 1)]
    first = keys(tmp_path, town, *pair)
    assert len(first) == 3  # what they share, too
    imd.touch()
    assert keys(tmp_path, town, *pair) == first
    imd.write_text("two")
    assert not set(keys(tmp_path, town, *pair)) & set(first)


def area_keys(tmp_path: Path, root: Path, configuration: Configuration = DEFAULT) -> list[str]:
    options = BatchOptions(out=str(tmp_path / "out"), dfc2019=str(root), aoi=["JAX_068"])
    return [job.task.key for job in make_plan(options, [], [configuration]).jobs]


def test_a_prepared_scene_is_of_the_cameras_beside_the_images(tmp_path: Path) -> None:
    """Not of where the contest's folders lie."""
    root = contest(tmp_path / "data")
    camera = root / "metadata/JAX_068/JAX_068_001_RGB.json"
    camera.parent.mkdir(parents=True)
    camera.write_text("one")
    reference = root / "Track3-Truth/JAX_068_DSM.tif"
    reference.write_text("one")
    first = area_keys(tmp_path, root)
    assert len(first) == 2
    root = root.rename(tmp_path / "moved")
    assert area_keys(tmp_path, root) == first
    (root / "Track3-Truth/JAX_068_DSM.tif").write_text("two")
    prepared, scored = area_keys(tmp_path, root)
    assert (prepared == first[0], scored == first[1]) == (True, False)
    (root / "metadata/JAX_068/JAX_068_001_RGB.json").write_text("two")
    assert not set(area_keys(tmp_path, root)) & set(first)


def test_a_prepared_scene_is_of_the_files_that_its_options_name(tmp_path: Path) -> None:
    root, water = contest(tmp_path / "data"), tmp_path / "water.geojson"
    configuration = Configuration("masked", {}, {"prep": {"mask": [str(water)]}})
    options = BatchOptions(out=str(tmp_path / "out"), dfc2019=str(root), aoi=["JAX_068"])
    plan = make_plan(options, [], [configuration, DEFAULT])
    assert plan.errors["JAX_068", "masked"][1].startswith(f"{water}: cannot be read (No such file or directory)")
    assert ("JAX_068", "default") in plan.runs  # the others go on
    water.write_text("one")
    first = area_keys(tmp_path, root, configuration)
    water.write_text("two")
    assert not set(area_keys(tmp_path, root, configuration)) & set(first)


def test_an_area_with_a_damaged_reference_does_not_stop_the_others(tmp_path: Path) -> None:
    root = contest(tmp_path / "data")
    options = BatchOptions(out=str(tmp_path / "out"), dfc2019=str(root), aoi=["JAX_004", "JAX_068"])
    plan = make_plan(options, [], [DEFAULT])
    status, why = plan.errors["JAX_004", "default"]
    assert (status, why.startswith(str(root / "Track3-Truth"))) == ("failed", True)
    assert [job.task.scene for job in plan.jobs] == ["JAX_068", "JAX_068"]
