"""Each fault gets the verdict that the table expects: good, but for the known limits."""

import json
from collections import Counter
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from tests.faults.__main__ import Result, write_limits
from tests.faults.case import Case, Outcome, Verdict, judge
from tests.faults.running import attempt, run_in_this_process
from tests.faults.table import CASES


def _parameter(case: Case) -> object:
    marks = [pytest.mark.long] if case.slow and case.data is None else []
    return pytest.param(case, id=f"{case.group}: {case.name}", marks=marks)


@pytest.mark.parametrize("case", [_parameter(case) for case in CASES if case.data is None])
def test_a_fault_is_named_and_costs_nothing_else(case: Case, tmp_path: Path):
    verdict, reason = judge(case, attempt(case, tmp_path, run_in_this_process), tmp_path)
    assert verdict == case.expected, reason


@pytest.mark.slow
@pytest.mark.parametrize("case", [_parameter(case) for case in CASES if case.data is not None])
def test_a_fault_in_real_data_is_named(case: Case, tmp_path: Path, real_data: Path):
    assert (real_data / str(case.data)).is_dir()
    verdict, reason = judge(case, attempt(case, tmp_path, run_in_this_process), tmp_path)
    assert verdict == case.expected, reason


def test_the_table_covers_what_was_found_in_the_first_trial():
    assert len({(case.group, case.name) for case in CASES}) == len(CASES)
    first = Counter(case.first for case in CASES if case.data is None)
    # Three of them no image shows; those are in the table, too.
    assert first[Verdict.SILENT] >= 23
    assert first[Verdict.LOSS] >= 20
    assert first[Verdict.UNCLEAR] >= 15


def test_the_page_counts_what_is_good_and_quotes_the_rest(tmp_path: Path):
    page = tmp_path / "limits.md"
    page.write_text("old\n<!-- notes -->\nkept\n")
    results = [Result(GOOD, Verdict.GOOD, 2, ""), Result(replace(GOOD, name="other"), Verdict.SILENT, 0, "a | b")]
    text = write_limits(page, results, "python -m tests.faults")
    assert text == page.read_text()
    assert "1 of 2 faults pass" in text
    assert "| all faults | 1 | 0 | 0 | 1 |\n" in text
    assert text.endswith("| test | other | silent wrong | 0 | a \\| b |\n<!-- notes -->\nkept\n")


# ---- the rules of the verdict

GOOD = Case("test", "a fault", lambda folder, run: Outcome(0, ""), 2, ("file.txt",))


@pytest.mark.parametrize(
    ("outcome", "verdict"),
    [
        (Outcome(2, "error: file.txt: is empty"), Verdict.GOOD),
        (Outcome(2, "error: it is empty"), Verdict.UNCLEAR),
        (Outcome(3, "error: file.txt: is empty"), Verdict.UNCLEAR),
        (Outcome(2, "error: file.txt: " + "empty " * 1000), Verdict.UNCLEAR),
        (Outcome(0, "done"), Verdict.SILENT),
        (Outcome(0, "file.txt"), Verdict.SILENT),
        (Outcome(2, "Traceback (most recent call last): file.txt"), Verdict.LOSS),
        (Outcome(-9, "error: file.txt"), Verdict.LOSS),
        (Outcome(-1, "", "HangError"), Verdict.LOSS),
    ],
)
def test_an_outcome_is_judged_by_code_and_words(outcome: Outcome, verdict: Verdict, tmp_path: Path):
    assert judge(GOOD, outcome, tmp_path)[0] == verdict


def _write_run(folder: Path, variance: float, offset: float, tracked: int) -> None:
    """A run that says that the camera stands, but for an offset, as the demo's camera does not."""
    run = folder / "run"
    run.mkdir()
    times = 0.05 * np.arange(4)
    rows = np.column_stack([times, offset * np.arange(4), np.zeros((4, 5)), np.ones(4)])
    np.savetxt(run / "trajectory.tum", rows, "%.9f")
    np.save(run / "covariance.npy", np.tile(variance * np.eye(6), (4, 1, 1)))
    (run / "run.json").write_text(json.dumps({"summary": {"tracked": tracked}}))


@pytest.mark.parametrize(
    ("changed", "variance", "tracked", "words"),
    [
        ({}, 0.0, 3, "without a variance"),
        ({}, np.nan, 3, "not finite"),
        ({}, 1.0, 0, "no frame was tracked"),
        ({"right": True}, 1e-12, 3, "sigma"),
    ],
)
def test_wrong_poses_are_silent_errors_whatever_is_said(
    tmp_path: Path, changed: dict[str, bool], variance: float, tracked: int, words: str
):
    case = replace(GOOD, code=0, says=("tracked",))
    outcome = Outcome(0, "tracked")
    _write_run(tmp_path, variance, 0.5, tracked)
    verdict, reason = judge(replace(case, **changed), outcome, tmp_path)
    assert verdict == Verdict.SILENT
    assert words in reason


def test_lost_poses_are_a_loss(tmp_path: Path):
    case = replace(GOOD, code=0, says=(), poses=5)
    _write_run(tmp_path, 1.0, 0.0, 3)
    assert judge(case, Outcome(0, ""), tmp_path)[0] == Verdict.LOSS
    assert judge(replace(case, poses=4), Outcome(0, ""), tmp_path) == (Verdict.GOOD, "")
