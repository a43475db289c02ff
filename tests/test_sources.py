"""The table of sources names the whole chapter, and functions, commands and tests that are there."""

from __future__ import annotations

import csv
import re
from importlib import import_module
from pathlib import Path

import pytest
import typer

from sigmaslam.cli.commands import app

ROOT = Path(__file__).resolve().parents[1]
SECTIONS = {"9.1", "9.2", "9.2.1", "9.2.2", "9.2.3", "9.2.3.1", "9.2.3.2", "9.2.3.3"}
SECTIONS |= {"9.3", "9.3.1", "9.3.2", "9.4", "9.5", "9.5.1", "9.5.2", "9.6"}
EQUATIONS, TABLES, FIGURES = 45, 2, 9


def rows() -> list[list[str]]:
    found = list(csv.reader((ROOT / "docs" / "sources.csv").read_text().splitlines()))
    assert found[0] == ["chapter", "what", "function", "command", "test"]
    return found[1:]


def numbered(cell: str) -> set[int]:
    """Numbers of equations: (9.1) - (9.7) stands for seven of them."""
    found = set()
    for first, last in re.findall(r"\(9\.(\d+)\)(?: - \(9\.(\d+)\))?", cell):
        found |= set(range(int(first), int(last or first) + 1))
    return found


def test_every_section_equation_table_and_figure_has_a_row():
    cells = [row[0] for row in rows()]
    assert set().union(*map(numbered, cells)) == set(range(1, EQUATIONS + 1))
    text = " ; ".join(cells)
    figures = {
        number for group in re.findall(r"Figs?\. ([0-9., ]*[0-9])", text) for number in re.findall(r"9\.(\d)", group)
    }
    assert figures == {str(number) for number in range(1, FIGURES + 1)}
    tables = {
        number for group in re.findall(r"Tables? ([0-9., ]*[0-9])", text) for number in re.findall(r"9\.(\d)", group)
    }
    assert tables == {str(number) for number in range(1, TABLES + 1)}
    named = {part.strip() for cell in cells for part in cell.split(",")}
    assert not SECTIONS - named


@pytest.mark.parametrize("row", rows(), ids=lambda row: f"{row[0]} {row[1]}"[:40])
def test_what_a_row_names_is_there(row: list[str]):
    _, _, functions, commands, tests = row
    names = re.findall(r"`([^`]+)`", functions)
    assert names
    for name in names:
        assert resolved(name) is not None, name
    known = typer.main.get_command(app).commands
    for first, second in re.findall(r"`sigmaslam ([a-z-]+)(?: ([a-z-]+))?[^`]*`", commands):
        assert first in known
        assert not second or second in known[first].commands
    paths = re.findall(r"`([^`]+)`", tests)
    assert paths
    for path in paths:
        assert (ROOT / path).is_file(), path


def resolved(name: str) -> object:
    """What a dotted name stands for: a module as far as it goes, then attributes; None if there is no such thing."""
    parts = name.split(".")
    for length in range(len(parts), 0, -1):
        try:
            found: object = import_module(".".join(parts[:length]))
        except ModuleNotFoundError:
            continue
        for attribute in parts[length:]:
            found = getattr(found, attribute, None)
        return found
    return None
