"""A gradient flows from the true pose of a rendered frame, through the tracker's update, to the verifier."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
import torch
from torch import Tensor, nn

from sigmaslam.estimation.frame_update import FrameUpdate
from sigmaslam.filters.tracking.frame_update import FrameViews, update_frame
from sigmaslam.frontend.match_confidence import ConfidenceEstimator
from sigmaslam.geometry.se3 import se3_inverse
from sigmaslam.inference.onnx_graph import shipped_weights
from sigmaslam.models.onnx_export import load_verifier
from sigmaslam.models.verifier_network import PLACE_COLUMNS, MatchCovariance
from sigmaslam.readers import open_sequence
from sigmaslam.readers.trajectory_files import read_trajectory
from sigmaslam.slam.config import TrackerConfig
from sigmaslam.slam.tracker import StereoTracker

FRAMES = 6
DEMO = Path(__file__).resolve().parents[2] / "synthetic" / "demo"


@dataclass
class Recorded:
    """The last frame of a rendered sequence as the tracker's update got it.

    Attributes:
        columns, axes: (N, C), (N, 2, 2) what the verifier was asked.
        answered: (N, 2, 2) covariances that it gave.
        steps: inputs of the first robust and gated step.
        pose: (4, 4) what the tracker found.
        covariance: (6, 6) of the pose relative to the last keyframe, in the world.
        T_last_frame: (4, 4) true.
    """

    columns: Tensor
    axes: Tensor
    answered: Tensor
    steps: dict[str, dict[str, np.ndarray]]
    pose: np.ndarray
    covariance: np.ndarray
    T_last_frame: Tensor


@pytest.fixture(scope="module")
def recorded() -> Recorded:
    sequence = open_sequence(DEMO)
    truth = read_trajectory(DEMO / "poses.txt").poses
    tracker = StereoTracker(sequence.camera, config=TrackerConfig(keyframe_ratio=0.1), threads=1)
    asked, steps, fits = {}, {}, []

    def spy(owner: object, name: str, into: dict, key: str) -> None:
        graph: Callable = getattr(owner, name)

        def called(feed: dict[str, np.ndarray]) -> list[np.ndarray]:
            answer = graph(feed)
            into.setdefault(key, (feed, answer))
            return answer

        setattr(owner, name, called)

    estimator = next(value for value in vars(tracker._frontend).values() if isinstance(value, ConfidenceEstimator))
    update: FrameUpdate = tracker._localiser.update
    graphs = tracker._window.graphs
    spy(estimator, "_place_verifier", asked, "place")
    spy(graphs, "robust_step", steps, "robust")
    spy(graphs, "gated_step", steps, "gated")
    fit = update.fit

    def kept(*arguments: object, **settings: object) -> object:
        fits.append(fit(*arguments, **settings))
        return fits[-1]

    update.fit = kept  # type: ignore[method-assign]
    keyframe = 0
    for k, frame in zip(range(FRAMES), sequence.frames(), strict=False):
        steps.clear()
        asked.clear()
        estimate = tracker.step(frame.left, frame.right, frame.timestamp)
        if estimate.tracks is not None:
            assert k < FRAMES - 1
            keyframe = k
    place, (_, answered) = asked["place"]
    return Recorded(
        torch.from_numpy(place["columns"]).double(),
        torch.from_numpy(place["axes"]).double(),
        torch.from_numpy(answered).double(),
        {name: feed for name, (feed, _) in steps.items()},
        fits[-1].pose,
        fits[-1].relative,
        torch.from_numpy(se3_inverse(truth[keyframe]) @ truth[FRAMES - 1]),
    )


def log_likelihood(given: Recorded, verifier: nn.Module) -> Tensor:
    """Of the true pose, by covariances of the matches as this verifier gives them."""
    feed = {name: torch.from_numpy(np.asarray(value)) for name, value in given.steps["robust"].items()}
    frame = FrameViews(*(feed[name] for name in FrameViews._fields))
    _, covariance = verifier(given.columns, given.axes)
    # Which of the places that were judged became which view, by its covariance; of the rest nothing was used.
    config = TrackerConfig()
    whole = feed["noise"][:, :2, :2] / (1.0 - config.shared_place)
    ratio = whole[:, None].diagonal(dim1=2, dim2=3) / given.answered.diagonal(dim1=1, dim2=2)
    unlike = (ratio[..., 0] / ratio[..., 1] - 1.0).abs()
    row = unlike.argmin(dim=1)
    assert (unlike.amin(dim=1) < 1e-9).all()
    scale = ratio[torch.arange(len(row)), row, 0]
    assert (scale / scale.mean() - 1.0).abs().max() < 1e-9
    whole = covariance[row] * scale.mean()
    noise = feed["noise"].clone()
    noise[:, :2, :2] = (1.0 - config.shared_place) * whole
    root = torch.linalg.det(whole).sqrt()[:, None, None]
    trace = (whole[:, 0, 0] + whole[:, 1, 1])[:, None, None]
    symmetric = (whole + root * torch.eye(2)) / (trace + 2.0 * root).sqrt()
    common = torch.nn.functional.pad(config.shared_place**0.5 * symmetric, (0, 0, 0, 1))
    torch.testing.assert_close(common.detach(), frame.common, rtol=1e-3, atol=1e-4)
    freedom = torch.from_numpy(given.steps["gated"]["freedom"])
    estimate = update_frame(feed["measurement"], noise, frame._replace(common=common), freedom)
    return estimate.log_likelihood(frame.poses[-1], given.T_last_frame, frame.poses[-2])


def test_the_update_in_torch_finds_what_the_tracker_found(recorded: Recorded):
    feed = {name: torch.from_numpy(np.asarray(value)) for name, value in recorded.steps["robust"].items()}
    frame = FrameViews(*(feed[name] for name in FrameViews._fields))
    freedom = torch.from_numpy(recorded.steps["gated"]["freedom"])
    found = update_frame(feed["measurement"], feed["noise"], frame, freedom)
    difference = found.covariance[-6:] - found.covariance[-12:-6]
    relative = difference[:, -6:] - difference[:, -12:-6]
    np.testing.assert_allclose(relative, recorded.covariance, rtol=1e-6, atol=1e-14)


def test_gradient_by_the_verifier_s_last_layer_equals_finite_differences(recorded: Recorded):
    verifier = load_verifier(shipped_weights("place_verifier.safetensors"), PLACE_COLUMNS).double()
    network = MatchCovariance(verifier)
    last = verifier.layers[-1]
    value = log_likelihood(recorded, network)
    by_weight, by_bias = torch.autograd.grad(value, [last.weight, last.bias])
    assert torch.isfinite(value)
    assert by_bias[1:].abs().min() > 1e-3  # the two sigmas; the probability has no part in the update
    generator = torch.Generator().manual_seed(0)
    size = 1e-5
    for _ in range(3):
        direction = torch.randn(last.weight.shape, generator=generator, dtype=torch.float64)
        turn = torch.randn(last.bias.shape, generator=generator, dtype=torch.float64)
        values = []
        for sign in (1.0, -1.0):
            with torch.no_grad():
                last.weight += sign * size * direction
                last.bias += sign * size * turn
                values.append(log_likelihood(recorded, network))
                last.weight -= sign * size * direction
                last.bias -= sign * size * turn
        expected = (values[0] - values[1]) / (2.0 * size)
        found = (by_weight * direction).sum() + (by_bias * turn).sum()
        torch.testing.assert_close(found.detach(), expected, rtol=1e-4, atol=1e-6)
