import pytest
import torch
from torch import Tensor
from torch.func import jacrev, vmap

from sigmaslam.geometry.camera import RectifiedStereo
from sigmaslam_filters.manifolds.se3_matrices import exp_se3, invert_se3
from sigmaslam_models.estimator.stereo_window import CALIBRATION, LANDMARK, POSE, SIZE, StereoTransfer
from tests.support.filter_builders import random_numbers, tensor

CAMERA = RectifiedStereo(fx=400.0, fy=410.0, cx=320.0, cy=240.0, baseline=0.2, width=640, height=480)
INTRINSICS = tensor(400.0, 410.0, 320.0, 240.0, 80.0)
NO_TURN = tensor(0.3, 0.0, 0.0)
STRAIGHT = torch.eye(4, dtype=torch.float64)[None]
TINY = 1e-6


def some_landmarks(count: int, seed: int = 0) -> Tensor:
    """(u, v, disparity, own error): 2 to 20 m away."""
    generator = torch.Generator().manual_seed(seed)
    uniform = torch.rand(count, 4, generator=generator, dtype=torch.float64)
    return tensor(30.0, 30.0, 4.0, -0.2) + uniform * tensor(580.0, 420.0, 36.0, 0.4)


def transfer(relative, spread, landmarks, landmark_spread, calibration=NO_TURN, pair=None):
    """One pair for all landmarks unless given; one landmark_spread (4, 4) for all unless (m, 4, 4)."""
    if pair is None:
        pair = torch.zeros(len(landmarks), dtype=torch.int64)
    each = landmark_spread.expand(len(landmarks), 4, 4)
    found: tuple[Tensor, Tensor, Tensor, Tensor] = StereoTransfer()(
        relative, spread.expand(len(relative), 9, 9), pair, calibration, INTRINSICS, landmarks, each
    )
    return found


def certain(relative: Tensor, landmarks: Tensor, calibration: Tensor = NO_TURN) -> Tensor:
    """The expected measurement where everything is known."""
    return transfer(relative, torch.zeros(9, 9).double(), landmarks, torch.zeros(4, 4).double(), calibration)[0]


def bias(uvd: Tensor, disparity: Tensor, calibration: Tensor) -> Tensor:
    """What the calibration adds to a disparity: constant, yaw and pitch, at the right image's coordinates."""
    x = (uvd[..., 0] - disparity - 320.0) / 400.0
    y = (uvd[..., 1] - 240.0) / 410.0
    return calibration[0] + calibration[1] * x**2 + calibration[2] * x * y


def through_the_point(change: Tensor, relative: Tensor, calibration: Tensor, landmark: Tensor) -> Tensor:
    """(u, v, disparity) (3,) in the view by way of the point itself, after a change (13,) of everything."""
    T = exp_se3(change[POSE]) @ relative
    calibration = calibration + change[CALIBRATION]
    landmark = landmark + change[LANDMARK]
    true = landmark[2] - landmark[3] - bias(landmark, landmark[2], calibration)
    depth = 80.0 / true
    point = torch.stack([(landmark[0] - 320) / 400 * depth, (landmark[1] - 240) / 410 * depth, depth])
    X, Y, Z = T[:3, :3] @ point + T[:3, 3]
    seen = torch.stack([320 + 400 * X / Z, 240 + 410 * Y / Z, 80 / Z])
    return torch.stack([seen[0], seen[1], seen[2] + landmark[3] + bias(seen, seen[2], calibration)])


def test_a_point_ahead_is_seen_nearer_after_a_step_towards_it():
    """4 m ahead and 1 m to the right, off by 0.5 px of which 0.3 the calibration's; one metre on it is 3 m ahead."""
    landmark = tensor(420.0, 240.0, 20.5, 0.2)[None]
    found = certain(exp_se3(tensor(0, 0, -1, 0, 0, 0))[None], landmark)
    torch.testing.assert_close(found, tensor(320 + 400 / 3, 240, 80 / 3 + 0.5)[None], rtol=1e-14, atol=0)


def test_a_landmark_is_seen_by_its_host_as_it_was_measured():
    landmarks, calibration = some_landmarks(20), tensor(0.4, 0.0, 0.0)
    torch.testing.assert_close(certain(STRAIGHT, landmarks, calibration), landmarks[:, :3], rtol=1e-13, atol=0)


def test_a_landmark_is_seen_by_its_host_as_measured_to_first_order_in_the_turn_of_the_right_camera():
    """The bias is taken at the measured disparity in the host and at the true one in the view."""
    landmarks, turn = some_landmarks(20), tensor(0.0, 3.0, -2.0)
    errors = [float((certain(STRAIGHT, landmarks, s * turn) - landmarks[:, :3]).abs().max()) for s in (1.0, 0.1)]
    assert errors[0] < 0.1
    assert errors[1] < errors[0] / 50


@pytest.mark.parametrize("offset", [0.0, 0.8, -0.5])
def test_measurement_agrees_with_the_camera(offset):
    landmarks = some_landmarks(30)
    T = exp_se3(0.05 * random_numbers(6, seed=2))
    true = landmarks[:, :3] - tensor(0, 0, offset) - landmarks[:, 3:] * tensor(0, 0, 1)
    seen = CAMERA.triangulate(true.numpy()) @ T[:3, :3].T.numpy() + T[:3, 3].numpy()
    expected = torch.from_numpy(CAMERA.project(seen)) + tensor(0, 0, offset) + landmarks[:, 3:] * tensor(0, 0, 1)
    torch.testing.assert_close(certain(T[None], landmarks, tensor(offset, 0, 0)), expected, rtol=0, atol=1e-10)


def test_points_at_infinity_move_with_rotation_only():
    infinite = tensor(200.0, 150.0, 0.5, 0.2)[
        None
    ]  # the disparity is all error: 0.3 px of the calibration, 0.2 its own
    rotation = exp_se3(tensor(0, 0, 0, 0.01, -0.02, 0.03))[None]
    moved = rotation.clone()
    moved[:, :3, 3] = 100.0
    torch.testing.assert_close(certain(moved, infinite), certain(rotation, infinite), rtol=0, atol=1e-9)
    assert float(certain(moved, infinite)[0, 2]) == pytest.approx(0.5, abs=1e-12)


def test_what_a_landmark_is_off_by_in_all_views_alike_moves_no_point():
    landmarks, T = some_landmarks(10), exp_se3(0.05 * random_numbers(6, seed=2))[None]
    off = landmarks + tensor(0, 0, 0.7, 0.7)
    expected = certain(T, landmarks) + tensor(0, 0, 0.7)
    torch.testing.assert_close(certain(T, off), expected, rtol=0, atol=1e-12)


def test_with_a_vanishing_spread_the_slope_is_the_derivative():
    """Against automatic differentiation of another way to project; what it leaves vanishes too."""
    landmarks, calibration = some_landmarks(25), tensor(0.3, 0.8, -0.5)
    relative = exp_se3(0.1 * random_numbers(6, seed=3))
    nine, four = TINY * torch.eye(9, dtype=torch.float64), TINY * torch.eye(4, dtype=torch.float64)
    mean, slope, left, in_front = transfer(relative[None], nine, landmarks, four, calibration)
    nowhere = torch.zeros(SIZE, dtype=torch.float64)
    expected = vmap(lambda landmark: through_the_point(nowhere, relative, calibration, landmark))(landmarks)
    derivative = vmap(jacrev(through_the_point), (None, None, None, 0))(nowhere, relative, calibration, landmarks)
    assert in_front.all()
    torch.testing.assert_close(mean, expected, rtol=0, atol=1e-8)
    # Differences of numbers of size 600 over steps of 1e-6 have eight digits after the point.
    torch.testing.assert_close(slope / TINY, derivative, rtol=1e-6, atol=1e-5)
    assert left.abs().max() < 1e-14


def test_the_slope_comes_times_the_spread():
    """In a linear range a correlated spread gives the derivative times its factor, column by column."""
    landmarks, calibration = some_landmarks(8), tensor(0.3, 0.8, -0.5)
    relative = exp_se3(0.1 * random_numbers(6, seed=3))
    nine = 1e-5 * random_numbers(9, 9).tril()
    four = 1e-5 * random_numbers(8, 4, 4, seed=1).tril()
    _, slope, _, _ = transfer(relative[None], nine, landmarks, four, calibration)
    nowhere = torch.zeros(SIZE, dtype=torch.float64)
    derivative = vmap(jacrev(through_the_point), (None, None, None, 0))(nowhere, relative, calibration, landmarks)
    expected = torch.cat([derivative[:, :, :9] @ nine, derivative[:, :, 9:] @ four], dim=2)
    torch.testing.assert_close(slope, expected, rtol=0, atol=1e-5 * float(expected.abs().max()))


def test_where_the_measurement_is_linear_the_slope_is_exact_and_leaves_nothing_however_large_the_spread():
    """Steps to the side without a turn: places are linear in the step, in the landmark and in the constant."""
    landmarks = some_landmarks(12)
    relative = exp_se3(tensor(-0.4, 0.2, 0, 0, 0, 0))
    nine = torch.diag(tensor(0.3, 0.4, 0, 0, 0, 0, 2.0, 0, 0))
    four = 3.0 * (torch.eye(4, dtype=torch.float64) + 0.3 * random_numbers(4, 4).tril())
    mean, slope, left, _ = transfer(relative[None], nine, landmarks, four)
    nowhere = torch.zeros(SIZE, dtype=torch.float64)
    derivative = vmap(jacrev(through_the_point), (None, None, None, 0))(nowhere, relative, NO_TURN, landmarks)
    torch.testing.assert_close(mean, certain(relative[None], landmarks), rtol=0, atol=1e-10)
    torch.testing.assert_close(slope, derivative @ torch.block_diag(nine, four), rtol=0, atol=1e-10)
    assert left.abs().max() < 1e-20


def test_what_the_slope_leaves_grows_with_the_fourth_power_of_the_spread():
    landmarks, relative = some_landmarks(10), exp_se3(0.1 * random_numbers(6, seed=3))[None]
    nine, four = torch.diag(tensor(*[0.02] * 3, *[0.01] * 3, *[0.3] * 3)), 0.3 * torch.eye(4, dtype=torch.float64)
    _, _, wide, _ = transfer(relative, nine, landmarks, four)
    _, _, narrow, _ = transfer(relative, 0.5 * nine, landmarks, 0.5 * four)
    assert wide.diagonal(dim1=1, dim2=2).min() > 0
    torch.testing.assert_close(narrow, wide / 16, rtol=0, atol=2e-3 * float(wide.abs().max()))


@pytest.mark.long
@pytest.mark.parametrize("scale", [0.3, 1.0])
def test_mean_and_covariance_agree_with_monte_carlo(scale):
    landmarks, relative = some_landmarks(4, seed=5), exp_se3(0.1 * random_numbers(6, seed=3))
    nine = scale * torch.diag(tensor(*[0.02] * 3, *[0.01] * 3, *[0.4] * 3))
    nine[3, 0] = 0.005
    four = scale * 0.5 * torch.eye(4, dtype=torch.float64)
    mean, slope, left, _ = transfer(relative[None], nine, landmarks, four)
    count = 200_000
    changes = random_numbers(count, SIZE) @ torch.block_diag(nine, four).T
    for k, landmark in enumerate(landmarks):
        samples = vmap(through_the_point, (0, None, None, None))(changes, relative, NO_TURN, landmark)
        expected = samples.T.cov()
        deviations = expected.diagonal().sqrt()
        assert ((mean[k] - samples.mean(dim=0)) / deviations).abs().max() < 5 / count**0.5
        found = slope[k] @ slope[k].T + left[k]
        assert ((found - expected) / torch.outer(deviations, deviations)).abs().max() < 0.02


def test_a_common_motion_of_host_and_view_changes_nothing():
    landmarks = some_landmarks(10)
    host, view = exp_se3(0.3 * random_numbers(6)), exp_se3(0.3 * random_numbers(6, seed=1))
    nine, four = 0.01 * random_numbers(9, 9).tril(), 0.2 * torch.eye(4, dtype=torch.float64)
    W = exp_se3(tensor(3, -2, 5, 1, -0.5, 0.7))
    first = transfer((invert_se3(view) @ host)[None], nine, landmarks, four)
    second = transfer((invert_se3(W @ view) @ (W @ host))[None], nine, landmarks, four)
    for a, b in zip(first, second, strict=True):
        torch.testing.assert_close(a, b, rtol=0, atol=1e-9)


def test_a_batch_of_pairs_equals_one_after_the_other():
    landmarks = some_landmarks(12)
    relative = exp_se3(0.05 * random_numbers(3, 6))
    nine, four = 0.01 * random_numbers(3, 9, 9).tril(), 0.2 * random_numbers(12, 4, 4).tril()
    pair = torch.tensor([2, 0, 1, 1, 2, 0, 0, 2, 1, 1, 0, 2])
    together = transfer(relative, nine, landmarks, four, pair=pair)
    for k in range(12):
        one = pair[k : k + 1]
        alone = transfer(relative[one], nine[one], landmarks[k : k + 1], four[k : k + 1])
        for a, b in zip(together, alone, strict=True):
            torch.testing.assert_close(a[k], b[0], rtol=0, atol=1e-11)


def test_points_behind_the_view_are_flagged_and_finite():
    depth = tensor(20, 5, 4.5, 4.1, 3.9, 2.0)
    landmarks = torch.stack([tensor(330.0).expand(6), tensor(230.0).expand(6), 80 / depth + 0.3, 0 * depth], dim=1)
    nine, four = 1e-4 * torch.eye(9, dtype=torch.float64), 0.01 * torch.eye(4, dtype=torch.float64)
    *numbers, in_front = transfer(exp_se3(tensor(0, 0, -4, 0, 0, 0))[None], nine, landmarks, four)
    # 4.1 m is in front, but at less than a sixteenth of its depth in the host.
    assert in_front.tolist() == [1, 1, 1, 0, 0, 0]
    assert all(torch.isfinite(values).all() for values in numbers)
