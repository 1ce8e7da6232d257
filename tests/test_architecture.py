"""Who may import whom: one way through the house, and heavy libraries only where they are needed."""

import ast
import functools
import re
from pathlib import Path
from typing import Any

import pytest

ROOT = Path(__file__).parents[1]
PACKAGE = ROOT / "sattools"
FILES = sorted(PACKAGE.rglob("*.py"))

# A room may import rooms of a lower floor and itself, nothing else. Rooms of one floor do not know each other, except
# where ALSO says so.
FLOORS = [
    {"arrays", "errors", "helpers", "processors", "progress", "settings", "system"},
    {"compiled", "runlog"},
    {"scene"},
    {"camera", "radiometry", "reflectance"},
    {"field", "views"},
    {"render"},
    {"prep", "prior", "fit", "export", "compare", "simulate"},
    {"align", "batch", "change"},
    {"report"},
    {"doctor", "slim"},
    {"api", "cli"},
]
FLOOR = {room: number for number, rooms in enumerate(FLOORS) for room in rooms}
# `radiometry` reads vendors' metadata with the camera's readers;
# `fit` makes a prior where the scene has none and can watch its error; `export` reads what `fit` wrote
ALSO = {("radiometry", "camera"), ("fit", "prior"), ("fit", "compare"), ("export", "fit")}


def room_of(path: Path) -> str:
    relative = path.relative_to(PACKAGE)
    return relative.parts[0] if len(relative.parts) > 1 else relative.stem


@functools.cache
def parsed(path: Path) -> ast.Module:
    return ast.parse(path.read_text(encoding="utf-8"))


@functools.cache
def nodes(path: Path) -> tuple[ast.AST, ...]:
    """All that a file's code consists of, for tests that must not change it."""
    return tuple(ast.walk(parsed(path)))


@functools.cache
def imports(path: Path) -> frozenset[str]:
    """All modules that a file imports, anywhere in it, by their full names."""
    found = set()
    for node in nodes(path):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path}: relative import"
            found |= {f"{node.module}.{alias.name}" for alias in node.names}
    return frozenset(found)


def top_level_imports(path: Path) -> set[str]:
    """Packages that are imported as soon as the file is, by their first names."""
    found = set()
    for node in parsed(path).body:
        if isinstance(node, ast.Import):
            found |= {alias.name.split(".")[0] for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            found.add((node.module or "").split(".")[0])
    return found


def rooms_imported(path: Path) -> set[str]:
    ours = (name.split(".") for name in imports(path) if name.startswith("sattools."))
    return {parts[1] for parts in ours} - {"__version__"}


def name(path: Path) -> str:
    return str(path.relative_to(ROOT))


def test_every_room_has_its_floor() -> None:
    rooms = {room_of(path) for path in FILES} - {"__init__", "__main__"}
    assert rooms - set(FLOOR) == set()


@pytest.mark.parametrize("path", FILES, ids=name)
def test_imports_point_one_way(path: Any) -> None:
    room = room_of(path)
    if room in ("__init__", "__main__"):
        return
    wrong = [
        other for other in rooms_imported(path) - {room} if FLOOR[other] >= FLOOR[room] and (room, other) not in ALSO
    ]
    assert wrong == []


@pytest.mark.parametrize(
    ("room", "forbidden"),
    [
        ("scene", {"torch", "click"}),
        ("camera", {"torch", "click"}),
        ("radiometry", {"torch", "click"}),
        ("prep", {"torch", "click"}),
        ("compare", {"click"}),
        ("simulate", {"torch", "click"}),
        ("reflectance", {"rasterio", "click"}),
        ("render", {"rasterio", "click"}),
        ("field", {"rasterio", "click"}),
        ("fit", {"rasterio", "click"}),
        ("export", {"click"}),
        ("batch", {"click", "torch"}),
        ("report", {"click", "torch", "rasterio"}),
        ("cli", {"numpy", "torch", "scipy", "rasterio", "math"}),
    ],
)
def test_rooms_do_without_what_is_not_their_business(room: Any, forbidden: Any) -> None:
    found = {n.split(".")[0] for path in FILES if room_of(path) == room for n in imports(path)}
    assert found & forbidden == set()


def test_the_simulator_shares_no_code_with_what_it_tests() -> None:
    used = set().union(*(rooms_imported(path) for path in FILES if room_of(path) == "simulate"))
    assert used & {"render", "field", "fit", "prior", "reflectance", "views", "export"} == set()


def test_the_renderer_knows_no_optimiser_and_the_fit_no_command() -> None:
    for path in FILES:
        text = path.read_text(encoding="utf-8")
        if room_of(path) in ("render", "field", "reflectance"):
            assert "torch.optim" not in text, path


@pytest.mark.parametrize("path", FILES, ids=name)
def test_modules_stay_short(path: Any) -> None:
    assert len(path.read_text(encoding="utf-8").splitlines()) < 400


def test_the_plugin_does_not_import_the_package() -> None:
    # inside the plugin imports are relative, as QGIS chooses the folder's name
    for path in (ROOT / "qgis_plugin").rglob("*.py"):
        assert not re.search(r"^\s*(import|from) sattools\b", path.read_text(encoding="utf-8"), re.MULTILINE), path


@pytest.mark.parametrize("path", FILES, ids=name)
def test_nothing_unpickles_or_runs_a_shell(path: Any) -> None:
    assert not [n for n in imports(path) if n.split(".")[0] in ("pickle", "shelve", "marshal")]
    for node in nodes(path):
        if isinstance(node, ast.keyword):
            assert not (node.arg == "shell" and getattr(node.value, "value", None) is True)
        if isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name):
            assert (node.value.id, node.attr) not in (("torch", "load"), ("os", "system"))


def test_command_modules_start_with_the_frame_only() -> None:
    """What a command's module imports at once is paid by every `--help` and every completion."""
    for path in (PACKAGE / "cli").glob("*.py"):
        heavy = {"torch", "geopandas", "matplotlib", "numba", "cv2", "skimage", "erfa", "shapely"}
        assert top_level_imports(path) & heavy == set(), path


# Files that name modules in texts which they do not import on their own account, and why that makes no circle.
NAMED_IN_TEXTS = {
    "sattools": "the way in, there before any module: it gets the functions when somebody asks for them",
    "sattools.fit.tiles.crew": "tiles are fitted in processes of their own, that import `fit.tiles.helper`",
    "sattools.batch.launch": "commands run in processes of their own, that import `cli.forking`",
}


@functools.cache
def modules() -> dict[str, Path]:
    """All files of the package by the full names of their modules."""
    return {full_name(path): path for path in FILES}


@functools.cache
def modules_used(path: Path) -> frozenset[str]:
    """Modules of the package that a file imports or names in a text, also inside functions.

    What only types need does not count. Whoever imports a module imports the packages that it lies in, too.
    """
    known = modules()
    typing_only = {
        id(inner)
        for node in nodes(path)
        if isinstance(node, ast.If) and isinstance(node.test, ast.Name) and node.test.id == "TYPE_CHECKING"
        for inner in ast.walk(node)
    }
    found = set()
    for node in nodes(path):
        if id(node) in typing_only:
            continue
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module:
            for alias in node.names:
                full = f"{node.module}.{alias.name}"
                found.add(full if full in known else node.module)
        elif isinstance(node, ast.Constant) and isinstance(node.value, str) and full_name(path) not in NAMED_IN_TEXTS:
            found.add(node.value)
    around = {full_name(above / "__init__.py") for above in path.parents if above.is_relative_to(PACKAGE)}
    found = {name for name in found if name in known}
    packages = {name.rsplit(".", levels)[0] for name in found for levels in range(1, name.count(".") + 1)}
    return frozenset(found | (packages & known.keys() - around))


def full_name(path: Path) -> str:
    return ".".join(path.relative_to(ROOT).with_suffix("").parts).removesuffix(".__init__")


def on_circles(graph: dict[str, set[str]]) -> list[str]:
    """Who uses itself through others, and who uses one of those."""
    graph = {one: used - {one} for one, used in graph.items()}
    while leaves := [one for one, used in graph.items() if not used & graph.keys()]:
        for one in leaves:
            del graph[one]
    return sorted(graph)


def test_no_module_imports_itself_through_others_not_even_inside_a_function() -> None:
    """`fit` imported `compare`, that a helper which looked up `sattools.api` by its name, and that `fit`."""
    assert on_circles({module: set(modules_used(path)) for module, path in modules().items()}) == []


def test_no_room_imports_itself_through_others_not_even_inside_a_function() -> None:
    rooms: dict[str, set[str]] = {}
    for path in FILES:
        used = {room_of(modules()[module]) for module in modules_used(path)}
        rooms.setdefault(room_of(path), set()).update(used)
    assert on_circles(rooms) == []


def test_a_circle_is_found_with_whoever_leads_to_it() -> None:
    assert on_circles({"a": {"b"}, "b": {"c"}, "c": {"a"}, "above": {"a"}, "leaf": set()}) == ["a", "above", "b", "c"]


def test_files_that_name_modules_in_texts_are_there() -> None:
    assert NAMED_IN_TEXTS.keys() <= {full_name(path) for path in FILES}


def declared(path: Path) -> set[str] | None:
    """What a file's `__all__` says that it is for others; None where it has none."""
    for node in parsed(path).body:
        if isinstance(node, ast.Assign) and getattr(node.targets[0], "id", "") == "__all__":
            return set(ast.literal_eval(node.value))
    return None


def test_what_other_modules_import_is_declared() -> None:
    """A reader of `__all__` must be able to trust that all else may be changed."""
    known = modules()
    names = {module: declared(path) for module, path in known.items()}
    hidden = set()
    for path in FILES:
        for node in nodes(path):
            if not isinstance(node, ast.ImportFrom) or (own := names.get(node.module or "")) is None:
                continue
            taken = {alias.name for alias in node.names if f"{node.module}.{alias.name}" not in known}
            hidden |= {f"{node.module}.{name}" for name in taken - own}
    assert sorted(hidden) == []
