"""The smoother of recordings beside the library's, step by step, and on robots in a world that is known."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from sigmaslam_filters import Euclidean, Gaussian, MeasurementModel, MotionModel, UnscentedKalmanFilter
from sigmaslam_filters.manifolds import Space
from sigmaslam_localisation.robots import localise_robots
from sigmaslam_localisation.scores import score
from sigmaslam_localisation.smoothing import Smoother
from sigmaslam_localisation.wheeled_robot import SPACE, WheeledRobot
from tests.support.wheeled_world import World, drive

pytestmark = [pytest.mark.usefixtures("one_thread"), pytest.mark.timeout(300)]
STEPS = 25


def smoothed_both_ways(
    space: Space, prior: Gaussian, motion: MotionModel, measurement: MeasurementModel, values: torch.Tensor, *given
) -> tuple[Gaussian, Smoother]:
    """By the library, and by what is tested, of values (T, 1, m) and inputs of both models (T - 1, ..) and (T, ..)."""
    bayes = UnscentedKalmanFilter(space)
    track = bayes.filter(prior, motion, measurement, values, *given)
    moves, places = given or ([], [])
    belief = bayes.update(prior, measurement, values[0], *(each[0] for each in places)).belief
    beliefs = [belief]
    for k in range(1, len(values)):
        moved = bayes.predict(belief, motion, *(each[k - 1] for each in moves))
        belief = bayes.update(moved.belief, measurement, values[k], *(each[k] for each in places)).belief
        beliefs.append(belief)
    filtered = Gaussian(torch.stack([b.mean for b in beliefs]), torch.stack([b.covariance for b in beliefs]))
    torch.testing.assert_close(filtered.mean, track.filtered.mean)
    moved = bayes.predict(Gaussian(filtered.mean[:-1], filtered.covariance[:-1]), motion, *moves)
    return bayes.smooth(track), Smoother.of(space, filtered, moved)[0]


def test_a_linear_model_is_smoothed_exactly():
    def drift(state: torch.Tensor) -> torch.Tensor:
        return torch.stack([state[..., 0] + 0.1 * state[..., 1], 0.9 * state[..., 1]], dim=-1)

    values = torch.from_numpy(np.random.default_rng(0).standard_normal((STEPS, 1, 1)))
    expected, smoother = smoothed_both_ways(
        Euclidean(2),
        Gaussian(torch.zeros(1, 2, dtype=torch.float64), torch.eye(2, dtype=torch.float64)[None]),
        MotionModel(drift, torch.diag(torch.tensor([1e-6, 0.1], dtype=torch.float64))),
        MeasurementModel(lambda state: state[..., :1], torch.eye(1, dtype=torch.float64)),
        values,
    )
    mean, covariance = smoother.smooth()
    np.testing.assert_allclose(mean, expected.mean[:, 0], atol=1e-9)
    np.testing.assert_allclose(covariance, expected.covariance[:, 0], atol=1e-9)


@pytest.mark.long
def test_a_robot_is_smoothed_as_by_the_library():
    robot, rng = WheeledRobot("range-bearing", 0.1), np.random.default_rng(1)
    places = torch.from_numpy(rng.uniform(-4.0, 4.0, (STEPS, 1, 2)))
    true = torch.zeros(STEPS, 1, 12, dtype=torch.float64)
    true[:, 0, 0], true[:, 0, 2] = 0.1 * torch.arange(STEPS), 0.02 * torch.arange(STEPS)
    seen = robot.measurement().function(true, places)
    values = seen + torch.from_numpy(rng.standard_normal((STEPS, 1, 2))) * torch.tensor([0.1, 0.05])
    path = torch.tensor([0.1, 0.02], dtype=torch.float64) + 0.01 * torch.from_numpy(
        rng.standard_normal((STEPS - 1, 1, 2))
    )
    duration = torch.full((STEPS - 1, 1, 1), 0.2, dtype=torch.float64)
    motion = robot.motion(path[0], duration[0, :, 0])
    measurement = MeasurementModel(
        robot.measurement().function,
        torch.diag(torch.tensor([0.01, 0.0025], dtype=torch.float64)),
        residual=robot.measurement().residual,
    )
    expected, smoother = smoothed_both_ways(
        SPACE,
        robot.prior(torch.zeros(1, 3, dtype=torch.float64)),
        motion,
        measurement,
        values,
        [path, duration],
        [places],
    )
    mean, covariance = smoother.smooth()
    deviations = np.sqrt(np.diagonal(expected.covariance[:, 0].numpy(), axis1=1, axis2=2))
    apart = SPACE.local(torch.from_numpy(mean), expected.mean[:, 0]).numpy() / deviations
    # What is left out is of the second order: a hundredth of a sigma.
    assert np.abs(apart).max() < 0.02
    units = deviations[:, :, None] * deviations[:, None, :]
    np.testing.assert_allclose(covariance / units, expected.covariance[:, 0].numpy() / units, atol=0.02)
    assert np.linalg.eigvalsh(covariance).min() > 0.0


@pytest.mark.long
def test_errors_fall_with_what_is_known_of_later_times():
    recordings = [drive(World(seconds=30.0, seed=seed)) for seed in range(4)]
    estimates = localise_robots(recordings, lag=2.0)[1]
    errors = {
        name: np.sqrt(np.mean([score(each)["position_rmse"] ** 2 for each in kinds]))
        for name, kinds in (
            ("filtered", estimates),
            ("lagged", [each.lagged for each in estimates]),
            ("smoothed", [each.smoothed for each in estimates]),
        )
    }
    assert errors["smoothed"] < errors["lagged"] < errors["filtered"]
    for estimate in estimates:
        assert 0.3 < score(estimate.smoothed)["nees_mean"] < 9.0
        # Nothing is seen after the end, and a lag longer than the recording is no lag.
        np.testing.assert_allclose(estimate.smoothed.pose[-1], estimate.pose[-1], atol=1e-12)
        traces = [np.trace(each.covariance[:-1, :2, :2], axis1=1, axis2=2) for each in (estimate.smoothed, estimate)]
        assert np.all(traces[0] < 1.001 * traces[1])
    longest = localise_robots(recordings[:1], lag=1e3)[1][0]
    np.testing.assert_array_equal(longest.lagged.pose, longest.smoothed.pose)


def test_nothing_is_smoothed_unless_asked_for():
    estimate = localise_robots([drive(World(seconds=2.0, seed=2))])[1][0]
    assert estimate.smoothed is None
    assert estimate.lagged is None
