"""What is made from what: a command drops what it makes invalid, and what changed behind its back is noticed.

Every stage notes in its history entry, under `made`, a hash of what it read and of each file that it wrote (`record`).
`check_current` compares that with what is there now; `begin` drops what a stage is about to replace, with everything
that was made from it, and refuses outputs that must not be written.
"""

from __future__ import annotations

import hashlib
import json
import logging
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType
from typing import Any

from sattools.errors import StaleError
from sattools.scene.document import FIT_ROLE, Item, Scene
from sattools.scene.files import check_outputs, digest
from sattools.scene.grid import Grid
from sattools.scene.jsonio import JsonObject
from sattools.scene.location import RemotePath

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Stage:
    """What a stage leaves in a scene.

    Attributes:
        products: names of products; `NAME_std` goes with NAME.
        assets: names of assets of the images.
        properties: of the images.
    """

    products: tuple[str, ...] = ()
    assets: tuple[str, ...] = ()
    properties: tuple[str, ...] = ()


# in the order of the pipe: a stage depends on all before it
STAGES: dict[str, Stage] = {
    "prep": Stage(("area",)),
    "normalise": Stage(("radiance_histogram",), ("radiance",)),
    "prior": Stage(
        (
            *("prior_dsm", "prior_dsm_error95", "prior_confidence", "prior_probability", "prior_normals"),
            *("prior_surroundings", "prior_water"),
        ),
        ("depth", "confidence"),
    ),
    "fit": Stage(("model", "trace"), (), (FIT_ROLE,)),
    "export": Stage(
        (
            *(
                "dsm",
                "dsm_picture",
                "dsm_error95",
                "probability",
                "validity",
                "albedo",
                "reflectance",
                "normal",
                "relit",
            ),
            *("w", "b", "c", "theta", "rho0", "k", "asymmetry", "rhoc", "identifiable", "lambert_share"),
            *("points", "points_ply", "contours", "dtm", "dtm_validity", "ndsm", "ortho", "ortho_source"),
            *("mesh", "mesh_obj", "mesh_mtl", "mesh_texture", "tileset", "collection", "collection_item"),
        ),
        ("shadow", "s_net", "tau", "beta", "rendered", "rendered_height", "rendered_scored", "relit"),
    ),
    "compare": Stage(("difference", "errors")),
}
ORDER = list(STAGES)
Seen = Mapping[str, list[Any]]  # image -> digests of its files, and its properties
MADE = "made"  # member of a history entry: stage -> record
PRIOR_SECONDS = "prior_seconds"  # likewise, of `fit`: those of its seconds in which it made the prior itself
# likewise, of `prior` and `fit`: those that interrupted runs before it took for what it went on with, beside its own
EARLIER_SECONDS = "earlier_seconds"
IMAGES = "images"  # likewise, of `prep`: digests of the images whose cameras it has found
ALBEDO_SECONDS = "albedo_seconds"  # and those in which it solved for the albedo of a surface whose heights stand
# who began a history entry that makes all others out of date
SOURCES = ("prep", "simulate")


# what is meant, perhaps, by a file that stands in the place of what a stage left
_OF_ANOTHER_TOOL = {
    "prior": "; another tool's surface is named as prior_dsm, with prior_confidence, in a document from before `prior`",
    "export": "; another tool's surface is scored by `compare --predicted`",
}


def begin(
    scene: Scene, stage: str, outputs: Iterable[str], overwrite: bool, inputs: Iterable[Path] = ()
) -> dict[str, Path]:
    """Get ready to write a stage's outputs: nothing is written yet, but nothing can be in the way any more.

    As `may_begin`, and their folders are made.

    Args:
        scene: is changed.
        stage: name, see `STAGES`.
        outputs: hrefs of all files that will be written.
        overwrite: whether they may exist.
        inputs: files beside the scene's that must not be written onto.

    Returns:
        Path of every output by its href.

    Raises:
        OutputIsInputError, OutputExistsError: see `check_outputs`.
        SceneError: an href leads out of the scene's root.
    """
    outputs = list(outputs)
    may_begin(scene, stage, outputs, overwrite, inputs)
    return {href: scene.output(href) for href in outputs}


def may_begin(scene: Scene, stage: str, outputs: Iterable[str], overwrite: bool, inputs: Iterable[Path] = ()) -> None:
    """Raise where a stage's outputs must not be written; leaves the scene's folder as it is.

    What the stage and all after it have left is dropped from the scene in memory; its files stay. All other files that
    the scene names count as inputs. Arguments and errors as of `begin`.
    """
    drop(scene, stage)
    check_outputs([scene.path(href) for href in outputs], [*files_of(scene), *inputs], overwrite)


def drop(scene: Scene, stage: str) -> list[str]:
    """Forget what a stage and all after it have made, in the scene in memory; names of the products."""
    gone = []
    for later in ORDER[ORDER.index(stage) :]:
        made = STAGES[later]
        for name in [name for name in scene.products if name in names_of(made)]:
            del scene.products[name]
            gone.append(name)
        for item in scene.items:
            for name in made.assets:
                item.assets.pop(name, None)
            for name in made.properties:
                item.properties.pop(name, None)
    return gone


def left_behind(stage: str) -> tuple[set[str], set[str]]:
    """Names of the assets and of the properties that a stage and all after it leave with images."""
    made = [STAGES[later] for later in ORDER[ORDER.index(stage) :]]
    assets, properties = ({name for one in made for name in getattr(one, kind)} for kind in ("assets", "properties"))
    return assets, properties


def files_of(scene: Scene) -> list[Path]:
    """All files that a scene's document names, sorted."""
    hrefs = [asset.href for item in scene.items for asset in item.assets.values()]
    return sorted({scene.path(href) for href in [*hrefs, *scene.products.values()]})


def seen(scene: Scene, stage: str, items: Sequence[Item]) -> Seen:
    """What a stage is about to read of its images, for `record` at its end, hours later.

    Warns of images that have been replaced since `prep`: cameras and tie points are those of others.

    Args:
        scene: the scene.
        stage: `normalise`, `prior` or `fit`.
        items: the images.
    """
    found = {item.id: _image(scene, item, stage) for item in items}
    known = next((e.get(IMAGES) or {} for e in reversed(scene.history) if e.get("command") in SOURCES), {})
    for item in items:
        if _pixels(item, stage) == "image" and known.get(item.id) not in (None, found[item.id][1]):
            log.warning(
                "scene %s: item %s: %s is not the image any more that prep has found the camera of: run prep again",
                *(scene.id, item.id, scene.path(item.assets["image"].href)),
            )
    return found


def image_digests(scene: Scene) -> dict[str, str]:
    """Digest of the image of every item, for `IMAGES` of the history entry; without those of other machines."""
    found = {item.id: digest(scene.path(item.assets["image"].href)) for item in scene.items if "image" in item.assets}
    return {name: value for name, value in found.items() if value is not None}


def record(
    scene: Scene, stage: str, items: Sequence[Item] = (), read: Seen | None = None, **more: Any
) -> dict[str, JsonObject]:
    """What a stage has made from what, for `made` of the history entry.

    Args:
        scene: with the stage's outputs.
        stage: name, see `STAGES`.
        items: the images that it used.
        read: as they were when it began, see `seen`; None = as they are.
        more: further members of the record.
    """
    ids = [item.id for item in items]
    inputs = _inputs(scene, stage, ids, read or {})
    return {stage: {"inputs": inputs, "items": ids, "outputs": _outputs(scene, stage), **more}}


def latest(scene: Scene, stage: str) -> JsonObject | None:
    """The record of what a stage has made, None where there is none or it is out of date by the history's order."""
    for entry in reversed(scene.history):
        made = entry.get(MADE) or {}
        if stage in made:
            return dict(made[stage])
        if _is_before(entry.get("command"), stage) or any(_is_before(name, stage) for name in made):
            return None
    return None


def outdated_by(scene: Scene, stage: str) -> str | None:
    """The command that has put what a stage made out of date by the history's order; None where nothing has."""
    by = None
    for entry in reversed(scene.history):
        if stage in (entry.get(MADE) or {}):
            return by
        if _is_before(entry.get("command"), stage):
            by = entry["command"]
    return None


def current_entry(scene: Scene, command: str) -> JsonObject | None:
    """The last history entry of a command, None where a later command has made it out of date."""
    for entry in reversed(scene.history):
        if entry.get("command") == command:
            return entry
        if _is_before(entry.get("command"), command):
            return None
    return None


def in_force(history: Iterable[JsonObject]) -> list[JsonObject]:
    """The entries of a history that the scene as it is now stands on, oldest first.

    A stage that was run again makes its earlier entries, and those of all after it, void; but what an `align` was found
    with stays, as everything lies where it has moved it.
    """
    kept: list[JsonObject] = []
    for entry in history:
        command = entry.get("command")
        moved = 1 + max((k for k, old in enumerate(kept) if old.get("command") == "align"), default=-1)
        if command in SOURCES:
            kept = []
        elif command == "align":  # drops scores, and was found without them
            kept = [old for old in kept if old.get("command") != "compare"]
        elif command in STAGES:
            before, after = kept[:moved], kept[moved:]
            kept = before + [old for old in after if not _is_void(old.get("command"), command)]
        kept.append(entry)
    return kept


def check_current(scene: Scene, stage: str) -> None:
    """Raise StaleError where a stage's products are not what it left, or were made from something else than is there.

    Products without a record, of other programs or older versions, are taken as they are.
    """
    reason = stale(scene, stage)
    if reason:
        raise StaleError(f"scene {scene.id}: {reason}")


def stale(scene: Scene, stage: str) -> str | None:
    """Why a stage's products must not be used, None where they may."""
    for name in ORDER[1 : ORDER.index(stage) + 1]:
        entry = latest(scene, name)
        if entry is None or not _has_outputs(scene, name):
            continue
        now = _outputs(scene, name)
        changed = [n for n, hash_ in entry["outputs"].items() if n in now and now[n] not in (hash_, None)]
        again = f"expected what `sattools {name}` left (run it again with --overwrite)"
        if changed:
            other = _OF_ANOTHER_TOOL.get(name, "")
            return f"found another file for {changed[0]} than the history knows, {again}{other}"
        if _inputs(scene, name, entry["items"]) != entry["inputs"]:
            gone = _gone(scene, name, entry["items"])
            if gone is not None:
                return f"found no {gone} any more, of which {name} was made, expected it there"
            return f"found that what {name} was made from has changed since, {again}"
    return None


def _is_before(command: str | None, stage: str) -> bool:
    if command in SOURCES:
        return True
    return command in STAGES and stage in STAGES and ORDER.index(command) < ORDER.index(stage)


def _is_void(old: str | None, command: str) -> bool:
    """Whether what a command has made gives way when another one runs."""
    return old == command or (old in STAGES and _is_before(command, old))


def _has_outputs(scene: Scene, stage: str) -> bool:
    made = STAGES[stage]
    return any(n in scene.products for n in made.products) or any(
        name in item.assets for item in scene.items for name in made.assets
    )


def _outputs(scene: Scene, stage: str) -> dict[str, str | None]:
    """Digest of every file that a stage has left, by the name of the product or `item/asset`."""
    made = STAGES[stage]
    hrefs = {name: href for name, href in scene.products.items() if name in names_of(made)}
    hrefs |= {f"{i.id}/{name}": i.assets[name].href for i in scene.items for name in made.assets if name in i.assets}
    return {name: digest(scene.path(href)) for name, href in hrefs.items()}


def names_of(made: Stage) -> set[str]:
    """Products that a stage may leave, their standard deviations included."""
    return {*made.products, *(f"{name}_std" for name in made.products)}


def _inputs(scene: Scene, stage: str, ids: Sequence[str], read: Seen = MappingProxyType({})) -> str:
    """Hash of what a stage reads.

    For matching and fitting that is the images with their cameras and suns, else the products of the stage before.
    What was seen of an image before counts for what is there now.
    """
    what: list[Any] = [stage]
    if stage in ("normalise", "prior", "fit"):
        if stage != "normalise":
            # as the document gives them back: 0 and 0.0 are one
            what += [Grid.from_dict(scene.grid.to_dict()).to_dict() if scene.grid else None]
            what += [float(z) for z in scene.height_range_m or ()]
        what += [read.get(item.id) or _image(scene, item, stage) for item in scene.items if item.id in ids]
    if stage == "fit":
        what.append(_outputs(scene, "prior"))
    elif stage == "export":
        what.append(_outputs(scene, "fit").get("model"))
    elif stage == "compare":
        what.append(_outputs(scene, "export"))
    return hashlib.sha256(json.dumps(what, sort_keys=True, default=str).encode()).hexdigest()


def _gone(scene: Scene, stage: str, ids: Sequence[str]) -> Path | None:
    """The first image, camera or map that a stage has read and that is not there any more."""
    hrefs = []
    if stage in ("normalise", "prior", "fit"):
        items = [item for item in scene.items if item.id in ids]
        hrefs = [i.assets[name].href for i in items for name in (_pixels(i, stage), "rpc") if name in i.assets]
    if stage in ("fit", "export"):
        before = names_of(STAGES["prior"]) if stage == "fit" else {"model"}
        hrefs += [href for name, href in scene.products.items() if name in before]
    paths = (scene.path(href) for href in hrefs)
    return next((path for path in paths if not (isinstance(path, RemotePath) or path.exists())), None)


def _pixels(item: Item, stage: str) -> str:
    return "radiance" if stage != "normalise" and "radiance" in item.assets else "image"


def _image(scene: Scene, item: Item, stage: str) -> list[Any]:
    names = _pixels(item, stage), "rpc"
    own = [digest(scene.path(item.assets[n].href)) if n in item.assets else None for n in names]
    # `normalise` says by properties what its numbers are
    others = {FIT_ROLE, "sattools:role"}
    if stage == "normalise":
        others |= {"sattools:radiance", "sattools:tone", "sattools:atmosphere"}
    properties = {k: v for k, v in item.properties.items() if k not in others}
    return [item.id, *own, properties]


__all__ = [
    "ALBEDO_SECONDS", "EARLIER_SECONDS", "IMAGES", "MADE", "PRIOR_SECONDS", "SOURCES", "STAGES", "Seen", "begin",
    "check_current", "current_entry", "drop", "files_of", "image_digests", "in_force", "latest", "left_behind",
    "may_begin", "names_of", "outdated_by", "record", "seen", "stale",
]  # fmt: skip
