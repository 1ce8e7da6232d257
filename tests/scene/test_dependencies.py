"""What a command makes invalid is dropped, and what changed behind its back is noticed."""

from pathlib import Path
from typing import Any

import pytest

from sattools.errors import OutputExistsError, OutputIsInputError, StaleError
from sattools.scene import Asset, Grid, Item, Scene
from sattools.scene.dependencies import (
    IMAGES,
    MADE,
    begin,
    check_current,
    current_entry,
    drop,
    image_digests,
    in_force,
    latest,
    record,
    seen,
    stale,
)  # fmt: skip
from sattools.scene.document import FIT_ROLE

FILES = {
    "prior": {"prior_dsm": "prior/dsm.tif"},
    "fit": {"model": "fit/model.safetensors"},
    "export": {"dsm": "export/dsm.tif", "theta": "export/theta.tif", "theta_std": "export/theta_std.tif"},
    "compare": {"errors": "compare/errors.json"},
}


def put(scene: Any, href: Any, text: Any) -> None:
    path = scene.root / href
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(text)


def run(scene: Any, command: Any, text: Any = "", items: Any = None) -> None:
    """A command as the pipe runs it, its outputs made of text."""
    drop(scene, command)
    for name, href in FILES[command].items():
        put(scene, href, f"{command} {text}")
        scene.products[name] = href
    used = scene.items if items is None else items
    scene.history.append({"command": command, MADE: record(scene, command, used)})


@pytest.fixture
def scene(tmp_path: Path) -> Any:
    items = []
    for name in ("a", "b"):
        (tmp_path / f"{name}.tif").write_text(f"pixels of {name}")
        (tmp_path / f"{name}_RPC.TXT").write_text(f"camera of {name}")
        assets = {"image": Asset(f"{name}.tif"), "rpc": Asset(f"{name}_RPC.TXT")}
        items.append(Item(name, None, None, {"view:sun_azimuth": 120.0, "sattools:role": "train"}, assets))
    scene = Scene("S", tmp_path, items, Grid("EPSG:32617", 0, 0, 1.0, 4, 4), (0.0, 9.0))
    scene.history.append({"command": "prep"})
    return scene


def test_an_image_that_was_replaced_after_prep_is_told_at_every_step_that_reads_it(
    scene: Any, caplog: pytest.LogCaptureFixture
) -> None:
    scene.history[0][IMAGES] = image_digests(scene)
    seen(scene, "prior", scene.items)
    put(scene, "a_RPC.TXT", "as `align` has moved it")
    seen(scene, "prior", scene.items)
    assert caplog.text == ""
    put(scene, "a.tif", "pixels of another")
    for step in ("normalise", "prior", "fit"):
        caplog.clear()
        seen(scene, step, scene.items)
        (record_,) = caplog.records
        assert "item a: " in record_.message
        assert "a.tif is not the image any more that prep has found the camera of" in record_.message


@pytest.mark.parametrize("history", [[{"command": "simulate"}], [{"command": "prep"}], []])
def test_images_of_which_nothing_was_noted_are_taken_as_they_are(
    scene: Any, history: Any, caplog: pytest.LogCaptureFixture
) -> None:
    scene.history = history
    seen(scene, "fit", scene.items)
    assert caplog.text == ""


@pytest.mark.parametrize("name", ["b.tif", "b_RPC.TXT"])
def test_an_image_or_camera_that_is_gone_is_named(scene: Any, name: str) -> None:
    run(scene, "prior")
    (scene.root / name).unlink()
    reason = f"found no {scene.root / name} any more, of which prior was made, expected it there"
    assert stale(scene, "fit") == reason


@pytest.mark.parametrize(("name", "of"), [("prior/dsm.tif", "fit"), ("fit/model.safetensors", "export")])
def test_a_file_of_the_step_before_that_is_gone_is_named(scene: Any, name: str, of: str) -> None:
    for command in ("prior", "fit", "export"):
        run(scene, command)
    (scene.root / name).unlink()
    reason = f"found no {scene.root / name} any more, of which {of} was made, expected it there"
    assert stale(scene, "export") == reason


def test_a_new_fit_drops_everything_that_was_made_of_the_old_one(scene: Any) -> None:
    for command in FILES:
        run(scene, command)
    scene.items[0].assets["shadow"] = Asset("export/shadow/a.tif")
    scene.items[0].properties[FIT_ROLE] = "test"
    scene.products["truth_dsm"] = "truth/dsm.tif"
    assert drop(scene, "fit") == ["model", "dsm", "theta", "theta_std", "errors"]
    assert scene.products == {"prior_dsm": "prior/dsm.tif", "truth_dsm": "truth/dsm.tif"}
    assert set(scene.items[0].assets) == {"image", "rpc"}
    assert not scene.items[0].held_out


def test_products_that_were_left_alone_are_current(scene: Any) -> None:
    for command in FILES:
        run(scene, command)
    for command in FILES:
        assert stale(scene, command) is None


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda s: put(s, "export/dsm.tif", "of another program"), "another file for dsm"),
        (lambda s: put(s, "fit/model.safetensors", "of another fit"), "another file for model"),
        (lambda s: put(s, "prior/dsm.tif", "of another prior"), "another file for prior_dsm"),
        (lambda s: put(s, "a.tif", "other pixels"), "what prior was made from has changed"),
        (lambda s: put(s, "b_RPC.TXT", "another camera"), "what prior was made from has changed"),
        (lambda s: s.items[0].properties.update({"view:sun_azimuth": 121.0}), "what prior was made from has changed"),
        (lambda s: setattr(s, "height_range_m", (0.0, 8.0)), "what prior was made from has changed"),
    ],
)
def test_whatever_changed_is_named(scene: Any, change: Any, words: Any) -> None:
    for command in FILES:
        run(scene, command)
    change(scene)
    with pytest.raises(StaleError, match=words):
        check_current(scene, "compare")


@pytest.mark.parametrize(
    ("before", "href", "stage"),
    [
        ("prior", "prior/dsm.tif", "fit"),
        ("fit", "fit/model.safetensors", "export"),
        ("export", "export/dsm.tif", "compare"),
    ],
)
def test_a_file_that_no_history_knows_is_known_by_what_was_made_of_it(
    scene: Any, before: str, href: str, stage: str
) -> None:
    for command in FILES:
        run(scene, command)
    scene.history[:] = [entry for entry in scene.history if entry["command"] != before]  # as of another program
    assert stale(scene, stage) is None
    put(scene, href, "of another program")
    assert f"found that what {stage} was made from has changed since" in str(stale(scene, stage))


def test_a_missing_file_is_the_readers_error_and_products_without_a_record_are_taken_as_they_are(scene: Any) -> None:
    run(scene, "fit")
    (scene.root / "fit/model.safetensors").unlink()
    assert stale(scene, "fit") is None
    scene.history.clear()
    put(scene, "fit/model.safetensors", "by hand")
    assert stale(scene, "export") is None


def test_a_score_counts_until_something_before_it_is_made_anew(scene: Any) -> None:
    for command in FILES:
        run(scene, command)
    assert current_entry(scene, "compare") is scene.history[-1]
    run(scene, "fit", "again")
    assert current_entry(scene, "compare") is None
    assert latest(scene, "compare") is None
    assert current_entry(scene, "prior") is scene.history[1]
    scene.history.append({"command": "prep"})
    assert latest(scene, "fit") is None


def test_outputs_are_checked_against_all_other_files_of_the_scene(scene: Any) -> None:
    for command in FILES:
        run(scene, command)
    with pytest.raises(OutputExistsError, match=r"export/dsm\.tif"):
        begin(scene, "export", ["export/new.tif", "export/dsm.tif"], False)
    begin(scene, "export", ["export/new.tif", "export/dsm.tif"], True)
    for href in ("a.tif", "prior/dsm.tif", "fit/model.safetensors"):
        with pytest.raises(OutputIsInputError):
            begin(scene, "export", ["export/new.tif", href], True)
    (scene.root / "export/linked.tif").symlink_to(scene.root / "a.tif")
    with pytest.raises(OutputIsInputError, match=r"linked\.tif: is the input .*a\.tif"):
        begin(scene, "export", ["export/linked.tif"], True)
    assert (scene.root / "a.tif").read_text() == "pixels of a"


def test_a_copy_in_another_place_knows_its_history(scene: Any, tmp_path: Path) -> None:
    from sattools.scene.copies import absolute_copy

    for command in FILES:
        run(scene, command)
    copy = absolute_copy(scene, tmp_path / "copy")
    assert stale(copy, "compare") is None
    put(scene, "a.tif", "other pixels")
    assert stale(copy, "compare") is not None


@pytest.mark.parametrize(
    ("run", "stands"),
    [
        ("prep prior fit export compare", "prep prior fit export compare"),
        ("prep prior fit export fit", "prep prior fit"),
        ("prep prior fit normalise fit export", "prep normalise fit export"),
        ("prep fit export compare export", "prep fit export"),
        # where the surface lies is known from that of before
        ("prep fit export compare align fit export", "prep fit export align fit export"),
        ("prep fit export align compare align export export", "prep fit export align align export"),
        ("simulate fit export align prep normalise", "prep normalise"),
    ],
)
def test_what_a_scene_stands_on_is_what_no_later_command_has_made_void(run: str, stands: str) -> None:
    history = [{"command": name} for name in run.split()]
    assert " ".join(entry["command"] for entry in in_force(history)) == stands
