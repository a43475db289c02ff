"""What pages of benchmarks have in common."""

from pathlib import Path

from sigmaslam.source_commit import describe_source
from sigmaslam_benchmarks.tracking.page import fill_page, write_page


def test_a_page_says_which_command_and_commit_made_it():
    command = "sigmaslam benchmark reconstruction --out page.md"
    empty = {name: [] for name in ("sequences", "goals", "worlds", "organs", "missing")}
    page = fill_page("reconstruction", command, machine="a machine", seeds=1, **empty)
    assert f"Made by `{command}` {describe_source()} on a machine." in page


def test_notes_are_kept_when_a_page_is_made_again(tmp_path: Path):
    page = tmp_path / "page.md"
    page.write_text("old\n<!-- notes -->\nby hand\n")
    assert write_page(page, "new\n") == "new\n<!-- notes -->\nby hand\n"
    assert page.read_text() == "new\n<!-- notes -->\nby hand\n"
