"""Frames through a tracker, and its estimates against the truth."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

from sigmaslam.geometry.camera import StereoCamera
from sigmaslam.geometry.se3 import se3_inverse, se3_log
from sigmaslam.readers import StereoFrame
from sigmaslam.slam.tracker import Estimate, StereoTracker
from tests.support.quantiles import squared_sigmas

# The rendered sequence that ships with the package: camera, frames, and true poses (N, 4, 4).
Demo = tuple[StereoCamera, list[StereoFrame], np.ndarray]


def track(tracker: StereoTracker, frames: Iterable[StereoFrame]) -> list[Estimate]:
    """The estimates of all frames."""
    return [tracker.step(frame.left, frame.right, frame.timestamp) for frame in frames]


def statuses(estimates: list[Estimate]) -> list[str]:
    """Of all frames."""
    return [estimate.status for estimate in estimates]


def error_of(estimate: Estimate, truth: np.ndarray) -> np.ndarray:
    """In the body frame, metres and radians (6,)."""
    return se3_log(se3_inverse(estimate.T_world_camera) @ truth)


def squared_error(estimate: Estimate, truth: np.ndarray) -> float:
    """In the body frame, by the covariance that is claimed."""
    return float(squared_sigmas(error_of(estimate, truth), estimate.covariance))


def position_sigma(estimate: Estimate) -> float:
    """Of the position as a whole, metres."""
    return float(np.sqrt(np.trace(estimate.covariance[:3, :3])))


def mirrored(frame: StereoFrame, timestamp: float) -> StereoFrame:
    """A possible stereo pair of another world, that of the mirror."""
    return StereoFrame(frame.index, timestamp, np.fliplr(frame.right).copy(), np.fliplr(frame.left).copy())
