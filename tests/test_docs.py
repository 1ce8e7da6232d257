"""The documentation's links lead somewhere, and its command pages are those of the commands."""

import re
from pathlib import Path
from typing import Any

import pytest

ROOT = Path(__file__).parents[1]
PAGES = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *sorted((ROOT / "docs").rglob("*.md"))]


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_links_between_pages_lead_to_files(page: Any) -> None:
    text = re.sub(r"(?m)^    .*$", "", page.read_text(encoding="utf-8"))
    links = re.findall(r"\]\(([^)#\s]+)(?:#[^)]*)?\)", text)
    # this page of the site is made of a file beside the folder
    files = [
        link.replace("contributing.md", "../CONTRIBUTING.md") if page.parent.name == "docs" else link for link in links
    ]
    missing = [link for link in files if "://" not in link and not (page.parent / link).exists()]
    assert missing == []


@pytest.mark.parametrize("page", [*PAGES, ROOT / "CHANGELOG.md"], ids=lambda page: str(page.relative_to(ROOT)))
def test_links_into_pages_lead_to_headings(page: Any) -> None:
    """On the site and on GitHub alike, which make one name of `a: --b` and of `a--b`, and two."""
    text = re.sub(r"(?m)^    .*$", "", page.read_text(encoding="utf-8"))
    links = [(name, heading) for name, heading in re.findall(r"\]\(([^)#\s]*)#([^)]+)\)", text) if "://" not in name]
    assert [link for link in links if link[1] not in _headings(page.parent / link[0] if link[0] else page)] == []


def test_scripts_and_tests_that_pages_name_are_there() -> None:
    """A benchmark was named that another one had replaced."""
    named = re.compile(r"\b(?:benchmarks|examples|tests|docs|sattools)/[\w./-]+\.(?:py|sh|md|ipynb|yaml|png|jpg)\b")
    found = {(page.name, name) for page in PAGES for name in named.findall(page.read_text(encoding="utf-8"))}
    assert len(found) > 100
    assert [pair for pair in sorted(found) if not (ROOT / pair[1]).exists()] == []


def _headings(page: Path) -> set[str]:
    """The names of a page's headings that mkdocs and GitHub agree on."""
    both = set()
    for heading in re.findall(r"(?m)^#+ (.*)$", page.read_text(encoding="utf-8")):
        github = re.sub(r"[^\w -]", "", heading.lower()).strip().replace(" ", "-")
        if github == re.sub(r"-+", "-", github):
            both.add(github)
    return both


def test_the_page_of_the_scene_document_names_all_that_an_image_has(make_town: Any) -> None:
    text = (ROOT / "docs" / "scene.md").read_text(encoding="utf-8")
    table = {name for line in text.splitlines() for name in re.findall(r"`([^`]+)`", line.split(" | ")[0])}
    for item in make_town().items:
        assert {*item.properties, *item.assets} - table == set()


def test_every_benchmark_that_can_be_run_is_named_on_a_page() -> None:
    text = "".join(page.read_text(encoding="utf-8") for page in PAGES)
    scripts = [p for p in sorted((ROOT / "benchmarks").glob("*.py")) if "__main__" in p.read_text(encoding="utf-8")]
    assert len(scripts) > 40
    # `threads.py` in a sentence about another one counts, `paper_threads.py` does not
    assert [p.name for p in scripts if not re.search(rf"\b{re.escape(p.name)}", text)] == []
