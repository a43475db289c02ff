"""Links between the Markdown pages lead somewhere, headings included; the notebook's rows are in order."""

import ast
import re
import tomllib
from functools import cache
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
PAGES = [*ROOT.glob("*.md"), *(path for name in ("docs", "examples", "models") for path in (ROOT / name).rglob("*.md"))]
NOTEBOOK = ROOT / "docs" / "notebook" / "README.md"


@pytest.mark.parametrize("page", sorted(PAGES), ids=lambda page: page.relative_to(ROOT).as_posix())
def test_links_lead_to_files_and_headings(page: Path):
    for target in links(page):
        if re.match(r"[a-z]+:", target):
            continue
        name, _, anchor = target.partition("#")
        path = (page.parent / name).resolve() if name else page
        assert path.is_file(), f"{page.name} links to {target}"
        if anchor and path.suffix == ".md":
            assert anchor in anchors(path), f"{page.name} links to {target}, where there is no such heading"


def test_the_notebook_s_rows_are_dated_in_order_and_say_what_became_of_them():
    sections = re.split(r"^## ", NOTEBOOK.read_text(), flags=re.MULTILINE)[1:]
    rows = {part.partition("\n")[0]: re.findall(r"^\| (20.*) \|$", part, re.MULTILINE) for part in sections}
    assert sum(map(len, rows.values())) > 90
    for section, lines in rows.items():
        cells = [re.split(r" \| ", line) for line in lines]
        assert all(re.match(r"20\d\d-\d\d-\d\d [0-9a-f]{7}$", row[0]) for row in cells), section
        assert [row[0][:10] for row in cells] == sorted(row[0][:10] for row in cells), section
        assert all(len(row) == 4 and re.match("kept|not kept|mended|open", row[3]) for row in cells), section


def test_tables_beside_pages_ship_with_them():
    shipped = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["setuptools"]["data-files"]
    patterns = [pattern for each in shipped.values() for pattern in each]
    assert {path for pattern in patterns for path in ROOT.glob(pattern)} >= set((ROOT / "docs").rglob("*.csv"))


def test_headings_become_anchors_as_github_makes_them():
    assert anchor_of("2026-11-22: one scale of sigma, from the 95 % ellipse?") == (
        "2026-11-22-one-scale-of-sigma-from-the-95--ellipse"
    )
    assert anchor_of("Going on: `sigmaslam track INPUT --out run --resume`") == (
        "going-on-sigmaslam-track-input---out-run---resume"
    )
    assert anchor_of("[results.md](results.md) of *ours*") == "resultsmd-of-ours"


@pytest.mark.long
def test_messages_and_help_name_no_page_that_an_installed_package_lacks():
    named = []
    for path in (ROOT / "sigmaslam").rglob("*.py"):
        nodes = list(ast.walk(ast.parse(path.read_text())))
        docstrings = {id(node.value) for node in nodes if isinstance(node, ast.Expr)}
        texts = [node for node in nodes if isinstance(node, ast.Constant) and id(node) not in docstrings]
        named += [f"{path.name}: {text.value}" for text in texts if re.search(r"docs/|README", str(text.value))]
    assert not named


def links(page: Path) -> list[str]:
    """Targets of a page's links and pictures, outside code."""
    return re.findall(r"\]\(([^)\s]+)\)", re.sub(r"`[^`\n]*`", "", prose(page)))


@cache
def anchors(page: Path) -> set[str]:
    """Anchors of a page's headings; those that stand twice are counted."""
    found: set[str] = set()
    for heading in re.findall(r"^#+ (.*)$", prose(page), re.MULTILINE):
        anchor, count = anchor_of(heading), 0
        while anchor in found:
            count += 1
            anchor = f"{anchor_of(heading)}-{count}"
        found.add(anchor)
    return found


def anchor_of(heading: str) -> str:
    """GitHub's anchor of a heading."""
    text = re.sub(r"\[([^]]*)\]\([^)]*\)", r"\1", heading).strip()
    return re.sub(r"[^\w\- ]", "", text.lower()).replace(" ", "-")


def prose(page: Path) -> str:
    """A page without its blocks of code."""
    return re.sub(r"^```.*?^```$", "", page.read_text(encoding="utf-8"), flags=re.MULTILINE | re.DOTALL)
