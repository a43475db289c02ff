from __future__ import annotations

import cv2
import numpy as np
import pytest
import torch

from sigmaslam.geometry.camera import RectifiedStereo
from sigmaslam.geometry.se3 import se3_exp, se3_inverse
from sigmaslam.reconstruction import depth_fusion
from sigmaslam.reconstruction.depth_fusion import DepthView, FusedDepth, fuse_depth, kalman_update
from sigmaslam.reconstruction.disparity import DisparityMap
from sigmaslam_filters import Gaussian, KalmanFilter, LinearMeasurement

CAMERA = RectifiedStereo(200.0, 200.0, 99.5, 59.5, 0.2, 200, 120)
# A step to the side and ahead, and a small turn.
STEP = se3_exp(np.array([0.05, 0.02, 0.3, 0.01, -0.02, 0.005]))
NOISE = 0.04


def plane(T_world_camera: np.ndarray, distance: float = 4.0) -> tuple[np.ndarray, np.ndarray]:
    """Image and disparities of a textured wall z = distance + 0.3 x in the world, exact."""
    v, u = np.mgrid[: CAMERA.height, : CAMERA.width].astype(float)
    rays = CAMERA.rays(np.stack([u, v], axis=-1)) @ T_world_camera[:3, :3].T
    centre, normal = T_world_camera[:3, 3], np.array([-0.3, 0.0, 1.0])
    depth = (distance - normal @ centre) / (rays @ normal)
    points = centre + depth[..., None] * rays
    x, y = points[..., 0], points[..., 1]
    image = 128 + 50 * np.sin(9 * x + 2) * np.cos(7 * y) + 40 * np.sin(23 * x + 11 * y)
    return image.clip(0, 255).astype(np.uint8), (CAMERA.focal_baseline / depth).astype(np.float32)


def measure(disparity: np.ndarray, seed: int) -> DisparityMap:
    noisy = disparity + np.sqrt(NOISE) * np.random.default_rng(seed).standard_normal(disparity.shape)
    return DisparityMap(noisy.astype(np.float32), np.full(disparity.shape, NOISE, np.float32))


def fuse(distance_later: float = 4.0, covariance: float = 1e-12) -> tuple[FusedDepth, np.ndarray]:
    image, true = plane(np.eye(4))
    poses = [STEP, se3_inverse(STEP)]
    others = []
    for k, pose in enumerate(poses):
        seen, disparity = plane(pose, distance_later)
        others.append((DepthView.of(seen, measure(disparity, k + 1)), se3_inverse(pose), covariance * np.eye(6)))
    return fuse_depth(image, measure(true, 0), others, CAMERA, shared=0.0), true


def test_the_update_is_that_of_the_filter_library():
    rng = np.random.default_rng(0)
    mean, innovation, derivative = rng.standard_normal((3, 50))
    variance, noise = rng.uniform(0.1, 2.0, (2, 50))
    agrees = rng.random(50) < 0.7
    found, spread = kalman_update(mean, variance, innovation, derivative, noise, agrees)
    belief = Gaussian(torch.from_numpy(mean[:, None]), torch.from_numpy(variance[:, None, None]))
    model = LinearMeasurement(torch.from_numpy(derivative[:, None, None]), torch.from_numpy(noise[:, None, None]))
    value = torch.from_numpy((derivative * mean + innovation)[:, None])
    posterior = KalmanFilter().update(belief, model, value).belief
    expected = np.where(agrees, posterior.mean.numpy()[:, 0], mean)
    np.testing.assert_allclose(found, expected, rtol=1e-10)
    np.testing.assert_allclose(spread, np.where(agrees, posterior.covariance.numpy()[:, 0, 0], variance), rtol=1e-10)


def test_fused_depths_are_better_than_those_of_a_view_and_know_it():
    fused, true = fuse()
    chosen = fused.is_confirmed & (fused.support == 2)
    assert chosen.mean() > 0.6
    error = (fused.disparity - true)[chosen]
    assert error.std() < 0.72 * np.sqrt(NOISE)
    assert abs(error.mean()) < 0.02
    inside = np.abs(error) < 1.96 * np.sqrt(fused.variance[chosen])
    # The gate leaves out the largest differences.
    assert 0.93 < inside.mean() < 0.985


def test_an_uncertain_pose_leaves_the_depth_of_the_view():
    fused, _ = fuse(covariance=1.0)
    seen = np.isfinite(fused.variance) & (fused.support > 0)
    assert np.median(fused.variance[seen]) > 0.6 * NOISE


def fuse_beside(left: float, right: float, nearer: float, others: list[float]) -> FusedDepth:
    """Of a view so much nearer (metres) that adds to the halves of its disparities, and exact ones likewise."""
    image, true = plane(np.eye(4))
    views = []
    for k, forward in enumerate([nearer, *others]):
        pose = np.eye(4)
        pose[2, 3] = forward
        seen, disparity = plane(pose)
        if k == 0:
            disparity[:, : CAMERA.width // 2] += left
            disparity[:, CAMERA.width // 2 :] += right
        views.append((DepthView.of(seen, measure(disparity, k + 1)), se3_inverse(pose), 1e-12 * np.eye(6)))
    return fuse_depth(image, measure(true, 0), views, CAMERA, shared=0.0)


@pytest.mark.parametrize(
    ("nearer", "others"), [(-0.1, [-0.2]), (0.1, [-0.1, -0.2, -0.3])], ids=["of two views", "the nearer one"]
)
def test_views_that_see_the_place_confirm_it_and_one_that_does_not_is_not_asked(nearer: float, others: list[float]):
    """In the right half something stands before it, which is no contradiction; in the left nothing is measured."""
    fused = fuse_beside(np.nan, 3.0, nearer, others)
    middle = CAMERA.width // 2
    assert (fused.contradictions[8:-8, 8:-8] == 0).mean() > 0.9
    assert fused.is_confirmed[10:-10, 10 : middle - 10].mean() > 0.85
    assert fused.is_confirmed[10:-10, middle + 10 : -10].mean() < 0.05


def test_what_has_moved_is_not_confirmed():
    fused, _ = fuse(distance_later=6.0)
    assert np.isfinite(fused.disparity).any()
    assert fused.is_confirmed.mean() < 0.02
    assert (fused.contradictions > 0).mean() > 0.6


def test_what_moves_along_its_own_surface_is_not_confirmed():
    image, true = plane(np.eye(4))
    rng = np.random.default_rng(4)
    noisy = (image + 3.0 * rng.standard_normal(image.shape)).clip(0, 255).astype(np.uint8)
    # Most of the view is at rest; the depths are everywhere as expected.
    moved = np.where(np.arange(CAMERA.width) < 130, noisy, np.roll(noisy, 5, axis=1))
    view = DepthView.of(moved, measure(true, 1))
    fused = fuse_depth(image, measure(true, 0), [(view, np.eye(4), 1e-12 * np.eye(6))], CAMERA)
    assert fused.is_confirmed[5:-5, 5:120].mean() > 0.9
    assert fused.is_confirmed[5:-5, 140:-10].mean() < 0.2
    assert (fused.contradictions[5:-5, 140:-10] == 1).mean() > 0.7


def test_a_smooth_texture_that_moves_by_pixels_is_not_confirmed():
    _, true = plane(np.eye(4))
    rng = np.random.default_rng(7)
    smooth = 128 + 900 * cv2.GaussianBlur(rng.standard_normal(true.shape), None, 8.0)
    image, other = (np.clip(smooth + rng.standard_normal(true.shape), 0, 255).astype(np.uint8) for _ in range(2))
    # Three pixels, little beside the ten over which the grey value changes.
    moved = np.where(np.arange(CAMERA.width) < 130, other, np.roll(other, 3, axis=1))
    view = DepthView.of(moved, measure(true, 1))
    fused = fuse_depth(image, measure(true, 0), [(view, np.eye(4), 1e-12 * np.eye(6))], CAMERA)
    assert fused.is_confirmed[5:-5, 5:110].mean() > 0.9
    assert fused.is_confirmed[8:-8, 145:-15].mean() < 0.1


def test_a_pose_that_most_of_the_image_denies_confirms_nothing():
    image, true = plane(np.eye(4))
    moved = np.where(np.arange(CAMERA.width) < 60, image, np.roll(image, 5, axis=1))
    view = DepthView.of(moved, measure(true, 1))
    fused = fuse_depth(image, measure(true, 0), [(view, np.eye(4), 1e-12 * np.eye(6))], CAMERA)
    assert not fused.is_confirmed.any()


def test_a_keyframe_without_disparities_has_no_points():
    image, true = plane(np.eye(4))
    nothing = DisparityMap(np.full_like(true, np.nan), np.full_like(true, np.nan))
    view = DepthView.of(image, measure(true, 1))
    fused = fuse_depth(image, nothing, [(view, np.eye(4), 1e-6 * np.eye(6))], CAMERA)
    assert np.isnan(fused.disparity).all()
    assert not fused.is_confirmed.any()


def test_compiled_fusion_is_that_of_numpy(monkeypatch: pytest.MonkeyPatch):
    pytest.importorskip("sigmaslam.reconstruction._depths", reason="installed without a compiler")
    compiled, _ = fuse(covariance=1e-6)
    monkeypatch.setattr(depth_fusion, "kernels", None)
    numpy, _ = fuse(covariance=1e-6)
    # The flow between the views may take another way where a grey value is rounded otherwise.
    same = (compiled.support == numpy.support) & (compiled.contradictions == numpy.contradictions)
    assert same.mean() > 0.995
    np.testing.assert_allclose(compiled.disparity[same], numpy.disparity[same], rtol=1e-5)
    np.testing.assert_allclose(compiled.variance[same], numpy.variance[same], rtol=1e-3)


def test_compiled_views_are_those_of_numpy(monkeypatch: pytest.MonkeyPatch):
    pytest.importorskip("sigmaslam.reconstruction._depths", reason="installed without a compiler")
    rng = np.random.default_rng(3)
    v, u = np.mgrid[:41, :57].astype(np.float32)
    disparity = 30.0 + 0.3 * u - 0.2 * v + rng.normal(0, 0.1, u.shape).astype(np.float32)
    disparity[rng.random(u.shape) < 0.3] = np.nan
    measured = DisparityMap(disparity, rng.random(u.shape).astype(np.float32))
    compiled = DepthView.of(np.zeros(u.shape, np.uint8), measured).sampled
    monkeypatch.setattr(depth_fusion, "kernels", None)
    numpy = DepthView.of(np.zeros(u.shape, np.uint8), measured).sampled
    np.testing.assert_allclose(compiled, numpy, atol=1e-4)
    np.testing.assert_allclose(np.median(compiled[..., 2:][np.isfinite(disparity)], axis=0), [0.3, -0.2], atol=0.02)


def test_compiled_functions_refuse_what_they_would_read_beyond():
    kernels = pytest.importorskip("sigmaslam.reconstruction._depths", reason="installed without a compiler")
    image, one = np.zeros((9, 9), np.float32), np.zeros(1)
    with pytest.raises(ValueError, match="a view must be"):
        kernels.measure(image[:8, :, None], image, [1.0] * 6, [0.0] * 12, np.zeros(60), np.zeros((3, 1)), one, one)
    with pytest.raises(ValueError, match="a pixel is in no image"):
        kernels.compare(image.astype(np.uint8), [3, 81], [1.0, 1.0])
    with pytest.raises(ValueError, match="images have one size"):
        kernels.gauss_newton(image, image, image, image[:8], [1.0] * 5)


@pytest.mark.parametrize("is_compiled", [True, False])
def test_the_derivative_and_the_pose_s_part_are_those_of_differences(
    is_compiled: bool, monkeypatch: pytest.MonkeyPatch
):
    if not is_compiled:
        monkeypatch.setattr(depth_fusion, "kernels", None)
    _, true = plane(np.eye(4))
    seen, disparity = plane(STEP)
    exact = DisparityMap(disparity, np.full_like(disparity, NOISE))
    view, pose = DepthView.of(seen, exact), se3_inverse(STEP)
    v, u = np.mgrid[30:90:10, 40:160:10].reshape(2, -1)
    rays = CAMERA.rays(np.stack([u, v], axis=-1).astype(float)).T.astype(np.float32)
    state = true[v, u]
    variance = np.full_like(state, NOISE)
    root = np.random.default_rng(5).standard_normal((6, 6)) * 1e-3
    covariance = root @ root.T

    def innovation(state: np.ndarray, pose: np.ndarray) -> np.ndarray:
        return depth_fusion._measure(view, pose, products, rays, state, variance, CAMERA)[1].astype(float)

    products = depth_fusion.step_products(covariance)
    found = depth_fusion._measure(view, pose, products, rays, state, variance, CAMERA)
    step = np.float32(0.2)
    slope = (innovation(state + step, pose) - innovation(state - step, pose)) / (2 * step)
    np.testing.assert_allclose(found[2], -slope, atol=0.02)
    moved = np.stack([innovation(state, se3_exp(20 * column) @ pose) for column in root.T])
    back = np.stack([innovation(state, se3_exp(-20 * column) @ pose) for column in root.T])
    np.testing.assert_allclose(found[4], (((moved - back) / 40) ** 2).sum(axis=0), rtol=0.1, atol=1e-6)
