"""Figures of the code's own house: sizes, arguments, documentation, import circles, as Markdown.

    python benchmarks/house.py [--list]

Counted over the package; compiled kernels (functions under `njit`) are excepted where the table says so. `--list` names
what exceeds a limit.
"""

from __future__ import annotations

import argparse
import ast
import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).parents[1]
PACKAGE = ROOT / "sattools"
LONG, LONGEST, POSITIONAL, MODULE = 60, 80, 6, 400
ARRAY = re.compile(r"\b(np\.ndarray|NDArray|Tensor|Array)\b")
UNIT_WORDS = """metres? degrees? radians? pixels? cells? seconds? counts? number indices index mask bool codes? weights?
    shares? radiances? albedo BRF reflectance normals? visibility correlations? agreements? costs? colours? DN unbounded
    unitless"""
UNIT = re.compile(
    r"\[(m|px|degrees|cells|1|s|m/m|MB)\]|\bunit vectors?\b|in \[0, 1\]|pi L / E|"
    r"\b(" + "|".join(UNIT_WORDS.split()) + r")\b"
)


@dataclass(frozen=True)
class Function:
    """A function of the package."""

    where: str
    node: ast.FunctionDef
    kernel: bool
    method: bool
    public: bool

    @property
    def lines(self) -> int:
        """Lines of the body and its signature, without decorators and the docstring."""
        first = self.node.body[0]
        doc = (first.end_lineno or 0) - first.lineno + 1 if ast.get_docstring(self.node) is not None else 0
        return (self.node.end_lineno or 0) - self.node.lineno + 1 - doc

    @property
    def parameters(self) -> list[ast.arg]:
        """Positional and keyword parameters, without ``self``."""
        every = [*self.node.args.posonlyargs, *self.node.args.args, *self.node.args.kwonlyargs]
        return every[1:] if self.method and every and every[0].arg in ("self", "cls", "ctx") else every

    @property
    def command(self) -> bool:
        """Whether it is a command of the command line."""
        return any("click.command" in ast.unparse(d) for d in self.node.decorator_list)

    @property
    def positional(self) -> int:
        """Number of parameters that may be given by position."""
        return len(self.parameters) - len(self.node.args.kwonlyargs)

    @property
    def doc(self) -> str:
        """The docstring, empty if there is none."""
        return ast.get_docstring(self.node) or ""

    @property
    def documents_args(self) -> bool:
        """Whether the docstring has a section with every parameter's name."""
        if self.doc.startswith("See `") or "arguments as of `" in self.doc.lower():
            return True  # those of the parent, or of the function whose twin it is
        section = re.search(r"(?ms)^Args:\n(.*?)(^\S|\Z)", self.doc)
        named = re.findall(r"(?m)^\s+([\w, *]+?):", section[1]) if section else []
        return {a.arg for a in self.parameters} <= {name.strip(" *") for names in named for name in names.split(",")}

    @property
    def takes_arrays(self) -> bool:
        """Whether a parameter or the result is an array."""
        notes = [a.annotation for a in self.parameters] + [self.node.returns]
        return any(note is not None and ARRAY.search(ast.unparse(note)) for note in notes)


def functions() -> Iterator[Function]:
    """All functions of the package; those inside other functions belong to these."""
    for path in sorted(PACKAGE.rglob("*.py")):
        tree = ast.parse(path.read_text(encoding="utf-8"))
        for parent in ast.walk(tree):
            if not isinstance(parent, ast.Module | ast.ClassDef):
                continue
            for node in parent.body:
                if isinstance(node, ast.FunctionDef):
                    kernel = any("jit" in ast.unparse(d) for d in node.decorator_list)
                    method = isinstance(parent, ast.ClassDef)
                    hidden = node.name.startswith("_") or (
                        isinstance(parent, ast.ClassDef) and parent.name.startswith("_")
                    )
                    where = f"{path.relative_to(ROOT)}:{node.lineno} {node.name}"
                    yield Function(where, node, kernel, method, not hidden)


def untyped_dicts(function: Function) -> int:
    """How often the signature says ``dict[str, Any]``."""
    notes = [a.annotation for a in function.parameters] + [function.node.returns]
    return sum(ast.unparse(note).count("dict[str, Any]") for note in notes if note is not None)


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--list", action="store_true", help="name what exceeds a limit")
    options = parser.parse_args()
    every = list(functions())
    plain = [f for f in every if not f.kernel]
    # a command's docstring is its help, which lists the options
    public = [f for f in plain if f.public and len(f.parameters) >= 3 and not f.command]
    arrays = [f for f in plain if f.public and f.takes_arrays]
    texts = {path: path.read_text(encoding="utf-8") for path in sorted(PACKAGE.rglob("*.py"))}
    modules = [
        f"{path.relative_to(ROOT)} {len(text.splitlines())}"
        for path, text in texts.items()
        if len(text.splitlines()) >= MODULE
    ]
    meta = [
        f"{path.relative_to(ROOT)} {n}"
        for path, text in texts.items()
        if (n := len(re.findall(r"(?<!\.)\bmeta\[\"", text)))
    ]
    dicts = [f"{f.where} {n}" for f in every if (n := untyped_dicts(f))]
    without_args = [f.where for f in public if not f.documents_args]
    without_units = [f.where for f in arrays if not UNIT.search(f.doc)]
    rows: list[tuple[str, str, list[str]]] = [
        ("modules", f"{len(texts)}, {len(modules)} of {MODULE} lines or more", modules),
        ("`dict[str, Any]` in signatures", str(sum(untyped_dicts(f) for f in every)), dicts),
        ('`meta["..."]`', str(sum(len(re.findall(r"(?<!\.)\bmeta\[\"", text)) for text in texts.values())), meta),
    ]
    for limit in (LONG, LONGEST):
        long = [f"{f.where} {f.lines}" for f in plain if f.lines > limit]
        rows.append((f"functions over {limit} lines (not njit)", f"{len(long)} of {len(plain)}", long))
    wide = [f"{f.where} {f.positional}" for f in plain if f.positional > POSITIONAL]
    rows += [
        (f"functions of more than {POSITIONAL} positional parameters (not njit)", f"{len(wide)} of {len(plain)}", wide),
        ("public functions of 3 parameters or more that document Args", share(public, without_args), without_args),
        ("public functions of arrays that say units", share(arrays, without_units), without_units),
    ]
    print("| what | count |\n|---|---|")
    for name, count, names in rows:
        print(f"| {name} | {count} |")
        if options.list:
            print("".join(f"    {n}\n" for n in names), end="")


def share(every: list[Function], without: list[str]) -> str:
    """How many of them are not in the list, as text."""
    return f"{len(every) - len(without)} of {len(every)} ({100 * (1 - len(without) / max(1, len(every))):.0f} %)"


if __name__ == "__main__":
    main()
