"""The table of the rules of acceptance says what the object holds."""

import csv
import re
from dataclasses import fields
from fractions import Fraction
from pathlib import Path

from sigmaslam.estimation.acceptance import ACCEPTANCE, Acceptance

ROOT = Path(__file__).resolve().parents[3]
with (ROOT / "docs" / "acceptance.csv").open(encoding="utf-8") as table:
    ROWS = [row[1:] for row in csv.reader(table)][1:]


def test_the_page_lists_exactly_the_rules_and_their_values():
    listed = {name: float(Fraction(value)) for name, value, *_ in ROWS}
    assert len(listed) == len(ROWS)
    assert listed == {field.name: getattr(ACCEPTANCE, field.name) for field in fields(ACCEPTANCE)}


def test_each_rule_acts_in_the_file_that_the_page_names_and_in_no_other():
    sources = {path: path.read_text() for folder in ("sigmaslam", "models") for path in (ROOT / folder).rglob("*.py")}
    for name, _, _, place, *_ in ROWS:
        named = ROOT / place if place.startswith("models/") else ROOT / "sigmaslam" / place
        assert [path for path, source in sources.items() if f"ACCEPTANCE.{name}" in source] == [named], name


def test_each_rule_has_a_line_of_its_own_with_its_reason():
    lines = re.findall(r"^        (\w+): (.+)$", Acceptance.__doc__ or "", re.MULTILINE)
    assert {name for name, _ in lines} == {field.name for field in fields(Acceptance)}
