"""Links, pictures and the architecture's map lead where they say."""

from __future__ import annotations

import ast
import re
from pathlib import Path

import pytest

from dcc_jax.env.config import EnvConfig
from dcc_jax.env.environment import imitation
from dcc_jax.tasks import TASKS

ROOT = Path(__file__).resolve().parents[1]
SOURCE = ROOT / "src" / "dcc_jax"
DOCS = ROOT / "docs"
PAGES = [ROOT / "README.md", *sorted(DOCS.rglob("*.md"))]
LINK = re.compile(r"\[[^]]*\]\(([^)\s]+)\)")
FENCE = re.compile(r"^```.*?^```$", re.MULTILINE | re.DOTALL)
MAP = (DOCS / "architecture.md").read_text()
PLACE = re.compile(r"`((?:[\w]+/)*\w+\.py)(?::(\w+))?`")
EQUATION = re.compile(r"^\| Eq\. \((\d+)\) \| [^|]* \| ([^|]*) \| ([^|]*) \|$", re.M)
EQUATIONS = 14  # of the paper


def prose(page: Path) -> str:
    return FENCE.sub("", page.read_text())


def links(page: Path) -> list[str]:
    return [link for link in LINK.findall(prose(page)) if "://" not in link]


def headings(page: Path) -> set[str]:
    """Anchors of a page, as GitHub makes them."""
    titles = re.findall(r"^#+ (.*)$", prose(page), re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", t.lower()).replace(" ", "-") for t in titles}


def home(path: str) -> Path:
    """A file of the map: of the package, or of the tests."""
    return (ROOT if path.startswith(("tests/", "tools/")) else SOURCE) / path


def defined(path: Path) -> set[str]:
    """Functions and classes of a file, those of its classes included."""
    kinds = ast.FunctionDef, ast.ClassDef
    return {
        n.name for n in ast.walk(ast.parse(path.read_text())) if isinstance(n, kinds)
    }


def by_path(page: Path) -> str:
    return str(page.relative_to(ROOT))


@pytest.mark.parametrize("page", PAGES, ids=by_path)
def test_links_and_pictures_of_a_page_resolve(page):
    for link in links(page):
        path, _, anchor = link.partition("#")
        target = (page.parent / path).resolve() if path else page
        assert target.exists(), link
        assert not anchor or anchor in headings(target), link


@pytest.mark.parametrize("page", PAGES, ids=by_path)
def test_files_that_a_page_names_exist(page):
    named = re.findall(
        r"`((?:src|tests|docs|assets|tools|experiments)/[^`\s:*]+)`", prose(page)
    )
    assert [name for name in named if not (ROOT / name).exists()] == []


def test_every_page_is_reached_from_the_readme():
    reached, ahead = set(), [ROOT / "README.md"]
    while ahead:
        page = ahead.pop()
        if page in reached:
            continue
        reached.add(page)
        targets = [
            (page.parent / link.partition("#")[0]).resolve() for link in links(page)
        ]
        ahead += [target for target in targets if target.suffix == ".md"]
    assert set(PAGES) <= reached


def test_every_skill_has_a_page_with_its_sections_and_its_place_in_the_tables():
    assert {page.stem for page in (DOCS / "skills").glob("*.md")} == set(TASKS)
    for name in TASKS:
        page = (DOCS / "skills" / f"{name}.md").read_text()
        for part in (
            f"# {name}:",
            "## Numbers",
            "## What is weak",
            "Taught by",
            "![",
            "```\ndcc-jax",
        ):
            assert part in page, (name, part)
        for table in (ROOT / "README.md", DOCS / "results.md"):
            assert f"skills/{name}.md" in table.read_text()


@pytest.mark.parametrize("name", list(TASKS))
def test_a_page_says_by_what_its_skill_is_taught(name):
    judge = imitation(TASKS[name](), EnvConfig())
    taught = "tracking" if judge == "tracking" else "discriminator"
    row = rf"\[{name}\]\([^)]*\) \| {taught} \|"
    assert re.search(row, (ROOT / "README.md").read_text())
    page = (DOCS / "skills" / f"{name}.md").read_text()
    assert re.search(rf"^\| Taught by \| (the )?{taught}", page, re.MULTILINE)


def test_the_map_names_functions_and_tests_that_exist():
    places = PLACE.findall(MAP)
    assert len(places) > 60, "it is a table of all"
    for path, name in places:
        if "/" in path or (SOURCE / path).exists():
            assert home(path).is_file(), path
            assert not name or name in defined(home(path)), f"{path}:{name}"


def test_each_equation_is_on_the_map_and_is_found_by_one_grep_at_its_code():
    rows = EQUATION.findall(MAP)
    assert [int(number) for number, _, _ in rows] == list(range(1, EQUATIONS + 1))
    for number, code, test in rows:
        cited = re.compile(rf"Eq\. \({number}\)")
        places = PLACE.findall(code)
        assert places and all(cited.search(home(p).read_text()) for p, _ in places)
        assert any(path.startswith("tests/") for path, _ in PLACE.findall(test))
