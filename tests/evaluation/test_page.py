"""What pages of benchmarks have in common."""

from pathlib import Path

from sigmaslam_benchmarks.source_description import describe_source
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


def test_rows_that_few_read_are_a_table_beside_the_page(tmp_path: Path):
    page = tmp_path / "page.md"
    table = "| case | words |\n|---|---:|\n| none | a \\| b, c |\n"
    written = write_page(page, f"All runs:\n<!-- rows runs -->\n{table}<!-- end -->\n\nEnd.\n")
    assert written == page.read_text() == "All runs:\n[page.runs.csv](page.runs.csv), 1 rows.\n\nEnd.\n"
    assert (tmp_path / "page.runs.csv").read_text() == 'case,words\nnone,"a | b, c"\n'
