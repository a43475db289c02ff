"""The tracker's update of a frame is `UnscentedKalmanFilter.update` of the library, for a pose and its landmarks.

The filter's state is the tangent of T_frame_keyframe, three errors of the calibration and (u, v, disparity, own error)
of each landmark; the keyframe is known. The measurement is written anew, by matrices of the exponential.
"""

from dataclasses import dataclass

import pytest
import torch
from torch import Tensor

from sigmaslam.estimation.state_layout import CALIBRATION_SIZE, LANDMARK_SIZE, MODELLED
from sigmaslam_filters import BlockDiagonal, Gaussian, MeasurementModel, UnscentedKalmanFilter
from sigmaslam_filters.core.columns import Columns
from sigmaslam_filters.core.factors import cholesky
from sigmaslam_filters.core.sigma_points import Symmetric, cubature
from sigmaslam_models.estimator import stereo_views
from sigmaslam_models.estimator.frame_update import FrameViews, GatedStep
from sigmaslam_models.estimator.graph_examples import GATED_OUTPUTS
from sigmaslam_models.estimator.stereo_window import SIZE
from tests.support.filter_builders import tensor

FX, FY, CX, CY, BASELINE = 400.0, 410.0, 320.0, 240.0, 0.2
POSE = slice(CALIBRATION_SIZE + 6, CALIBRATION_SIZE + 12)
# A gate that everything passes, and a Student's t that is a Gaussian.
OPEN, GAUSSIAN = 1e30, 1e30


@dataclass(frozen=True, slots=True)
class ViewsApart(Symmetric):
    """Pairs as far out as of one view's state alone; what is not linear in one view is independent of other views.

    These are the tracker's two liberties. With one view there are none: this is `cubature`.
    """

    def deviations(self, values: Tensor, mean: Tensor, size: int, with_centre: bool) -> Columns:
        columns = Symmetric.deviations(self, values, mean, size, with_centre)
        whole = Columns(torch.zeros_like(columns.odd), columns.even, columns.negative).covariance()
        blocks = [cholesky(whole[k : k + 3, k : k + 3])[0] for k in range(0, len(whole), 3)]
        return Columns(columns.odd, torch.block_diag(*blocks))


@dataclass(frozen=True)
class SmallScene:
    """A frame and a keyframe, and M landmarks of the keyframe that the frame sees.

    Attributes:
        T_world_frame: (4, 4); the keyframe stands in the origin.
        root: (6, 6) lower root of the covariance of T_frame_keyframe, perturbed from the left.
        calibration: (3,) standard deviations, pixels.
        landmarks, landmark_covariance: (M, 4), (M, 4, 4).
        measurement, noise: (M, 3), (M, 3, 3).
    """

    T_world_frame: Tensor
    root: Tensor
    calibration: Tensor
    landmarks: Tensor
    landmark_covariance: Tensor
    measurement: Tensor
    noise: Tensor


def scene_of(count: int) -> SmallScene:
    """So many landmarks 3 to 20 m away, a pose known to about 5 cm and 0.6 degrees."""
    generator = torch.Generator().manual_seed(count)

    def normal(*shape: int) -> Tensor:
        return torch.randn(*shape, generator=generator, dtype=torch.float64)

    identity = torch.eye(3, dtype=torch.float64)
    T = torch.linalg.matrix_exp(hat(tensor(0.1, -0.05, 0.4, 0.02, 0.05, -0.03)))
    sigma = tensor(0.05, 0.05, 0.05, 0.01, 0.01, 0.01)
    root = torch.diag(sigma) @ (torch.eye(6).double() + 0.3 * normal(6, 6).tril(-1))
    places = torch.rand(count, 3, generator=generator, dtype=torch.float64) * tensor(400.0, 300.0, 20.0)
    landmarks = torch.cat([places + tensor(120.0, 90.0, 4.0), torch.zeros(count, 1).double()], dim=1)
    landmark_root = 0.3 * normal(count, 4, 4).tril() + 0.2 * torch.eye(4).double()
    noise_root = 0.4 * normal(count, 3, 3)
    noise = noise_root @ noise_root.mT + 0.2 * identity
    seen = view(torch.zeros(1, 9 + 4 * count).double(), T, landmarks)[0].unflatten(0, (count, 3))
    covariance = landmark_root @ landmark_root.mT
    return SmallScene(T, root, tensor(0.3, 0.5, 0.5), landmarks, covariance, seen + 2.0 * normal(count, 3), noise)


def hat(twist: Tensor) -> Tensor:
    """(..., 6) -> (..., 4, 4), of which the matrix exponential is a rigid motion."""
    x, y, z, a, b, c = twist.unbind(-1)
    o = torch.zeros_like(x)
    rows = ((o, -c, b, x), (c, o, -a, y), (-b, a, o, z), (o, o, o, o))
    return torch.stack([torch.stack(row, dim=-1) for row in rows], dim=-2)


def view(states: Tensor, T_world_frame: Tensor, landmarks: Tensor) -> Tensor:
    """(u, v, disparity) of each landmark in the frame, (k, 9 + 4 M) -> (k, 3 M)."""
    T = torch.linalg.matrix_exp(hat(states[:, :6])) @ torch.linalg.inv(T_world_frame)
    constant, yaw, pitch = (error[:, None] for error in states[:, 6:9].unbind(1))
    u, v, disparity, own = (landmarks + states[:, 9:].unflatten(1, (-1, 4))).unbind(2)

    def misplaced(u: Tensor, v: Tensor, true: Tensor) -> Tensor:
        x = (u - true - CX) / FX
        return constant + yaw * x * x + pitch * x * (v - CY) / FY

    # The right eye's coordinates are as measured in the keyframe, and as they truly are in the frame.
    true = disparity - own - misplaced(u, v, disparity)
    point = torch.stack([(u - CX) / FX, (v - CY) / FY, torch.ones_like(u), true / (FX * BASELINE)], dim=2)
    x, y, z, w = (point @ T.mT).unbind(2)
    u, v, true = FX * x / z + CX, FY * y / z + CY, FX * BASELINE * w / z
    return torch.stack([u, v, true + own + misplaced(u, v, true)], dim=2).flatten(1)


def by_tracker(scene: SmallScene) -> dict[str, Tensor]:
    """One linearisation of the frame's update, at the prior, without a gate and as if all noise were as claimed."""
    count = len(scene.landmarks)
    size = POSE.stop
    by_frame = -adjoint(scene.T_world_frame)  # of a motion of T_frame_keyframe
    factor = torch.zeros(size, 9, dtype=torch.float64)
    factor[POSE, :6] = by_frame @ scene.root
    factor[:3, 6:] = torch.diag(scene.calibration)
    covariance = torch.zeros(count, LANDMARK_SIZE, LANDMARK_SIZE, dtype=torch.float64)
    covariance[:, :MODELLED, :MODELLED] = scene.landmark_covariance
    frame = FrameViews(
        intrinsics=tensor(FX, FY, CX, CY, FX * BASELINE),
        depth=tensor(5.0)[0],
        unscented=tensor(1.0)[0],
        anchors=torch.tensor([0]),
        views=torch.tensor([1]),
        pair=torch.zeros(count, dtype=torch.int64),
        common=torch.zeros(count, 3, 2, dtype=torch.float64),
        covariance=covariance,
        estimate=torch.nn.functional.pad(scene.landmarks, (0, LANDMARK_SIZE - MODELLED)),
        dependence=torch.zeros(count, LANDMARK_SIZE, size, dtype=torch.float64),
        poses=torch.stack([torch.eye(4, dtype=torch.float64), scene.T_world_frame]),
        calibration=torch.zeros(CALIBRATION_SIZE, dtype=torch.float64),
        factor=factor,
    )
    offset, moved = torch.zeros(size, dtype=torch.float64), torch.zeros_like(frame.estimate)
    numbers = (torch.tensor(each, dtype=torch.float64) for each in (1.0, OPEN, GAUSSIAN))
    nothing = torch.zeros(size, 0, dtype=torch.float64)
    found = GatedStep()(scene.measurement, scene.noise, offset, factor @ factor.mT, moved, *numbers, nothing, *frame)
    return dict(zip(GATED_OUTPUTS, found, strict=True))


def adjoint(T: Tensor) -> Tensor:
    """(6, 6): T Exp(x) = Exp(adjoint x) T, from its definition."""
    basis = torch.eye(6, dtype=torch.float64)
    moved = T @ hat(basis) @ torch.linalg.inv(T)
    return torch.stack([moved[:, 0, 3], moved[:, 1, 3], moved[:, 2, 3], moved[:, 2, 1], moved[:, 0, 2], moved[:, 1, 0]])


def by_library(scene: SmallScene, points: Symmetric) -> Gaussian:
    """The posterior of (T_frame_keyframe, calibration, landmarks)."""
    prior = torch.block_diag(scene.root @ scene.root.mT, torch.diag(scene.calibration**2), *scene.landmark_covariance)
    belief = Gaussian(torch.zeros(len(prior), dtype=torch.float64), prior)
    measurement = MeasurementModel(lambda x: view(x, scene.T_world_frame, scene.landmarks), BlockDiagonal(scene.noise))
    ukf = UnscentedKalmanFilter(points=points, iterations=1)
    return ukf.update(belief, measurement, scene.measurement.flatten()).belief


def assert_same(found: dict[str, Tensor], expected: Gaussian, scene: SmallScene) -> None:
    by_frame = torch.eye(9, dtype=torch.float64)
    by_frame[:6, :6] = -adjoint(scene.T_world_frame)
    state = [*range(POSE.start, POSE.stop), 0, 1, 2]
    torch.testing.assert_close(found["offset_after"][state], by_frame @ expected.mean[:9], rtol=0, atol=1e-12)
    covariance = by_frame @ expected.covariance[:9, :9] @ by_frame.mT
    torch.testing.assert_close(found["spread_after"][state][:, state], covariance, rtol=0, atol=1e-12)
    landmarks = expected.mean[9:].unflatten(0, (-1, 4))
    torch.testing.assert_close(found["moved_after"][:, :MODELLED], landmarks, rtol=0, atol=1e-12)


@pytest.fixture(autouse=True)
def points_of_the_prior_itself(monkeypatch: pytest.MonkeyPatch):
    """Not of a prior with 1e-6 more deviation, which keeps it regular where something is known; it costs 1e-11."""
    monkeypatch.setattr(stereo_views, "LEAST_SPREAD", 0.0)


def test_with_one_landmark_it_is_the_cubature_filter():
    scene = scene_of(1)
    assert_same(by_tracker(scene), by_library(scene, cubature()), scene)


@pytest.mark.parametrize("count", [2, 5])
def test_with_more_it_is_the_filter_whose_views_are_apart(count: int):
    scene = scene_of(count)
    points = ViewsApart(kappa=SIZE - (9.0 + 4.0 * count), allow_negative=True)
    assert_same(by_tracker(scene), by_library(scene, points), scene)
