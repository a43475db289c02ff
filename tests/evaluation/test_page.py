"""What pages of benchmarks have in common."""

from pathlib import Path

from sigmaslam.source_commit import describe_source
from sigmaslam_benchmarks.tracking.page import opening, write_page


def test_a_page_says_which_command_and_commit_made_it():
    title, blank, line = opening("Results", "sigmaslam benchmark sequences --out page.md", ".", "a machine")
    assert (title, blank) == ("# Results", "")
    assert line == f"Made by `sigmaslam benchmark sequences --out page.md` {describe_source()} on a machine."


def test_notes_are_kept_when_a_page_is_made_again(tmp_path: Path):
    page = tmp_path / "page.md"
    page.write_text("old\n<!-- notes -->\nby hand\n")
    assert write_page(page, "new\n") == "new\n<!-- notes -->\nby hand\n"
    assert page.read_text() == "new\n<!-- notes -->\nby hand\n"
