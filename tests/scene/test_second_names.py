"""A copy of a scene in a folder that moves with it has second names of its files, and never costs one."""

import os
from pathlib import Path
from typing import Any

from sattools.scene import Scene
from sattools.scene.copies import in_another_root


def test_a_file_has_two_names(make_town: Any, tmp_path: Path) -> None:
    scene = make_town()
    image = scene.path(scene.items[0].assets["image"].href)
    document = scene.write()
    copy = in_another_root(document, scene.root / "run", scene.root)
    assert image.stat().st_nlink == 2
    assert in_another_root(document, scene.root / "run", scene.root) == copy
    assert image.stat().st_nlink == 2


def test_without_a_folder_that_moves_files_keep_their_one_name(make_town: Any, tmp_path: Path) -> None:
    scene = make_town()
    image = scene.path(scene.items[0].assets["image"].href)
    copy = Scene.from_file(in_another_root(scene.write(), tmp_path / "copy"))
    assert copy.path(copy.items[0].assets["image"].href) == image
    assert image.stat().st_nlink == 1


def test_a_folder_that_leads_back_to_the_scene_costs_no_file(make_town: Any, tmp_path: Path) -> None:
    scene = make_town()
    image = scene.path(scene.items[0].assets["image"].href)
    pixels = image.read_bytes()
    document = scene.write()
    os.symlink(scene.root, tmp_path / "back", target_is_directory=True)
    in_another_root(document, tmp_path / "back", Path("/"))
    assert image.read_bytes() == pixels
