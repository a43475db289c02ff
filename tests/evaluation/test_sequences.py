"""The benchmark page."""

from pathlib import Path

import pytest

from sigmaslam.errors import InputError
from sigmaslam.evaluation.benchmarks.sequences import run_sequences, write_results


def test_the_page_has_a_row_for_each_front_end_and_keeps_the_notes(tmp_path: Path):
    page = tmp_path / "results.md"
    page.write_text("old table\n<!-- notes -->\nkept words\n")
    text = write_results(page, None, ["klt"], "the command")
    assert text == page.read_text()
    assert "old table" not in text
    assert text.endswith("<!-- notes -->\nkept words\n")
    assert "`the command`" in text
    rows = [line for line in text.splitlines() if line.startswith("| klt |")]
    assert len(rows) == 2
    assert "39 of 39" in rows[0]


def test_a_folder_without_the_sequences_is_refused(tmp_path: Path):
    with pytest.raises(InputError, match="kitti_raw_0926_0039_a"):
        run_sequences(tmp_path, ["klt"])
