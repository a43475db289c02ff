"""Faults in frames, and what then has to be true of every estimate."""

from __future__ import annotations

from collections.abc import Callable, Iterable

import numpy as np

from sigmaslam.readers import StereoFrame
from sigmaslam.slam.tracker import Estimate
from tests.support.estimates import squared_error
from tests.support.quantiles import WITHIN_3_SIGMA

Pair = tuple[np.ndarray, np.ndarray]


def broken(frames: list[StereoFrame], which: Iterable[int], fault: Callable[[StereoFrame], Pair]) -> list[StereoFrame]:
    """The frames, some of them with other images."""
    chosen = set(which)
    return [StereoFrame(f.index, f.timestamp, *fault(f)) if k in chosen else f for k, f in enumerate(frames)]


def changed(
    frames: list[StereoFrame], which: Iterable[int], change: Callable[[np.ndarray], np.ndarray]
) -> list[StereoFrame]:
    """The frames, some of them with both images changed in the same way."""
    return broken(frames, which, lambda frame: (change(frame.left), change(frame.right)))


def assert_no_pose(estimate: Estimate) -> None:
    """A frame before the start says nothing of its pose, and says so."""
    assert estimate.status == "starting"
    assert not estimate.has_pose
    assert np.isnan(estimate.T_world_camera).all()
    for covariance in (estimate.covariance, estimate.matching_covariance):
        np.testing.assert_array_equal(np.diag(covariance), np.inf)
    assert estimate.belief == 0.0
    assert len(estimate.relative_poses) == 0


def assert_honest(estimates: list[Estimate], truth: np.ndarray) -> None:
    """Every frame is lost or starting, or right within three sigma."""
    wrong = {
        k: round(distance, 1)
        for k, estimate in enumerate(estimates)
        if estimate.status not in ("lost", "starting")
        and not (distance := squared_error(estimate, truth[k])) < WITHIN_3_SIGMA
    }
    assert not wrong, f"confident and wrong: squared sigmas by frame {wrong}"
