import math
from typing import Any

import numpy as np
import pytest
import torch
from torch import Generator, Tensor

import sigmaslam_filters as filters
from sigmaslam_benchmarks.filters import work as filter_work
from sigmaslam_benchmarks.filters.scenarios import (
    CAMERA,
    Outcome,
    Scenario,
    bearings,
    coordinated_turn,
    growth,
    localisation,
    reentry,
    run,
    stereo_pose,
    vague_prior,
)
from sigmaslam_filters.consistency import check_nees, nees
from sigmaslam_filters.systems import (
    constant_velocity,
    constant_velocity_over,
    differential_drive,
    project_stereo,
    range_and_bearing,
)
from tests.support.filter_builders import covariances, random_numbers, tensor

EKF = filters.ExtendedKalmanFilter(iterations=1)
CUBATURE = filters.UnscentedKalmanFilter(iterations=1)
KAPPA_2 = filters.UnscentedKalmanFilter(points=filters.julier(2.0), iterations=1)
SPLIT = filters.Product(filters.Euclidean(2), filters.SO2())


def seeded(seed: int = 0) -> Generator:
    return torch.Generator().manual_seed(seed)


def mean_and_error(values: Tensor) -> tuple[float, float]:
    return float(values.mean()), float(values.std()) / math.sqrt(len(values))


def assert_reproduces(values: Tensor, known: float, uncertainty: float, deviations: float = 3.0) -> None:
    """The mean of independent values agrees with a figure that has an uncertainty of its own."""
    mean, error = mean_and_error(values)
    allowed = deviations * math.hypot(error, uncertainty)
    assert abs(mean - known) < allowed, f"{mean:.5g} +- {error:.2g}, known {known} +- {uncertainty}"


# Systems


def test_constant_velocity_over_two_steps_equals_one_of_double_length() -> None:
    densities = tensor(0.5, 0.4, 0.3, 0.01, 0.02, 0.03)
    short, long = constant_velocity_over(densities, 0.1), constant_velocity_over(densities, 0.2)
    A, Q = short.matrix, short.noise
    torch.testing.assert_close(A @ A, long.matrix)
    torch.testing.assert_close(A @ Q @ A.mT + Q, long.noise)


@pytest.mark.parametrize("bayes", [EKF, CUBATURE], ids=["ekf", "cubature"])
def test_constant_velocity_takes_a_time_step_of_its_own_for_each_element(bayes: filters.BayesFilter) -> None:
    densities, steps = tensor(0.5, 0.2), tensor(0.0, 0.1, 1.7)
    prior = filters.Gaussian(random_numbers(3, 4), covariances(3, 4))
    found = bayes.predict(prior, constant_velocity(densities), steps.unsqueeze(-1)).belief
    for k, step in enumerate(steps.tolist()):
        expected = filters.KalmanFilter().predict(prior[k], constant_velocity_over(densities, step)).belief
        torch.testing.assert_close(found.mean[k], expected.mean, rtol=0, atol=1e-13)
        torch.testing.assert_close(found.covariance[k], expected.covariance, rtol=0, atol=1e-12)


def test_a_sequence_at_irregular_times_equals_the_kalman_filter_by_events() -> None:
    densities, steps, values = tensor(0.5), tensor(0.1, 0.7, 0.02, 1.3), random_numbers(5, 1, seed=2)
    prior, height = filters.Gaussian(tensor(0.0, 1.0), torch.eye(2).double()), tensor(1.0, 0.0).unsqueeze(0)
    see = filters.LinearMeasurement(height, filters.Diagonal(tensor(0.04)))
    found = CUBATURE.filter(prior, constant_velocity(densities), see, values, [steps.unsqueeze(-1)])
    events = [filters.Event(None, see, values[0])]
    for step, value in zip(steps.tolist(), values[1:], strict=True):
        events.append(filters.Event(constant_velocity_over(densities, step), see, value))
    expected = filters.KalmanFilter().filter_events(prior, events)
    torch.testing.assert_close(found.filtered.mean, expected.filtered.mean, rtol=0, atol=1e-12)
    torch.testing.assert_close(found.filtered.covariance, expected.filtered.covariance, rtol=0, atol=1e-12)
    smoothed = CUBATURE.smooth(found), filters.KalmanFilter().smooth(expected)
    torch.testing.assert_close(smoothed[0].mean, smoothed[1].mean, rtol=0, atol=1e-11)
    torch.testing.assert_close(smoothed[0].covariance, smoothed[1].covariance, rtol=0, atol=1e-11)


@pytest.mark.parametrize("shape", [(), (5,), (24, 5)])
def test_stereo_pixels_equal_the_plain_formula_for_shared_and_own_points(shape: tuple[int, ...]) -> None:
    work = filter_work.stereo(7, seed=3)
    state = torch.as_tensor(work.mean) + 0.05 * random_numbers(*shape, 12)
    points = torch.as_tensor(work.points)
    expected = torch.as_tensor(filter_work.project_stereo(np, state.numpy(), work.points))
    torch.testing.assert_close(project_stereo(state, points, CAMERA), expected, rtol=1e-12, atol=1e-10)
    own = points.expand(*shape[1:], 7, 3) if shape else points.unsqueeze(0)
    given = state if shape else state.unsqueeze(0)
    torch.testing.assert_close(project_stereo(given, own, CAMERA).reshape(expected.shape), expected)


@pytest.mark.parametrize("m", [3, 50])
def test_a_step_of_the_12_states_equals_the_reference(m: int) -> None:
    work = filter_work.stereo(m, seed=m)
    motion = constant_velocity_over(tensor(0.5, 0.5, 0.5, 0.1, 0.1, 0.1), filter_work.TIME_STEP)
    noise = filters.Diagonal(torch.as_tensor(work.measurement_noise).diagonal())
    belief = CUBATURE.predict(
        filters.Gaussian(torch.as_tensor(work.mean), torch.as_tensor(work.covariance)), motion
    ).belief
    points = torch.as_tensor(work.points)
    measurement = filters.MeasurementModel(lambda state: project_stereo(state, points, CAMERA), noise)
    belief = CUBATURE.update(belief, measurement, torch.as_tensor(work.measurement)).belief
    mean, covariance = filter_work.step(work)
    torch.testing.assert_close(belief.mean, torch.as_tensor(mean), rtol=0, atol=1e-10)
    torch.testing.assert_close(belief.covariance, torch.as_tensor(covariance), rtol=0, atol=1e-10)


def test_drive_noise_spreads_forward_and_in_heading_only() -> None:
    motion = differential_drive(torch.diag(tensor(0.04, 0.01)))
    still = filters.Gaussian(tensor(1.0, 2.0, 0.5 * math.pi), torch.zeros(3, 3, dtype=torch.float64))
    moved = EKF.predict(still, motion, tensor(2.0, 0.2), tensor(0.5)).belief
    torch.testing.assert_close(moved.mean, tensor(1.0, 3.0, 0.5 * math.pi + 0.1))
    torch.testing.assert_close(moved.covariance.diagonal(), tensor(0.0, 0.01, 0.0025))


def test_range_and_bearing_is_the_landmark_in_the_robot_frame_in_polar_form() -> None:
    state, landmark = 3.0 * random_numbers(10, 3), 5.0 * random_numbers(10, 2, seed=1)
    ahead, aside = (landmark - state[:, :2]).unbind(-1)
    cosine, sine = torch.cos(state[:, 2]), torch.sin(state[:, 2])
    x, y = ahead * cosine + aside * sine, aside * cosine - ahead * sine
    distance, bearing = range_and_bearing(torch.eye(2)).function(state, landmark).unbind(-1)
    torch.testing.assert_close(distance * torch.cos(bearing), x)
    torch.testing.assert_close(distance * torch.sin(bearing), y)


def test_a_bearing_across_the_cut_moves_the_robot_little() -> None:
    model = range_and_bearing(torch.diag(tensor(0.01, 0.0001)))
    belief = filters.Gaussian(tensor(0.0, 0.0, math.pi - 0.01), 1e-3 * covariances(3))
    seen = CUBATURE.update(belief, model, tensor(5.0, 0.02), tensor(-5.0, 0.0))
    assert float(seen.innovation.abs().max()) < 0.05


# 12 states


def assert_stereo_pose_is_consistent(groups: int) -> None:
    # The share of one experiment of 200 runs scatters by 0.03, because the steps of a run are correlated.
    nees = run(stereo_pose(200 * groups, seeded()), filters.UnscentedKalmanFilter()).nees
    share = np.mean([check_nees(part.mT, 12).share_inside for part in nees.split(200, dim=1)])
    check = check_nees(nees.mT, 12)
    assert share >= 0.93
    assert check.mean == pytest.approx(12.0, rel=0.03)
    assert check.median == pytest.approx(check.expected_median, rel=0.03)
    assert check.nan_count == 0


@pytest.mark.long
def test_stereo_pose_filter_is_consistent() -> None:
    assert_stereo_pose_is_consistent(5)


@pytest.mark.slow
def test_stereo_pose_filter_is_consistent_in_twenty_experiments() -> None:
    assert_stereo_pose_is_consistent(20)


@pytest.mark.long
@pytest.mark.parametrize("pixel_sigma", [0.1, 0.5])
def test_many_points_from_a_vague_prior_leave_the_default_filter_consistent(pixel_sigma: float) -> None:
    outcome = run(vague_prior(300, seeded(), pixel_sigma=pixel_sigma), filters.UnscentedKalmanFilter())
    assert float(outcome.nees.mean()) <= 13.0
    assert float(outcome.nees.median()) == pytest.approx(11.34, rel=0.1)


@pytest.mark.long
def test_one_linearisation_is_overconfident_from_a_vague_prior_and_two_are_not() -> None:
    scenario = vague_prior(200, seeded(1))
    once, twice = (run(scenario, filters.UnscentedKalmanFilter(iterations=k)).nees.mean() for k in (1, 2))
    assert float(once) > 100.0
    assert float(twice) <= 13.0


# Localisation


def position_nees(outcome: Outcome, rate: int) -> Tensor:
    """(runs,) per degree of freedom, over the second half: at the start the position is known exactly."""
    return 0.5 * nees(outcome.error[..., :2], outcome.covariance[..., :2, :2])[20 * rate :].mean(dim=0)


def rmse_of_experiments(outcome: Outcome) -> Tensor:
    """Position RMSE of each experiment of 100 runs, metres; one wild run in a thousand moves that of all."""
    return torch.stack([part.square().mean().sqrt() for part in outcome.rmse_by_run.split(100)])


@pytest.mark.long
def test_se2_filter_localises_and_is_consistent() -> None:
    rate = 10
    outcome = run(localisation(400, seeded(), rate), filters.UnscentedKalmanFilter(filters.SE2()))
    assert float(rmse_of_experiments(outcome).median()) <= 0.46
    assert 0.9 <= float(position_nees(outcome, rate).mean()) <= 1.1


@pytest.mark.slow
@pytest.mark.parametrize("iterations", ["auto", 3])
def test_se2_filter_localises_in_twenty_experiments(iterations: Any) -> None:
    rate = 10
    outcome = run(
        localisation(2000, seeded(), rate), filters.UnscentedKalmanFilter(filters.SE2(), iterations=iterations)
    )
    assert outcome.rmse <= 0.46
    assert 0.9 <= float(position_nees(outcome, rate).mean()) <= 1.1


@pytest.mark.slow
def test_localisation_at_100_hz_reproduces_the_published_order() -> None:
    rate, scenario = 100, localisation(500, seeded(), 100)
    default = run(scenario, filters.UnscentedKalmanFilter(filters.SE2()))
    split = run(scenario, filters.UnscentedKalmanFilter(SPLIT))
    assert default.rmse <= 0.46
    assert 0.9 <= float(position_nees(default, rate).mean()) <= 1.1
    assert split.rmse > 1.3 * default.rmse
    assert float(position_nees(split, rate).mean()) > 5.0


# Literature


@pytest.mark.long
def test_growth_mse_is_that_of_the_literature() -> None:
    scenario = growth(200, seeded())
    assert_reproduces(run(scenario, KAPPA_2).rmse_by_run.square(), 51.7, 0.3)


@pytest.mark.slow
@pytest.mark.parametrize(("bayes", "known", "error"), [(EKF, 117.9, 1.2), (KAPPA_2, 51.7, 0.3), (CUBATURE, 71.9, 0.4)])
def test_growth_mse_of_1000_runs(bayes: filters.BayesFilter, known: float, error: float) -> None:
    assert_reproduces(run(growth(1000, seeded()), bayes).rmse_by_run.square(), known, error)


def growth_with_kept_points(scenario: Scenario, bayes: filters.BayesFilter) -> Tensor:
    """Estimates (T, runs, 1) of `growth` by one set of sigma points for state and both noises, not redrawn between.

    State and measurement are moved as one state of two components, of which the second is then given exactly.
    """

    def move_and_see(x: Tensor, noise: Tensor, wave: Tensor) -> Tensor:
        moved = scenario.motion.function(x[..., 0], wave[..., 0]) + noise[..., 0]
        return filters.stack([moved, 0.05 * moved * moved + noise[..., 1]])

    both = filters.MotionModel(move_and_see, torch.eye(2, dtype=torch.float64), additive=False)
    given = filters.LinearMeasurement(tensor([[0.0, 1.0]]), tensor([[0.0]]))
    belief, means = scenario.prior, []
    for wave, value in zip(scenario.motion_inputs[0], scenario.values, strict=True):
        seen = bayes.update(bayes.predict(belief, both, wave).belief, given, value).belief
        belief = filters.Gaussian(seen.mean[..., :1], seen.covariance[..., :1, :1])
        means.append(belief.mean)
    return torch.stack(means)


@pytest.mark.slow
def test_growth_mse_with_sigma_points_that_are_kept() -> None:
    scenario = growth(1000, seeded())
    estimate = growth_with_kept_points(scenario, CUBATURE)
    assert_reproduces((scenario.truth - estimate).square().mean(dim=(0, 2)), 27.1, 0.2)


def kept_runs(outcome: Outcome) -> Tensor:
    return outcome.rmse_by_run[outcome.healthy.all(dim=0)]


@pytest.mark.long
def test_coordinated_turn_is_followed_better_by_sigma_points() -> None:
    scenario = coordinated_turn(500, seeded())
    assert_reproduces(run(scenario, CUBATURE).rmse_by_run, 18.3, 0.3)


@pytest.mark.slow
def test_coordinated_turn_of_the_ekf() -> None:
    bayes = filters.ExtendedKalmanFilter(iterations=1, on_failure="hold")
    assert_reproduces(kept_runs(run(coordinated_turn(500, seeded()), bayes)), 28.1, 0.9)


@pytest.mark.slow
@pytest.mark.parametrize("bayes", [EKF, CUBATURE])
def test_bearings_only_rmse_of_1000_runs(bayes: filters.BayesFilter) -> None:
    # Over all steps and runs; the mean of the runs' own RMSE is 0.111 for the EKF and 0.109 for the UKF.
    assert run(bearings(1000, seeded()), bayes).rmse == pytest.approx(0.1123, abs=0.003)


@pytest.mark.slow
def test_reentry_rmse_is_the_same_for_all_filters() -> None:
    scenario = reentry(100, seeded())
    sigma, taylor = run(scenario, CUBATURE), run(scenario, EKF)
    assert_reproduces(sigma.rmse_by_run, 0.00849, 0.00004)
    assert sigma.rmse == pytest.approx(taylor.rmse, rel=0.005)
