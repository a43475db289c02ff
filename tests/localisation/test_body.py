"""A body with a stereo camera whose gyroscopes are late: what the recording says of it, and what it does at rest."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from sigmaslam_filters import SO3
from sigmaslam_localisation.body import localise_body, score_body
from sigmaslam_localisation.starry import StereoRecording
from sigmaslam_localisation.stereo_points import BODY, StereoBody, StereoRig

pytestmark = pytest.mark.usefixtures("one_thread")

REST = 40
"""Frames at the start, of a tenth of a second."""


def simulate(delay: float, disparity: float) -> StereoRecording:
    """A body that rests without a sight of a point, then swings over thirty; its gyroscopes are late."""
    generator = np.random.default_rng(3)
    seconds = 0.1 * np.arange(160)

    def rates(times: np.ndarray) -> np.ndarray:
        moving = np.maximum(times - seconds[REST], 0.0)[:, None]
        return 0.4 * np.sin(moving * [1.1, 0.9, 0.7, 1.7, 1.3, 2.1]) * [0.5, 0.5, 0.3, 1.0, 1.0, 1.5]

    truth = [torch.tensor([0.0, 0.0, -2.0, 0.0, 0.0, 0.0, 1.0], dtype=torch.float64)]
    fine = 10
    for step in 0.5 * (rates(seconds[:-1]) + rates(seconds[1:])):
        for _ in range(fine):
            truth.append(BODY.retract(truth[-1], torch.from_numpy(step) * 0.1 / fine))
    poses = torch.stack(truth[::fine])
    rig = StereoRig(480.0, 480.0, 320.0, 240.0, 0.24, torch.eye(3, dtype=torch.float64), torch.zeros(3))
    points = generator.uniform([-1.5, -1.5, -0.2], [1.5, 1.5, 0.2], (30, 3))
    state = torch.nn.functional.pad(poses, (0, 10))
    state[:, 16] = disparity
    pixels = StereoBody(rig).measurement().function(state[:, None], torch.from_numpy(points)).numpy()
    pixels += 0.5 * generator.standard_normal(pixels.shape)
    inside = (pixels > 0).all(axis=-1) & (pixels[..., 0] < 640) & (pixels[..., 1] < 480) & (generator.random(30) < 0.4)
    inside[:REST] = False
    measured = rates(seconds)
    measured[:, 3:] = rates(seconds - delay)[:, 3:]
    measured += 0.002 * generator.standard_normal(measured.shape)
    return StereoRecording(
        "swing", seconds, measured, np.where(inside[..., None], pixels, -1.0), rig, points, poses.numpy()
    )


@pytest.fixture(scope="module")
def estimate():
    return localise_body(simulate(delay=0.2, disparity=-0.7), lag=1.0)[1]


def test_late_gyroscopes_are_found_out(estimate):
    assert estimate.delay == 0.2


def test_a_body_at_rest_does_not_drift(estimate):
    """Four seconds without a sight; a noise of speed that is as large at rest makes decimetres."""
    moved = np.linalg.norm(estimate.pose[:REST, :3] - estimate.truth[:REST, :3], axis=1)
    assert moved.max() < 0.005
    turned = SO3().local(torch.from_numpy(estimate.pose[:REST, 3:]), torch.from_numpy(estimate.truth[:REST, 3:]))
    assert turned.norm(dim=-1).max() < 0.01


def test_the_smoothed_body_is_where_its_covariance_says(estimate):
    """Without an error of mounting there is that of the filter alone, so the NEES of six is below six."""
    scores = score_body(estimate.smoothed)
    assert scores["position_rmse"] < 0.005
    assert scores["nees_mean"] < 6.0
    assert score_body(replace(estimate, smoothed=None))["position_rmse"] > scores["position_rmse"]
