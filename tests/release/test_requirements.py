"""What pyproject.toml asks for and what requirements.lock pins agree, and all files name one version."""

import re
import tomllib
from pathlib import Path

import pytest
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

ROOT = Path(__file__).resolve().parents[2]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
LOCK = {
    canonicalize_name(name): version
    for name, version in (line.split("==") for line in (ROOT / "requirements.lock").read_text().splitlines())
}
EXTRAS = PROJECT["optional-dependencies"]


def test_packages_citation_and_change_log_name_one_version():
    releases = re.findall(r"^## (\S+)(?: \((\d{4}-\d{2}-\d{2})\))?$", (ROOT / "CHANGELOG.md").read_text(), re.MULTILINE)
    version, day = next(each for each in releases if each[0] != "Unreleased")
    for path in (ROOT / name / "pyproject.toml" for name in ("", "filters", "evaluation")):
        assert tomllib.loads(path.read_text())["project"]["version"] == version, path
    citation = (ROOT / "CITATION.cff").read_text().splitlines()
    assert {f"version: {version}", f"date-released: {day}"} <= set(citation)


@pytest.mark.parametrize("text", PROJECT["dependencies"])
def test_a_runtime_requirement_ends_before_the_next_major_version(text: str):
    bounds = {each.operator: each.version for each in Requirement(text).specifier}
    assert bounds.keys() == {">=", "<"}
    pinned = LOCK[canonicalize_name(Requirement(text).name)]
    assert int(bounds["<"]) == int(pinned.split(".")[0]) + 1


@pytest.mark.parametrize("extra", ["", "bag", "dev", "graph", "report", "train"])
def test_the_lock_pins_a_version_that_is_asked_for(extra: str):
    for text in EXTRAS[extra] if extra else PROJECT["dependencies"]:
        requirement = Requirement(text)
        if requirement.name != "sigmaslam":
            assert requirement.specifier.contains(LOCK[canonicalize_name(requirement.name)]), text


def test_messages_and_pages_name_extras_that_exist():
    """And install them by the name of the package, which works without a checkout and without an index entry."""
    pages = [ROOT / "README.md", *(ROOT / "docs").glob("*.md")]
    folders = ("evaluation", "filters", "models", "sigmaslam", "synthetic", "training")
    for path in pages + [path for folder in folders for path in (ROOT / folder).rglob("*.py")]:
        for command in re.findall(r"pip install (?:-\S+ )?'([^']*\[[^']*)'", path.read_text()):
            name, extras = re.fullmatch(r"([^\[]*)\[(.*)\]", command).groups()
            assert name == "sigmaslam", f"{path}: {command}"
            assert set(extras.split(",")) <= EXTRAS.keys(), f"{path}: {command}"
