"""A fault, what the program should make of it, and the verdict on what it makes of it."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path

import numpy as np

from sigmaslam.geometry.se3 import se3_inverse, se3_log
from sigmaslam.readers.trajectory_files import read_kitti, read_tum
from tests.support.quantiles import WITHIN_3_SIGMA, squared_sigmas

DEMO = Path(__file__).resolve().parents[2] / "synthetic" / "sigmaslam_synthetic" / "demo"
# Of docs/usage.md.
_EXIT_CODES = (0, 1, 2, 3, 129, 130, 143)
# Of what is written to the terminal when an input is refused.
_LONGEST_ERROR = 1000
_REFUSED = 2


class Verdict(StrEnum):
    """What becomes of a fault, from the best to the worst."""

    GOOD = "good"
    UNCLEAR = "unclear"
    LOSS = "crash or loss"
    SILENT = "silent wrong"


@dataclass(frozen=True, slots=True)
class Outcome:
    """What the program made of a fault.

    Attributes:
        code: exit code.
        text: what it wrote to the terminal, both streams, in one line.
        crash: an error that it did not expect, or that it hung; None where there was none.
    """

    code: int
    text: str
    crash: str | None = None


Runner = Callable[..., Outcome]
"""Runs the command line with these arguments."""


@dataclass(frozen=True)
class Case:
    """A fault and what should become of it.

    Attributes:
        group: of similar faults.
        name: the fault in words.
        attempt: makes the fault in a new folder and runs the program; runs of a sequence go to `run` in the folder.
        code: that the program should end with.
        says: words that it should write.
        never: words that it should not write.
        poses: that the run should have; None: any number.
        right: the poses should also be those of the demo.
        slow: takes more than a second.
        data: name of the real data that it needs.
        first: the verdict of the first trial, where the fault was in it.
        expected: the verdict; another than good is a known limit.
    """

    group: str
    name: str
    attempt: Callable[[Path, Runner], Outcome]
    code: int
    says: tuple[str, ...] = ()
    never: tuple[str, ...] = ()
    poses: int | None = None
    right: bool = False
    slow: bool = False
    data: str | None = None
    first: Verdict | None = None
    expected: Verdict = Verdict.GOOD


def judge(case: Case, outcome: Outcome, folder: Path) -> tuple[Verdict, str]:
    """The verdict, and the reason for any but good.

    - crash or loss: an unexpected error, no end, an exit code that usage.md does not name, fewer poses than there were;
    - silent wrong: a success (exit code 0) that should be none, or that does not name the fault, or poses beyond three
      of their own sigmas where the fault is said to do no harm; in any run, poses that are not finite, or without
      a covariance, or poses though no frame was tracked;
    - unclear: another exit code or other words than expected, or an error longer than a few lines;
    - good: all else.

    Args:
        case: the fault.
        outcome: of its attempt.
        folder: in which it was made.
    """
    if outcome.crash is not None:
        return Verdict.LOSS, outcome.crash
    if "Traceback" in outcome.text or outcome.code not in _EXIT_CODES:
        return Verdict.LOSS, f"exit code {outcome.code}: {outcome.text[-300:]}"
    run = folder / "run"
    poses = _count_poses(run)
    if case.poses is not None and poses < case.poses:
        return Verdict.LOSS, f"{poses} poses of {case.poses} are left"
    wrong = _find_wrong_poses(run, case.right) if poses else ("there are no poses" if case.right else None)
    if wrong is not None:
        return Verdict.SILENT, wrong
    missing = [word for word in case.says if word not in outcome.text]
    forbidden = [word for word in case.never if word in outcome.text]
    reason = f"exit code {outcome.code}, should be {case.code}; " if outcome.code != case.code else ""
    reason += f"does not say {missing}; " if missing else ""
    reason += f"says {forbidden}; " if forbidden else ""
    reason += f"{poses} poses, should be {case.poses}; " if case.poses is not None and poses != case.poses else ""
    if reason:
        silent = outcome.code == 0 and (missing or case.code != 0)
        return Verdict.SILENT if silent else Verdict.UNCLEAR, f"{reason}it says: {outcome.text[-300:]}"
    if outcome.code == _REFUSED and len(outcome.text.partition("error: ")[2]) > _LONGEST_ERROR:
        return Verdict.UNCLEAR, f"an error of {len(outcome.text)} characters"
    return Verdict.GOOD, ""


def _count_poses(run: Path) -> int:
    path = run / "trajectory.tum"
    return len(read_tum(path)) if path.is_file() else 0


def _find_wrong_poses(run: Path, compare: bool) -> str | None:
    """What is wrong with the poses of a run; None: nothing that shows."""
    trajectory, covariances = read_tum(run / "trajectory.tum"), np.load(run / "covariance.npy")
    if len(covariances) != len(trajectory) or not np.isfinite(covariances).all():
        return f"{len(trajectory)} poses, {len(covariances)} covariances, or not finite"
    # The first pose may define the world, and be exact.
    diagonals = np.diagonal(covariances, axis1=1, axis2=2)
    if (diagonals[1:] <= 0).any():
        return "poses after the first without a variance"
    summary = json.loads((run / "run.json").read_text()).get("summary")
    if summary is not None and not summary["tracked"]:
        return f"{len(trajectory)} poses, though no frame was tracked"
    if not compare:
        return None
    truth = read_kitti(DEMO / "poses.txt").poses
    times = np.loadtxt(DEMO / "times.txt")
    frames = np.abs(times[:, None] - trajectory.timestamps).argmin(axis=0)
    if not np.allclose(times[frames], trajectory.timestamps, atol=1e-6):
        return "poses of times that no frame has"
    true = se3_inverse(truth[frames[0]]) @ truth[frames]
    errors = se3_log(se3_inverse(trajectory.poses[1:]) @ true[1:])
    squared = squared_sigmas(errors, covariances[1:])
    if (squared > WITHIN_3_SIGMA).any():
        return f"errors of {np.sqrt(squared.max()):.1f} sigma"
    return None
