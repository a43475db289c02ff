"""`make results` knows every page that a command makes, and says by name what it leaves out."""

import os
import subprocess
import sys
from functools import partial
from pathlib import Path

import pytest

from release import remake_pages
from release.remake_pages import PEERS, ROOT, absent, command_of, days_behind, describe_age, remake, runnable
from sigmaslam_benchmarks.commands import BENCHMARKS, reads_data
from sigmaslam_benchmarks.filters import peer_filters

# Code may be so much newer than a page of its figures.
_DAYS = 14.0


def write(folder: Path, name: str, command: str) -> Path:
    page = folder / name
    page.write_text(f"# Title\n\nMade by `{command}` at commit 1234567 on a machine.\n")
    return page


def test_pages_name_benchmarks_that_exist():
    commands = [words for page in (ROOT / "docs").rglob("*.md") if (words := command_of(page))]
    names = {words[2] for words in commands if words[:2] == ["sigmaslam", "benchmark"]}
    assert {"sequences", "runtime", "filters", "claims"} <= names <= BENCHMARKS.keys()
    others = {tuple(words[:3]) for words in commands if words[1] != "benchmark"}
    assert others == {("sigmaslam", "train", "export"), ("python", "-m", "tests.faults")}


@pytest.mark.long
def test_benchmarks_that_take_data_and_peers_are_known():
    assert reads_data("sequences")
    assert not reads_data("claims")
    pytest.importorskip("torch")
    assert set(PEERS["filters"]) <= {module for peer in peer_filters.PEERS for module in peer.modules}


def test_what_lacks_data_or_peers_is_skipped_by_name(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    monkeypatch.delenv("SIGMASLAM_DATA", raising=False)
    monkeypatch.setitem(PEERS, "filters", ("a_peer_that_is_not_there",))
    pages = [
        write(tmp_path, "results.md", "sigmaslam benchmark sequences --out docs/results.md"),
        write(tmp_path, "filters.md", "sigmaslam benchmark filters --out docs/benchmarks/filters.md"),
        write(tmp_path, "claims.md", "sigmaslam benchmark claims --out docs/benchmarks/claims.md"),
    ]
    (tmp_path / "hand.md").write_text("Made by hand at commit 1234567.\n")
    ran: list[list[str]] = []
    assert remake([*pages, tmp_path / "hand.md"], lambda words: len(ran.append(words) or "")) == []
    assert ran == [
        [sys.executable, "-m", "sigmaslam", "benchmark", "claims", "--out", "docs/benchmarks/claims.md"],
    ]
    lines = capsys.readouterr().out.splitlines()
    assert len(lines) == 3
    assert lines[0].endswith("results.md: skipped, SIGMASLAM_DATA names no folder of the real data sets")
    assert "filters.md: skipped, a_peer_that_is_not_there not installed" in lines[1]


def test_a_page_beside_orb_slam3_lacks_its_vocabulary(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setenv("SIGMASLAM_DATA", str(tmp_path))
    monkeypatch.setattr(remake_pages, "find_spec", lambda module: module)
    monkeypatch.delenv("PYORBSLAM3_VOCAB", raising=False)
    assert absent(["sigmaslam", "benchmark", "sequences"]).startswith("PYORBSLAM3_VOCAB names no vocabulary")
    vocabulary = tmp_path / "vocabulary.txt"
    vocabulary.touch()
    monkeypatch.setenv("PYORBSLAM3_VOCAB", str(vocabulary))
    assert absent(["sigmaslam", "benchmark", "sequences"]) == ""


def test_with_data_nothing_lacks_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setenv("SIGMASLAM_DATA", str(tmp_path))
    assert absent(["sigmaslam", "benchmark", "matches"]) == ""
    monkeypatch.setenv("SIGMASLAM_DATA", str(tmp_path / "typo"))
    assert absent(["sigmaslam", "benchmark", "matches"])


def test_a_page_whose_peers_graph_is_missing_is_skipped_by_its_name(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setenv("SIGMASLAM_DATA", str(tmp_path))
    graph = tmp_path / "xfeat.onnx"
    command = ["sigmaslam", "benchmark", "features", "--peer", str(graph), "--out", "features.md"]
    assert absent(command).startswith(f"{graph} is missing")
    graph.touch()
    assert absent(command) == ""


def test_a_page_that_fails_is_told_and_the_others_are_made(tmp_path: Path):
    pages = [
        write(tmp_path, f"{name}.md", f"sigmaslam benchmark {name} --out x.md") for name in ("claims", "endurance")
    ]
    ran: list[str] = []

    def run(words: list[str]) -> int:
        ran.append(words[4])
        return int(words[4] == "claims")

    assert remake(pages, run) == [str(pages[0])]
    assert ran == ["claims", "endurance"]


def test_renders_go_where_git_does_not_see_them():
    words = runnable(["sigmaslam", "benchmark", "shake", "--out", "docs/a.md", "--runs", "shk", "--seeds", "20"])
    assert words[3:] == ["benchmark", "shake", "--out", "docs/a.md", "--runs", "build/results/shk", "--seeds", "20"]
    assert words[:3] == [sys.executable, "-m", "sigmaslam"]
    assert runnable(["python", "-m", "tests.faults", "--out", "a.md"])[1:] == ["-m", "tests.faults", "--out", "a.md"]


def test_a_page_that_is_older_than_what_it_measures_is_told(tmp_path: Path):
    """One command that is no benchmark: it depends on all code."""

    def git(*words: str, date: str = "2026-01-01T00:00:00Z") -> str:
        user = ["-c", "user.name=a", "-c", "user.email=a@b"]
        dated = {**os.environ, "GIT_COMMITTER_DATE": date}
        run = partial(subprocess.run, cwd=tmp_path, env=dated, capture_output=True, text=True, check=True)
        return str(run(["git", *user, *words]).stdout)

    git("init", "--quiet")
    code = tmp_path / "sigmaslam" / "tracker.py"
    code.parent.mkdir()
    code.write_text("one = 1\n")
    git("add", ".")
    git("commit", "--quiet", "--message", "code")
    page = tmp_path / "page.md"
    page.write_text(f"Made by `python -m tests.faults` at commit {git('rev-parse', '--short=7', 'HEAD')}.")
    assert " days, 0 of 1 files" in describe_age(page, tmp_path)
    assert days_behind(page, tmp_path) == 0.0
    code.write_text("one = 2\n")
    assert " days, 1 of 1 files" in describe_age(page, tmp_path)
    git("commit", "--quiet", "--all", "--message", "changed", date="2026-01-04T12:00:00Z")
    assert days_behind(page, tmp_path) == 3.5
    page.write_text("Made by `python -m tests.faults` at commit 1234567.")
    assert describe_age(page, tmp_path) == "page.md: of commit 1234567, which is not in this history"


@pytest.mark.long
def test_no_page_is_two_weeks_older_than_what_it_measures():
    """Figures hold for a while: one page takes minutes to an hour, all of them hours."""
    if not (ROOT / ".git").exists() or (ROOT / ".git" / "shallow").exists():
        pytest.skip("needs the history")
    pages = [page for page in (ROOT / "docs").rglob("*.md") if command_of(page)]
    behind = {page.name: days for page in pages if (days := days_behind(page)) > _DAYS}
    assert not behind, "make them anew: make results PAGES=docs/..."


def test_the_benchmarks_can_be_imported_before_the_command_line():
    subprocess.run([sys.executable, "-c", "import sigmaslam_benchmarks.commands"], cwd=ROOT, check=True)
