"""The benchmark endurance: its repeats go on in time, its page is made, also when it is stopped."""

from pathlib import Path

import numpy as np
import pytest

from sigmaslam import open_sequence
from sigmaslam_benchmarks.tracking import endurance
from sigmaslam_benchmarks.tracking.endurance import LappedPairs, write_endurance
from sigmaslam_benchmarks.tracking.endurance_page import Block, Endurance, Lap, format_endurance
from sigmaslam_synthetic.simulation import Recipe

LAP = Recipe("room", 40)


@pytest.fixture
def renders(demo_sequence: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, without_report: None) -> Path:
    """The demo in place of a lap."""
    (tmp_path / "room0").symlink_to(demo_sequence)
    monkeypatch.setattr(endurance, "render", lambda folder, recipe, workers: folder / "room0")
    return tmp_path


def test_repeats_go_on_in_time_as_the_path_does(demo_sequence: Path):
    """The last frame of a lap comes two intervals before the first of the next."""
    pairs = list(LappedPairs(open_sequence(demo_sequence), 85))
    assert len(pairs) == 85
    steps = np.diff([pair.timestamp for pair in pairs])
    np.testing.assert_allclose(np.delete(steps, [39, 79]), 0.05, rtol=1e-6)
    np.testing.assert_allclose(steps[[39, 79]], 0.10, rtol=1e-6)
    np.testing.assert_array_equal(pairs[41].left, pairs[1].left)


@pytest.mark.long
def test_the_page_tells_of_every_block(renders: Path):
    text = write_endurance(renders / "page.md", 6, "the command", renders, recipe=LAP, block=2)
    assert text == (renders / "page.md").read_text()
    rows = [line for line in text.splitlines() if line.startswith(("| 2 |", "| 4 |", "| 6 |"))]
    assert len(rows) == 3
    assert float(rows[0].split("|")[2]) > 50  # megabytes
    assert "| no frame lost | 0 | reached |" in text
    assert "Stopped" not in text


@pytest.mark.long
def test_stopped_it_tells_what_was_measured(renders: Path, monkeypatch: pytest.MonkeyPatch):
    calls = []

    def measure() -> float:
        calls.append(1)
        if len(calls) == 5:  # the first three are those of the run without loops
            raise KeyboardInterrupt
        return 100.0

    monkeypatch.setattr(endurance, "resident_megabytes", measure)
    with pytest.raises(KeyboardInterrupt):
        write_endurance(renders / "page.md", 6, "the command", renders, recipe=LAP, block=2)
    text = (renders / "page.md").read_text()
    assert "**Stopped after 4 of 6 frames.**" in text
    assert "| 2 |" in text


def test_goals_that_are_missed_are_said_to_be():
    def page(megabytes: list[float], cpu: list[float], error: float) -> str:
        blocks = [
            Block(500 * k + 500, m, c, (c, c, c), 0.1, 0) for k, (m, c) in enumerate(zip(megabytes, cpu, strict=True))
        ]
        errors = np.full(100, error)
        run = Endurance(2000, 2000, 60.0, 10.0, 50, blocks, [Lap(error, error, error)], errors, errors, 9, 1.0)
        return format_endurance(run, "the command")

    good = page([500, 600, 605, 610], [50, 60, 60, 61], 0.019)
    assert "**missed**" not in good
    assert "0.190 %" in good
    bad = page([500, 600, 650, 640], [50, 60, 70, 71], 0.021)
    assert bad.count("**missed**") == 3
