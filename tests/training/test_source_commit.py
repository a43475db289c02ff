"""Pages and cards name the state of the sources that made them."""

import shutil
import subprocess
import sys
from importlib.metadata import version
from pathlib import Path

import pytest

from sigmaslam_benchmarks import source_description
from sigmaslam_training import source_commit

SOURCES = Path(source_commit.__file__), Path(source_description.__file__)


def git(folder: Path, *arguments: str) -> str:
    names = ["-c", "user.name=a", "-c", "user.email=a@example.org"]
    done = subprocess.run(["git", *names, *arguments], cwd=folder, capture_output=True, text=True, check=True)
    return done.stdout.strip()


@pytest.fixture
def checkout(tmp_path: Path) -> Path:
    """A repository of the two modules, a page and a file of code beside."""
    (tmp_path / "package").mkdir()
    (tmp_path / "docs").mkdir()
    for source in SOURCES:
        shutil.copy(source, tmp_path / "package")
    for name in ("docs/page.md", "README.md", "code.py"):
        (tmp_path / name).write_text("first\n")
    git(tmp_path, "init", "--quiet")
    git(tmp_path, "add", ".")
    git(tmp_path, "commit", "--quiet", "-m", "first")
    return tmp_path


def described(folder: Path) -> str:
    """What the modules say where they lie in this folder."""
    code = (
        "import sys, source_commit; sys.modules['sigmaslam_training.source_commit'] = source_commit; "
        "from source_description import describe_source; print(describe_source())"
    )
    done = subprocess.run([sys.executable, "-c", code], cwd=folder, capture_output=True, text=True, check=True)
    return done.stdout.strip()


def test_a_checkout_is_described_by_its_commit(checkout: Path):
    head = git(checkout, "rev-parse", "HEAD")
    assert described(checkout / "package") == f"at commit {head[:7]}"


def test_changed_code_is_told_and_changed_pages_are_not(checkout: Path):
    for name in ("docs/page.md", "README.md"):
        (checkout / name).write_text("second\n")
    assert not described(checkout / "package").endswith("changes")
    (checkout / "code.py").write_text("second\n")
    assert described(checkout / "package").endswith(" with uncommitted changes")


def test_without_a_checkout_the_version_is_told_even_inside_another_repository(checkout: Path):
    """As of a package in a virtual environment that lies in some checkout and is ignored there."""
    inner = checkout / ".venv"
    inner.mkdir()
    for source in SOURCES:
        shutil.copy(source, inner)
    assert described(inner) == f"of version {version('sigmaslam')}"


def test_a_description_stays_what_it_was(monkeypatch: pytest.MonkeyPatch):
    first = source_description.describe_source()
    monkeypatch.setattr(source_description, "current_commit", lambda: "0" * 40)
    assert source_description.describe_source() == first
