from dataclasses import dataclass

import numpy as np
import pytest
import torch
from scipy.stats import chi2
from torch import Tensor
from torch.func import jacrev

from sigmaslam import pose_filter
from sigmaslam.camera import RectifiedStereo
from sigmaslam.filters import stereo_pose
from sigmaslam.filters.lie import adjoint_se3, exp_se3, invert_se3, log_se3
from sigmaslam.filters.stereo_pose import CALIBRATION, CLONE, POSE, STATE_SIZE, TWIST, Innovate, Predict, Update
from sigmaslam.pose_filter import PoseFilter, StereoPoints

CAMERA = RectifiedStereo(fx=400.0, fy=410.0, cx=320.0, cy=240.0, baseline=0.2, width=640, height=480)
INTRINSICS = torch.tensor([400.0, 410.0, 320.0, 240.0, 80.0], dtype=torch.float64)
NO_NOISE = torch.zeros(3, dtype=torch.float64)


def random_numbers(*shape: int, seed: int = 0) -> Tensor:
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def tensor(*values: float) -> Tensor:
    return torch.tensor(values, dtype=torch.float64)


@dataclass
class State:
    pose: Tensor
    clone: Tensor
    twist: Tensor
    offset: Tensor
    covariance: Tensor

    def seen(self) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        return self.pose, self.clone, self.offset, self.covariance

    def all(self) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
        return self.pose, self.clone, self.twist, self.offset, self.covariance


def some_state(sigma: float = 1e-3, seed: int = 0) -> State:
    """A moving camera a little away from its keyframe, everything correlated with everything."""
    root = sigma * random_numbers(STATE_SIZE, STATE_SIZE, seed=seed)
    clone = exp_se3(0.5 * random_numbers(6, seed=seed + 1))
    return State(
        clone @ exp_se3(0.05 * random_numbers(6, seed=seed + 2)),
        clone,
        random_numbers(6, seed=seed + 3),
        tensor(0.3),
        root @ root.T,
    )


def some_landmarks(count: int, seed: int = 0) -> Tensor:
    generator = torch.Generator().manual_seed(seed)
    uniform = torch.rand(count, 3, generator=generator, dtype=torch.float64)
    return tensor(30.0, 30.0, 4.0) + uniform * tensor(580.0, 420.0, 30.0)


def covariances(count: int, sigma: float, seed: int = 0) -> Tensor:
    root = sigma * (torch.eye(3, dtype=torch.float64) + 0.3 * random_numbers(count, 3, 3, seed=seed))
    return root @ root.mT


def sigmas(count: int, typical: float, seed: int = 0) -> Tensor:
    """Standard deviations of landmarks, (count, 3)."""
    return typical * (0.5 + torch.rand(count, 3, generator=torch.Generator().manual_seed(seed), dtype=torch.float64))


def measure(tangent: Tensor, state: State, landmarks: Tensor) -> tuple[Tensor, Tensor]:
    """(u, v, disparity) (m, 3) and relative depths (m,) at one tangent offset (19,)."""
    found = stereo_pose._measure(tangent[None], state.pose, state.clone, state.offset, INTRINSICS, landmarks)
    return found[0][0], found[1][0]


NOWHERE = torch.zeros(STATE_SIZE, dtype=torch.float64)


def derivative_by_state(state: State, landmarks: Tensor) -> Tensor:
    jacobian: Tensor = jacrev(lambda tangent: measure(tangent, state, landmarks)[0].flatten())(NOWHERE)
    return jacobian


def effective_noise(state: State, landmarks: Tensor, sigma: Tensor, noise: Tensor) -> Tensor:
    """Noise with the landmarks' own (sigma (m, 3)), through automatic differentiation."""
    jacobians = torch.stack([jacrev(lambda x: measure(NOWHERE, state, x[None])[0][0])(x) for x in landmarks])
    total: Tensor = noise + jacobians @ torch.diag_embed(sigma**2) @ jacobians.mT
    return total


def true_measurement(pose: Tensor, clone: Tensor, landmarks: Tensor, offset: float) -> Tensor:
    """(u, v, disparity) by the numpy camera: triangulate, move, project."""
    uvd = landmarks.numpy() - [0.0, 0.0, offset]
    T = (invert_se3(pose) @ clone).numpy()
    seen = CAMERA.triangulate(uvd) @ T[:3, :3].T + T[:3, 3]
    return torch.from_numpy(CAMERA.project(seen) + np.array([0.0, 0.0, offset]))


def block_diagonal_adjoint(T: Tensor) -> Tensor:
    """What a change of world does to the error state: poses are perturbed from the left, the rest is not touched."""
    matrix = torch.eye(STATE_SIZE, dtype=torch.float64)
    matrix[POSE, POSE] = adjoint_se3(T)
    matrix[CLONE, CLONE] = adjoint_se3(T)
    return matrix


def test_runtime_and_torch_agree_on_the_layout():
    for name in ("POSE", "TWIST", "CALIBRATION", "CLONE", "STATE_SIZE"):
        assert getattr(pose_filter, name) == getattr(stereo_pose, name), name
    covered = [i for block in (POSE, TWIST, CALIBRATION, CLONE) for i in range(STATE_SIZE)[block]]
    assert covered == list(range(STATE_SIZE))


# Prediction


def constant_velocity(state: State, step: float, densities: Tensor) -> Tensor:
    """Closed form at zero twist: the adjoint carries body velocities into the world's perturbation."""
    A = adjoint_se3(state.pose)
    F = torch.eye(STATE_SIZE, dtype=torch.float64)
    F[POSE, TWIST] = step * A
    six = torch.diag(torch.cat([densities[0].expand(3), densities[1].expand(3)]))
    Q = torch.zeros(STATE_SIZE, STATE_SIZE, dtype=torch.float64)
    Q[POSE, POSE] = step**3 / 3 * A @ six @ A.T
    Q[POSE, TWIST] = step**2 / 2 * A @ six
    Q[TWIST, POSE] = step**2 / 2 * six @ A.T
    Q[TWIST, TWIST] = step * six
    Q[CALIBRATION, CALIBRATION] = step * densities[2]
    return F @ state.covariance @ F.T + Q


def test_prediction_at_rest_is_the_constant_velocity_model():
    state = some_state(sigma=1e-6)
    state.twist = torch.zeros(6, dtype=torch.float64)
    densities = tensor(2e-12, 5e-12, 1e-12)
    pose, covariance = Predict()(state.pose, state.twist, state.covariance, tensor(0.25).squeeze(), densities)
    expected = constant_velocity(state, 0.25, densities)
    torch.testing.assert_close(pose, state.pose, rtol=0, atol=1e-9)
    torch.testing.assert_close(covariance, expected, rtol=0, atol=1e-5 * float(expected.max()))


def test_prediction_without_rotation_is_exact_however_uncertain():
    """Translations commute, so the sigma points meet the linear model exactly."""
    state = some_state(sigma=1.0)
    state.pose = exp_se3(tensor(1, -2, 3, 0, 0, 0))
    state.twist = tensor(1, 0.5, -2, 0, 0, 0)
    turning = [*range(3, 6), *range(9, 12)]
    state.covariance[turning], state.covariance[:, turning] = 0.0, 0.0
    pose, covariance = Predict()(state.pose, state.twist, state.covariance, tensor(0.4).squeeze(), tensor(0.3, 0, 0.1))
    torch.testing.assert_close(pose, exp_se3(tensor(1.4, -1.8, 2.2, 0, 0, 0)), rtol=0, atol=1e-13)
    expected = constant_velocity(state, 0.4, tensor(0.3, 0, 0.1))
    torch.testing.assert_close(covariance, expected, rtol=0, atol=1e-12 * float(expected.max()))


def test_two_half_steps_are_one_whole_step():
    state = some_state(sigma=1e-4)
    densities = tensor(1e-6, 1e-6, 1e-6)
    whole = Predict()(state.pose, state.twist, state.covariance, tensor(0.1).squeeze(), densities)
    half = tensor(0.05).squeeze()
    pose, covariance = Predict()(state.pose, state.twist, state.covariance, half, densities)
    pose, covariance = Predict()(pose, state.twist, covariance, half, densities)
    torch.testing.assert_close(pose, whole[0], rtol=0, atol=1e-7)
    # The noise is exact at rest and of second order in twist times step otherwise.
    torch.testing.assert_close(covariance, whole[1], rtol=0, atol=5e-3 * float(whole[1].max()))


def test_two_half_steps_without_noise_differ_only_by_the_sigma_points_curvature():
    state = some_state(sigma=1e-5)
    whole = Predict()(state.pose, state.twist, state.covariance, tensor(0.2).squeeze(), NO_NOISE)
    half = tensor(0.1).squeeze()
    pose, covariance = Predict()(state.pose, state.twist, state.covariance, half, NO_NOISE)
    pose, covariance = Predict()(pose, state.twist, covariance, half, NO_NOISE)
    torch.testing.assert_close(pose, whole[0], rtol=0, atol=1e-9)
    torch.testing.assert_close(covariance, whole[1], rtol=0, atol=1e-7 * float(whole[1].max()))


def test_prediction_commutes_with_a_change_of_world():
    state = some_state(sigma=1e-5)
    W = exp_se3(tensor(3, -2, 5, 1, -0.5, 0.7))
    A = block_diagonal_adjoint(W)
    step, densities = tensor(0.1).squeeze(), tensor(1e-7, 1e-8, 1e-9)
    pose, covariance = Predict()(state.pose, state.twist, state.covariance, step, densities)
    moved = Predict()(W @ state.pose, state.twist, A @ state.covariance @ A.T, step, densities)
    torch.testing.assert_close(moved[0], W @ pose, rtol=0, atol=1e-7)
    expected = A @ covariance @ A.T
    torch.testing.assert_close(moved[1], expected, rtol=0, atol=1e-6 * float(expected.max()))


def test_prediction_keeps_clone_and_offset():
    state = some_state()
    _, covariance = Predict()(state.pose, state.twist, state.covariance, tensor(0.1).squeeze(), tensor(1, 1, 0))
    torch.testing.assert_close(covariance[12:, 12:], state.covariance[12:, 12:], rtol=0, atol=1e-15)


# Measurement


@pytest.mark.parametrize("offset", [0.0, 0.8, -0.5])
def test_measurement_agrees_with_the_camera(offset):
    state, landmarks = some_state(), some_landmarks(30)
    state.offset = tensor(offset)
    expected = true_measurement(state.pose, state.clone, landmarks, offset)
    found, share = measure(NOWHERE, state, landmarks)
    torch.testing.assert_close(found, expected, rtol=0, atol=1e-10)
    depth, depth_in_keyframe = 80.0 / (expected[:, 2] - offset), 80.0 / (landmarks[:, 2] - offset)
    torch.testing.assert_close(share, depth / depth_in_keyframe, rtol=1e-12, atol=0)


def test_points_at_infinity_move_with_rotation_only():
    state = some_state()
    landmarks = tensor(200.0, 150.0, 0.3).expand(1, 3)  # the disparity is all offset
    before, _ = measure(NOWHERE, state, landmarks)
    state.pose = state.pose.clone()
    state.pose[:3, 3] += 100.0
    after, _ = measure(NOWHERE, state, landmarks)
    torch.testing.assert_close(after, before, rtol=0, atol=1e-10)
    assert float(after[0, 2]) == pytest.approx(0.3, abs=1e-12)


def test_landmark_covariance_is_carried_by_the_derivative_of_the_measurement():
    state = some_state()
    state.covariance = 0 * state.covariance
    landmarks, sigma, noise = some_landmarks(25), sigmas(25, 0.5), covariances(25, 0.3)
    _, found, _ = innovate(state, landmarks, sigma, noise)
    torch.testing.assert_close(found, effective_noise(state, landmarks, sigma, noise), rtol=1e-10, atol=1e-12)


@pytest.mark.parametrize("weight", [(1, 1, 1), (1, 1, 0), (0, 1, 1), (0, 0, 1), (0, 0, 0)])
def test_squared_residual_is_the_mahalanobis_distance_of_the_components_that_take_part(weight):
    """Nothing to estimate: what is left is the whitening."""
    state, (landmarks, sigma, measurement, noise, _) = problem(count=6)
    state.covariance = 0 * state.covariance
    found = update(state, (landmarks, sigma, measurement, noise, tensor(*weight).expand(6, 3)))
    error = measurement - measure(NOWHERE, state, landmarks)[0]
    kept = np.flatnonzero(weight)
    total = effective_noise(state, landmarks, sigma, noise)
    expected = [
        float(e[kept] @ torch.linalg.solve(S[np.ix_(kept, kept)], e[kept])) for e, S in zip(error, total, strict=True)
    ]
    np.testing.assert_allclose(found[7].numpy(), expected, rtol=1e-10, atol=1e-12)
    assert float(found[5]) == pytest.approx(sum(expected), rel=1e-10, abs=1e-12)
    torch.testing.assert_close(found[0], state.pose, rtol=0, atol=1e-14)
    torch.testing.assert_close(found[4], state.covariance, rtol=0, atol=1e-15)


def innovate(state: State, landmarks: Tensor, sigma: Tensor, noise: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    found: tuple[Tensor, Tensor, Tensor] = Innovate()(*state.seen(), INTRINSICS, landmarks, sigma, noise)
    return found


def test_points_behind_the_camera_are_flagged():
    state = some_state(sigma=1e-4)
    state.clone = torch.eye(4, dtype=torch.float64)
    state.pose = exp_se3(tensor(0, 0, 4, 0, 0, 0))
    depths = tensor(20, 5, 4.5, 4.1, 3.9, 2.0)
    landmarks = torch.stack([tensor(330.0).expand(6), tensor(230.0).expand(6), 80 / depths + 0.3], dim=1)
    predicted, S, in_front = innovate(state, landmarks, sigmas(6, 0.3), covariances(6, 0.3))
    # 4.1 m is in front, but at less than a sixteenth of its depth in the keyframe.
    assert in_front.tolist() == [1, 1, 1, 0, 0, 0]
    assert torch.isfinite(predicted).all()
    assert torch.isfinite(S).all()


def test_a_fresh_clone_makes_no_innovation_however_uncertain_the_world_pose():
    """Pose and keyframe wrong together: what the images see is exactly certain."""
    state = some_state()
    root = 0.3 * random_numbers(6, 6)
    choice = torch.zeros(STATE_SIZE, 6, dtype=torch.float64)
    choice[POSE], choice[CLONE] = torch.eye(6).double(), torch.eye(6).double()
    state.clone = state.pose
    state.covariance = choice @ root @ root.T @ choice.T
    landmarks, noise = some_landmarks(20), covariances(20, 0.3)
    predicted, S, _ = innovate(state, landmarks, torch.zeros(20, 3).double(), noise)
    torch.testing.assert_close(predicted, landmarks, rtol=0, atol=1e-9)
    torch.testing.assert_close(S, noise, rtol=0, atol=1e-12)


def problem(count: int = 40, sigma: float = 1e-3, seed: int = 0) -> tuple[State, tuple[Tensor, ...]]:
    """A state, and landmarks, their deviations, measurement, noise and weight."""
    state = some_state(sigma, seed)
    landmarks = some_landmarks(count, seed)
    measurement = true_measurement(state.pose, state.clone, landmarks, 0.3)
    measurement = measurement + 0.5 * random_numbers(count, 3, seed=seed + 9)
    noise = covariances(count, 0.4, seed=seed + 1)
    weight = torch.ones(count, 3, dtype=torch.float64)
    return state, (landmarks, sigmas(count, 0.3), measurement, noise, weight)


def update(state: State, points: tuple[Tensor, ...]) -> tuple[Tensor, ...]:
    found: tuple[Tensor, ...] = Update()(*state.all(), INTRINSICS, *points)
    return found


def test_change_of_world_changes_neither_innovation_nor_nis():
    state, points = problem(sigma=1e-5)
    W = exp_se3(tensor(3, -2, 5, 1, -0.5, 0.7))
    A = block_diagonal_adjoint(W)
    moved = State(W @ state.pose, W @ state.clone, state.twist, state.offset, A @ state.covariance @ A.T)
    for a, b in zip(innovate(state, *points[:2], points[3]), innovate(moved, *points[:2], points[3]), strict=True):
        torch.testing.assert_close(a, b, rtol=0, atol=1e-6)
    found, other = update(state, points), update(moved, points)
    torch.testing.assert_close(W @ found[0], other[0], rtol=0, atol=1e-7)
    torch.testing.assert_close(W @ found[1], other[1], rtol=0, atol=1e-7)
    expected = A @ found[4] @ A.T
    torch.testing.assert_close(other[4], expected, rtol=0, atol=1e-4 * float(expected.max()))
    for a, b in zip(found[2:4] + found[5:], other[2:4] + other[5:], strict=True):
        torch.testing.assert_close(a, b, rtol=1e-5, atol=1e-5)


def test_update_equals_the_dense_kalman_update_when_nearly_linear():
    state, (landmarks, sigma, measurement, noise, weight) = problem(count=12, sigma=1e-5)
    H = derivative_by_state(state, landmarks)
    R = torch.block_diag(*effective_noise(state, landmarks, sigma, noise))
    S = H @ state.covariance @ H.T + R
    innovation = (measurement - true_measurement(state.pose, state.clone, landmarks, 0.3)).flatten()
    gain = state.covariance @ H.T @ torch.linalg.inv(S)
    correction, covariance = gain @ innovation, state.covariance - gain @ S @ gain.T
    pose, clone, twist, offset, posterior, nis, _, _ = update(state, (landmarks, sigma, measurement, noise, weight))
    scale = float(state.covariance.max()) ** 0.5
    torch.testing.assert_close(log_se3(pose @ invert_se3(state.pose)), correction[POSE], rtol=0, atol=1e-3 * scale)
    torch.testing.assert_close(log_se3(clone @ invert_se3(state.clone)), correction[CLONE], rtol=0, atol=1e-3 * scale)
    torch.testing.assert_close(twist - state.twist, correction[TWIST], rtol=0, atol=1e-3 * scale)
    torch.testing.assert_close(offset - state.offset, correction[CALIBRATION], rtol=0, atol=1e-3 * scale)
    torch.testing.assert_close(posterior, covariance, rtol=0, atol=1e-3 * scale**2)
    assert float(nis) == pytest.approx(float(innovation @ torch.linalg.solve(S, innovation)), rel=1e-4)


def test_value_of_a_masked_component_does_not_matter():
    state, (landmarks, sigma, measurement, noise, weight) = problem()
    weight = weight.clone()
    weight[::3, 2] = 0.0
    weight[::5] = 0.0
    changed = torch.where(weight > 0, measurement, 1234.5 * torch.ones_like(measurement))
    for a, b in zip(
        update(state, (landmarks, sigma, measurement, noise, weight)),
        update(state, (landmarks, sigma, changed, noise, weight)),
        strict=True,
    ):
        torch.testing.assert_close(a, b, rtol=0, atol=1e-15)


def test_a_masked_point_is_a_point_left_out():
    state, points = problem()
    weight = points[4].clone()
    weight[[3, 17]] = 0.0
    kept = [i for i in range(40) if i not in (3, 17)]
    masked = update(state, (*points[:4], weight))
    without = update(state, tuple(part[kept] for part in points))
    for a, b in zip(masked[:7], without[:7], strict=True):
        torch.testing.assert_close(a, b, rtol=1e-9, atol=1e-11)
    torch.testing.assert_close(masked[7][kept], without[7], rtol=1e-9, atol=1e-11)
    assert (masked[7][[3, 17]] == 0).all()


def test_missing_disparity_counts_as_masked_at_run_time():
    state, (landmarks, sigma, measurement, noise, weight) = problem()
    weight = weight.clone()
    weight[::4, 2] = 0.0
    expected = update(state, (landmarks, sigma, measurement, noise, weight))
    missing = measurement.numpy().copy()
    missing[::4, 2] = np.nan
    pose_filter_ = PoseFilter(CAMERA, 0.5, backend="torch")
    pose_filter_.state = pose_filter.PoseState(*(value.numpy() for value in state.all()))
    points = StereoPoints(landmarks.numpy(), sigma.numpy(), missing, noise.numpy())
    posterior, result = pose_filter_.evaluate_update(points)
    np.testing.assert_allclose(posterior.pose, expected[0].numpy(), atol=1e-14)
    np.testing.assert_allclose(posterior.covariance, expected[4].numpy(), atol=1e-14)
    assert result.dof == 110
    assert set(result.components[::4]) == {2}
    assert result.nis == pytest.approx(float(expected[5]), rel=1e-12)


def test_posterior_covariance_of_many_precise_points_is_the_inverse_information():
    """A posterior a ten-thousandth of the prior must not drown in round-off."""
    state = some_state()
    state.covariance = torch.zeros(STATE_SIZE, STATE_SIZE, dtype=torch.float64)
    state.covariance[POSE, POSE] = 1e-2**2 * torch.eye(6, dtype=torch.float64)
    landmarks = some_landmarks(200)
    noise = 1e-3**2 * torch.eye(3, dtype=torch.float64).expand(200, 3, 3)
    measurement = true_measurement(state.pose, state.clone, landmarks, 0.3)
    points = (landmarks, 0 * landmarks, measurement, noise, torch.ones(200, 3, dtype=torch.float64))
    posterior = update(state, points)[4][POSE, POSE]
    H = derivative_by_state(state, landmarks)[:, POSE]
    expected = torch.linalg.inv(H.T @ H / 1e-3**2 + torch.eye(6, dtype=torch.float64) / 1e-2**2)
    assert torch.isfinite(posterior).all()
    whitener = torch.linalg.inv(torch.linalg.cholesky(expected))
    ratio = torch.linalg.eigvalsh(whitener @ posterior @ whitener.T)
    assert ratio.min() > 0.99
    assert ratio.max() < 1.05


# Consistency


def normalised_error(error: Tensor, covariance: Tensor) -> float:
    return float(error @ torch.linalg.solve(covariance, error))


def band(runs: int, dimension: int) -> tuple[float, float]:
    """99 % of the mean of `runs` chi-square numbers."""
    low, high = chi2.ppf([0.005, 0.995], runs * dimension) / runs
    return float(low), float(high)


def simulate(seed: int, step: float, densities: Tensor, sigma_twist: Tensor, points: int) -> tuple[State, State, tuple]:
    """True state now, filter's state at the keyframe, and what is measured: exactly the filter's model."""
    generator = torch.Generator().manual_seed(seed)

    def normal(*shape: int) -> Tensor:
        return torch.randn(*shape, generator=generator, dtype=torch.float64)

    keyframe = exp_se3(normal(6))
    covariance = torch.zeros(STATE_SIZE, STATE_SIZE, dtype=torch.float64)
    covariance[TWIST, TWIST] = torch.diag(sigma_twist**2)
    covariance[CALIBRATION, CALIBRATION] = 0.3**2
    prior = State(keyframe, keyframe, tensor(0.2, 0, 1, 0, 0.2, 0), tensor(0.0), covariance)
    # White acceleration over one step: displacement and change of velocity are correlated.
    root = torch.linalg.cholesky(tensor(step**3 / 3, step**2 / 2, step**2 / 2, step).reshape(2, 2))
    six = torch.cat([densities[0].expand(3), densities[1].expand(3)]).sqrt()
    shift, change = (root @ normal(2, 6)) * six
    twist = prior.twist + sigma_twist * normal(6)
    offset = 0.3 * normal(1)
    pose = keyframe @ exp_se3(twist * step) @ exp_se3(shift)
    truth = State(pose, keyframe, twist + change, offset, covariance)

    exact = some_landmarks(points, seed)
    measurement = true_measurement(pose, keyframe, exact, float(offset))
    noise = covariances(points, 0.4, seed=seed + 1)
    sigma = sigmas(points, 0.3, seed=seed + 2)
    landmarks = exact + sigma * normal(points, 3)
    measurement = measurement + (torch.linalg.cholesky(noise) @ normal(points, 3, 1)).squeeze(-1)
    weight = torch.ones(points, 3, dtype=torch.float64)
    weight[::7, 2] = 0.0
    return truth, prior, (landmarks, sigma, measurement, noise, weight)


def runs_from_keyframe_to_frame(runs: int) -> dict[str, list[float]]:
    """One prediction and one update each: NEES of the pose and of all that is estimated, and NIS."""
    step, densities = 0.1, tensor(2.0, 0.02, 0.0)
    sigma_twist = tensor(0.5, 0.5, 0.5, 0.05, 0.05, 0.05)
    found: dict[str, list[float]] = {"pose": [], "state": [], "nis": []}
    for seed in range(runs):
        truth, state, points = simulate(seed, step, densities, sigma_twist, 25)
        state.pose, state.covariance = Predict()(
            state.pose, state.twist, state.covariance, tensor(step).squeeze(), densities
        )
        pose, _, twist, offset, covariance, nis, _, _ = update(state, points)
        error = torch.cat([log_se3(truth.pose @ invert_se3(pose)), truth.twist - twist, truth.offset - offset])
        found["pose"].append(normalised_error(error[:6], covariance[POSE, POSE]))
        found["state"].append(normalised_error(error, covariance[:13, :13]))
        found["nis"].append(float(nis))
    return found


@pytest.fixture(scope="module")
def keyframe_runs() -> dict[str, list[float]]:
    return runs_from_keyframe_to_frame(100)


@pytest.mark.parametrize(("name", "dimension"), [("pose", 6), ("state", 13)])
def test_filter_is_consistent_from_keyframe_to_frame(keyframe_runs, name, dimension):
    """Mean NEES within the 99 % band, and the median too."""
    values = keyframe_runs[name]
    low, high = band(len(values), dimension)
    assert low < np.mean(values) < high
    median = float(chi2.ppf(0.5, dimension))
    assert abs(np.median(values) - median) < 3 * 1.2533 * np.sqrt(2 * dimension / len(values))


def test_innovation_is_as_large_as_its_degrees_of_freedom(keyframe_runs):
    """With a prior of 8 px and points of half a pixel; a tenth is left to the curvature of the measurement."""
    dof = 25 * 3 - 4
    low, high = band(100, dof)
    assert low < np.mean(keyframe_runs["nis"]) < 1.1 * high
    assert np.median(keyframe_runs["nis"]) == pytest.approx(dof, rel=0.1)


def test_prediction_is_consistent():
    runs, step, densities = 100, 0.2, tensor(2.0, 0.5, 0.0)
    nees = []
    for seed in range(runs):
        truth, state, _ = simulate(seed, step, densities, tensor(0.5, 0.5, 0.5, 0.2, 0.2, 0.2), 1)
        pose, covariance = Predict()(state.pose, state.twist, state.covariance, tensor(step).squeeze(), densities)
        error = torch.cat([log_se3(truth.pose @ invert_se3(pose)), truth.twist - state.twist])
        nees.append(normalised_error(error, covariance[:12, :12]))
    low, high = band(runs, 12)
    assert low < np.mean(nees) < high, np.mean(nees)


def test_second_iteration_makes_precise_points_consistent(monkeypatch):
    """R10: 200 points of 0.3 px from a prior of 0.04 m and 0.06 rad."""
    runs = 25
    sigma = tensor(0.04, 0.04, 0.04, 0.06, 0.06, 0.06)
    mean = {}
    for iterations in (1, 2):
        monkeypatch.setattr(stereo_pose, "UPDATE_ITERATIONS", iterations)
        values = []
        for seed in range(runs):
            state = State(
                *(torch.eye(4, dtype=torch.float64),) * 2,
                torch.zeros(6, dtype=torch.float64),
                tensor(0.0),
                torch.zeros(STATE_SIZE, STATE_SIZE, dtype=torch.float64),
            )
            state.covariance[POSE, POSE] = torch.diag(sigma**2)
            truth = exp_se3(sigma * random_numbers(6, seed=seed))
            landmarks = some_landmarks(200, seed)
            measurement = true_measurement(truth, state.clone, landmarks, 0.0)
            measurement = measurement + 0.3 * random_numbers(200, 3, seed=1000 + seed)
            noise = 0.3**2 * torch.eye(3, dtype=torch.float64).expand(200, 3, 3)
            weight = torch.ones(200, 3, dtype=torch.float64)
            pose, _, _, _, covariance, _, _, _ = update(state, (landmarks, 0 * landmarks, measurement, noise, weight))
            values.append(normalised_error(log_se3(truth @ invert_se3(pose)), covariance[POSE, POSE]))
        mean[iterations] = np.mean(values)
    assert mean[1] > 20.0
    low, high = band(runs, 6)
    assert low < mean[2] < high, mean
