"""The scene document: a GeoJSON FeatureCollection of STAC Items with one `sattools` member.

It is what the commands hand to each other, one document per line (see docs/scene.md).
"""

from __future__ import annotations

import json
import math
import os
import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

from sattools.errors import InputError, SceneError, counted
from sattools.scene.folders import make_folder
from sattools.scene.globe import box_of_all
from sattools.scene.grid import Grid
from sattools.scene.jsonio import JsonObject, parse_json, read_text
from sattools.scene.location import check_allowed, is_remote, location
from sattools.scene.members import check_members
from sattools.scene.versions import FORMAT_VERSION, READABLE, upgraded

if TYPE_CHECKING:
    import xarray

FIT_ROLE = "sattools:fit_role"  # of an image that the last fit held out, whatever its role is
CHECKPOINT = "fit/checkpoint.safetensors"  # below a scene's folder: what an interrupted fit leaves
PARTS = "fit/tiles"  # below a scene's folder: those of its tiles, each a scene that reads what its whole has
COG_TYPE = "image/tiff; application=geotiff; profile=cloud-optimized"
GEOTIFF_TYPE = "image/tiff; application=geotiff"
STAC_EXTENSIONS = [
    "https://stac-extensions.github.io/projection/v2.0.0/schema.json",
    "https://stac-extensions.github.io/view/v1.0.0/schema.json",
]
_ID = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]{0,127}")


def check_id(value: str, what: str) -> str:
    """Return ``value`` if it can serve as a file name, else raise SceneError."""
    if not isinstance(value, str) or not _ID.fullmatch(value):
        raise SceneError(f"{what}: found id {value!r}, expected 1-128 letters of A-Z and a-z, digits, '.', '_' or '-'")
    return value


@dataclass
class Asset:
    """One file of an item: its href is relative to the scene's root, or absolute."""

    href: str
    type: str = COG_TYPE
    roles: list[str] = field(default_factory=lambda: ["data"])
    extra: dict[str, Any] = field(default_factory=dict)

    def to_dict(self) -> JsonObject:
        """STAC form."""
        return {"href": self.href, "type": self.type, "roles": self.roles, **self.extra}

    @classmethod
    def from_dict(cls, data: Mapping[str, Any]) -> Asset:
        """Inverse of `to_dict`."""
        rest = {k: v for k, v in data.items() if k not in ("href", "type", "roles")}
        return cls(str(data["href"]), str(data.get("type", COG_TYPE)), list(data.get("roles", ["data"])), rest)


@dataclass
class Item:
    """One image: a STAC Item (1.1)."""

    id: str
    geometry: dict[str, Any] | None
    bbox: list[float] | None
    properties: dict[str, Any]
    assets: dict[str, Asset] = field(default_factory=dict)

    @property
    def role(self) -> str:
        """``train``, ``test`` (held out) or ``unused`` (set aside, see `sattools prep`).

        That is the scene's word; a fit may hold out more, see `held_out`.
        """
        return str(self.properties.get("sattools:role", "train"))

    @property
    def held_out(self) -> bool:
        """Whether the last fit did not see the image."""
        return self.properties.get(FIT_ROLE, self.role) != "train"

    @property
    def sun(self) -> tuple[float, float] | None:
        """(azimuth, elevation) of the sun in degrees from true north and the horizon, or None if unknown."""
        azimuth = self.properties.get("view:sun_azimuth")
        elevation = self.properties.get("view:sun_elevation")
        if azimuth is None or elevation is None:
            return None
        return float(azimuth), float(elevation)

    def to_dict(self) -> JsonObject:
        """STAC form."""
        return {
            "type": "Feature",
            "stac_version": "1.1.0",
            "stac_extensions": STAC_EXTENSIONS,
            "id": self.id,
            "geometry": self.geometry,
            "bbox": self.bbox,
            "properties": self.properties,
            "links": [],
            "assets": {name: asset.to_dict() for name, asset in self.assets.items()},
        }

    @classmethod
    def from_dict(cls, data: Mapping[str, Any]) -> Item:
        """Inverse of `to_dict`; raises SceneError when a member is missing."""
        try:
            return cls(
                check_id(data["id"], "scene item"),
                data.get("geometry"),
                data.get("bbox"),
                dict(data["properties"]),
                {name: Asset.from_dict(asset) for name, asset in data.get("assets", {}).items()},
            )
        except (KeyError, TypeError, AttributeError) as error:
            raise SceneError(
                "scene item: found a feature without id, properties or assets, expected a STAC Item"
            ) from error


@dataclass
class Scene:
    """Images of one place with everything the commands have made of them.

    Attributes:
        id: name of the area of interest.
        root: absolute folder against which relative hrefs resolve and below which all outputs lie.
        items: one per image.
        grid: ground grid of the scene.
        height_range_m: lowest and highest ellipsoidal height to look for the surface [m].
        products: name -> href of scene-wide outputs (dsm, albedo, ...).
        history: one entry a command: options, seconds, peak memory, versions, notes.
        origin: file that the document was read from, None for one from a pipe.
        surroundings_m: of a tile, how far beyond its border it is matched [m]; None = as any area.
    """

    id: str
    root: Path
    items: list[Item] = field(default_factory=list)
    grid: Grid | None = None
    height_range_m: tuple[float, float] | None = None
    products: dict[str, str] = field(default_factory=dict)
    history: list[dict[str, Any]] = field(default_factory=list)
    origin: Path | None = None
    surroundings_m: float | None = None

    def __post_init__(self) -> None:
        check_id(self.id, "scene")
        self.root = Path(os.path.abspath(self.root))

    def __repr__(self) -> str:
        """In a line, as what a call in a notebook gives back is shown; `to_json` has everything."""
        images = counted(len(self.items), "images")
        return f"Scene({self.id!r}, {str(self.root)!r}, {images}, products {list(self.products)})"

    # ---- JSON -------------------------------------------------------------------------------------------

    def to_dict(self, root: str | None = None) -> JsonObject:
        """The document as plain JSON types; ``root`` in place of the absolute one."""
        boxes = [item.bbox for item in self.items if item.bbox]
        document: dict[str, Any] = {
            "type": "FeatureCollection",
            "id": self.id,
            "features": [item.to_dict() for item in self.items],
            "sattools": {
                "version": FORMAT_VERSION,
                "root": root or str(self.root),
                "grid": self.grid.to_dict() if self.grid else None,
                "height_range_m": list(self.height_range_m) if self.height_range_m else None,
                "products": self.products,
                "history": self.history,
            },
        }
        if self.surroundings_m is not None:
            document["sattools"]["surroundings_m"] = self.surroundings_m
        if boxes:
            document["bbox"] = box_of_all(boxes)
        return document

    def to_json(self, root: str | None = None) -> str:
        """The document in one line; ``root`` in place of the absolute one."""
        return json.dumps(_finite(self.to_dict(root)), ensure_ascii=False, separators=(",", ":"), allow_nan=False)

    @classmethod
    def from_json(cls, text: str, source: str = "<stdin>", folder: Path | None = None) -> Scene:
        """Parse a scene document.

        Args:
            text: the JSON.
            source: name for error messages.
            folder: what a relative `root` is relative to (the folder of the document); None = current folder.

        Raises:
            SceneError: not JSON, or not a scene document.
        """
        if not isinstance(text, str):
            raise SceneError(f"{source}: found {type(text).__name__}, expected the text of a scene document")
        try:
            data = parse_json(text, source, "a scene document")
        except InputError as error:
            raise SceneError(str(error)) from None
        if not isinstance(data, dict) or data.get("type") != "FeatureCollection" or "sattools" not in data:
            raise SceneError(
                f"{source}: found JSON without a 'sattools' member, expected a scene document "
                "(a FeatureCollection written by a sattools command)"
            )
        ours = data["sattools"]
        version = ours.get("version") if isinstance(ours, dict) else ours
        if isinstance(version, bool) or version not in READABLE:
            raise SceneError(f"{source}: found scene version {version!r}, expected {FORMAT_VERSION} or an older one")
        data = upgraded(data)
        ours = data["sattools"]
        if not isinstance(data.get("features"), list):
            raise SceneError(f"{source}: found no list of features, expected a FeatureCollection of STAC Items")
        try:
            check_members(data)
            height_range = ours.get("height_range_m")
            scene = cls(
                id=data.get("id", ""),
                root=_root(ours.get("root", "."), data, folder),
                items=[Item.from_dict(feature) for feature in data["features"]],
                grid=Grid.from_dict(ours["grid"]) if ours.get("grid") else None,
                height_range_m=(float(height_range[0]), float(height_range[1])) if height_range else None,
                products=dict(ours.get("products") or {}),
                history=list(ours.get("history") or []),
                surroundings_m=ours.get("surroundings_m"),
            )
        except (InputError, SceneError) as error:
            raise SceneError(f"{source}: {error}") from None
        ids = [item.id for item in scene.items]
        twice = {i for i in ids if ids.count(i) > 1}
        if twice:
            raise SceneError(f"{source}: found item id {sorted(twice)[0]!r} more than once, expected unique ids")
        return scene

    @classmethod
    def from_file(cls, path: Path | str) -> Scene:
        """Read a `scene.json`; a relative root is relative to the file's folder.

        A folder that was moved is found again: where the recorded root is not there any more, or the document lies
        beside the files it names, the root is the folder of the document.
        """
        if not isinstance(path, str | os.PathLike):
            raise SceneError(f"found {type(path).__name__}, expected the path of a scene document")
        if not str(path):  # of a variable that is not set; it would be the current folder
            raise SceneError("found an empty text, expected the path of a scene document")
        try:
            text = read_text(path)
        except InputError as error:
            if os.path.isdir(path):  # of names that are too long, `Path.is_dir` has an error of its own
                inside = [*Path(path).glob("scene.json"), *sorted(Path(path).glob("*/scene.json"))]
                wanted = f"the scene document {inside[0]}" if inside else "a scene document"
                raise SceneError(f"{path}: found a folder, expected {wanted}") from None
            raise SceneError(f"{error} with a scene document") from None
        scene = cls.from_json(text, str(path), Path(os.path.abspath(path)).parent)
        scene.origin = Path(os.path.abspath(path))  # a program may go to another folder
        return scene

    def write(self) -> Path:
        """Write `scene.json` below the root, complete or not at all; its path.

        Its root is ".", so that the folder can be moved and sent to others.
        """
        from sattools.scene.files import write_text

        path = self.output("scene.json")
        write_text(path, self.to_json(root=".") + "\n")
        return path

    # ---- files ------------------------------------------------------------------------------------------

    @property
    def is_part(self) -> bool:
        """Whether this is a tile or a pilot tile, in the folder of the scene of which it is one."""
        return self.root.parent.match(f"*/{PARTS}")

    def path(self, href: str) -> Path:
        """Absolute path of ``href`` for reading: relative hrefs must stay below the root, or that of its whole.

        Raises:
            SceneError: a relative href that leaves it, or one that asks for the network or an archive while the
                user has not allowed that (`--allow-remote`).
        """
        if is_remote(href):
            try:
                check_allowed(href)
            except InputError as error:
                raise SceneError(f"scene {self.id}: {error}") from None
            return location(href)
        if Path(href).is_absolute():
            return Path(href)
        return self._below(self._whole_root(), href)

    def _whole_root(self) -> Path:
        """The folder of the scene of which this is a part, such as a tile; the scene's own where it is none."""
        return self.root.parents[2] if self.is_part else self.root

    def output(self, relative: str) -> Path:
        """Absolute path below the root for writing; makes its folder.

        Whether it may be written is for `scene.dependencies.begin` to say.

        Raises:
            SceneError: the path would leave the root (absolute, `..`, or through a symbolic link).
        """
        if Path(relative).is_absolute():
            raise SceneError(f"{relative}: found an absolute output path, expected one below {self.root}")
        path = self._below(self.root, relative)
        try:
            make_folder(path.parent)
        except OSError as error:
            raise SceneError(f"{path.parent}: cannot be made ({error.strerror}), expected a writable root") from error
        return path

    def _below(self, folder: Path, relative: str) -> Path:
        # a whole is where its part's folder seems to be, through whatever links
        path = self.root / relative if folder == self.root else Path(os.path.normpath(self.root / relative))
        if not path.resolve().is_relative_to(folder.resolve()):
            raise SceneError(f"{relative}: leads outside the scene's root {folder}, expected a path below it")
        return path

    def product(self, name: str) -> xarray.DataArray:
        """A product (`dsm`, `albedo`, `w`, `validity`, ...) as ``xarray.DataArray`` in rioxarray's convention.

        Raises:
            SceneError: the scene has no such product.
            SattoolsError: xarray is not installed.
        """
        from sattools.scene.xarrays import data_array

        if name not in self.products:
            raise SceneError(
                f"scene {self.id}: found no product {name!r}, expected one of {', '.join(self.products) or 'none yet'}"
            )
        return data_array(self.path(self.products[name]), name)

    def dsm(self) -> xarray.DataArray:
        """The surface model ``(y, x)`` [m]; see `product`."""
        return self.product("dsm")

    def train_items(self) -> list[Item]:
        """Items that are not held out."""
        return [item for item in self.items if item.role == "train"]

    def require_grid(self) -> Grid:
        """The grid; SceneError when the scene has none yet."""
        if self.grid is None:
            raise SceneError(f"scene {self.id}: found no grid, expected one made by `sattools prep`")
        return self.grid

    def require_height_range(self) -> tuple[float, float]:
        """The height range; SceneError when the scene has none yet."""
        if self.height_range_m is None:
            raise SceneError(f"scene {self.id}: found no height range, expected one made by `sattools prep`")
        return self.height_range_m


def _root(recorded: str, document: Mapping[str, Any], folder: Path | None) -> Path:
    """The root of a document: as recorded, or the document's own folder where that is what is meant."""
    root = Path(recorded)
    if folder is None or not root.is_absolute():
        return (folder or Path.cwd()) / root
    hrefs = [a["href"] for feature in document["features"] for a in feature["assets"].values()]
    relative = [href for href in hrefs if not is_remote(href) and not Path(href).is_absolute()]
    try:
        if not root.is_dir():
            return folder
        # a copy of a folder whose original is still there must not work on the original
        return folder if relative and all((folder / href).exists() for href in relative) else root
    except OSError as error:  # a name that is too long
        raise SceneError(f"sattools.root or an href: found {error.strerror}, expected paths of files") from None


def _finite(value: Any) -> Any:
    """JSON has no NaN: non-finite numbers become null."""
    if isinstance(value, dict):
        return {k: _finite(v) for k, v in value.items()}
    if isinstance(value, list | tuple):
        return [_finite(v) for v in value]
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value


__all__ = ["CHECKPOINT", "COG_TYPE", "FIT_ROLE", "GEOTIFF_TYPE", "PARTS", "Asset", "Item", "Scene", "check_id"]
