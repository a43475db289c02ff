"""Calibrations from simulated corners, whose cameras are known."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from sigmaslam.calibration.board_bundle import Corners, Rig, project_corners, solve_bundle
from sigmaslam.calibration.boards import DetectedCorners
from sigmaslam.calibration.calibrate import BoardCalibration, calibrate, rig_covariance
from sigmaslam.errors import CalibrationError
from sigmaslam.geometry.camera import CameraModel
from sigmaslam.geometry.se3 import se3_exp, se3_inverse, se3_log
from tests.support.simulated_board import CHESSBOARD, FISHEYE, RADTAN, board_poses, seen_corners, stereo_rig, views_of

SIZE = (640, 480)


def parameters(rig: Rig) -> np.ndarray:
    """(P,) intrinsics and lenses, and T_left_right as it is."""
    values = [value for eye in rig.eyes for value in (eye.fx, eye.fy, eye.cx, eye.cy, *eye.distortion)]
    return np.array(values)


def rig_error(found: Rig, true: Rig) -> np.ndarray:
    """(P,) found minus true, in the order of `Rig.names`."""
    difference = parameters(found) - parameters(true)
    if len(true.eyes) == 1:
        return difference
    return np.r_[difference, se3_log(found.T_left_right @ se3_inverse(true.T_left_right))]


def run(rig: Rig, corners: Corners, lens: str) -> BoardCalibration:
    views = views_of(rig, CHESSBOARD, corners)
    names = [f"image{k}" for k in range(len(views))]
    return calibrate(names, views, CHESSBOARD.points, [SIZE] * len(rig.eyes), lens)


@pytest.mark.long
@pytest.mark.parametrize(
    ("eye", "lens", "depth"), [(RADTAN, "radtan5", 0.45), (FISHEYE, "equidistant", 0.3)], ids=["radtan", "fisheye"]
)
@pytest.mark.parametrize("eyes", [1, 2])
def test_exact_corners_give_the_cameras_exactly(eye: CameraModel, lens: str, depth: float, eyes: int):
    rig = stereo_rig(eye) if eyes == 2 else Rig((eye,), np.eye(4))
    poses = board_poses(CHESSBOARD, 12, seed=1, depth=depth)
    result = run(rig, seen_corners(rig, CHESSBOARD, poses), lens)
    assert not result.outlier_images
    assert len(result.outlier_corners) == 0
    assert result.rms < 1e-6
    np.testing.assert_allclose(parameters(result.rig), parameters(rig), rtol=1e-5, atol=1e-5)
    np.testing.assert_allclose(result.rig.T_left_right, rig.T_left_right, atol=1e-7)
    grid = np.stack(np.meshgrid(np.arange(0.0, 640.0, 9.0), np.arange(0.0, 480.0, 9.0)), axis=-1)
    for camera in result.rig.eyes:
        np.testing.assert_allclose(camera.project(camera.unproject(grid)), grid, atol=1e-6)


def test_information_is_that_of_the_dense_problem():
    """Against the Jacobian of all residuals by all parameters and poses, by finite differences."""
    rig = stereo_rig()
    poses = board_poses(CHESSBOARD, 4, seed=2)
    corners = seen_corners(rig, CHESSBOARD, poses)
    bundle = solve_bundle(rig, poses, corners)
    rig, poses = bundle.rig, bundle.poses
    total = len(rig.names) + 6 * len(poses)

    def projected(step: np.ndarray) -> np.ndarray:
        moved = se3_exp(step[len(rig.names) :].reshape(-1, 6)) @ poses
        return project_corners(rig.moved(step[: len(rig.names)]), moved, corners).ravel()

    size = 1e-5
    steps = size * np.eye(total)
    jacobian = np.stack([(projected(step) - projected(-step)) / (2.0 * size) for step in steps], axis=1)
    dense = np.linalg.inv(jacobian.T @ jacobian)[: len(rig.names), : len(rig.names)]
    schur = np.linalg.inv(bundle.information.sum(axis=0))
    scale = np.sqrt(np.outer(np.diag(dense), np.diag(dense)))
    np.testing.assert_allclose(schur / scale, dense / scale, atol=1e-3)


def simulated_nees(common: float, runs: int, images: int = 20) -> tuple[np.ndarray, list[float]]:
    """(runs,) squared errors of the rig by their variances, on average over parameters, and design effects."""
    rig = stereo_rig()
    squares, effects = [], []
    for seed in range(runs):
        rng = np.random.default_rng(seed)
        poses = board_poses(CHESSBOARD, images, seed=100 + seed)
        corners = seen_corners(rig, CHESSBOARD, poses)
        # The paper is stretched differently in each image, alike for both eyes.
        stretch = np.eye(2) + common * rng.standard_normal((images, 2, 2))
        centred = corners.points[:, :2] - CHESSBOARD.points.mean(axis=0)[:2]
        drawn = corners.points.copy()
        drawn[:, :2] += np.einsum("nij,nj->ni", stretch[corners.image] - np.eye(2), centred)
        pixels = project_corners(rig, poses, replace(corners, points=drawn))
        seen = replace(corners, pixels=pixels + 0.1 * rng.standard_normal(pixels.shape))
        bundle = solve_bundle(rig, poses, seen)
        covariance, _, effect = rig_covariance(bundle)
        squares.append(np.mean(rig_error(bundle.rig, rig) ** 2 / np.diag(covariance)))
        effects.append(effect)
    return np.array(squares), effects


@pytest.mark.long
@pytest.mark.parametrize("common", [0.0, 1e-3], ids=["independent", "stretched boards"])
def test_errors_are_as_large_as_the_covariance_says(common: float):
    squares, effects = simulated_nees(common, 12)
    assert 0.4 < squares.mean() < 1.6
    if common:
        assert min(effects) > 2.0
    else:
        assert np.median(effects) < 1.3


@pytest.mark.long
def test_a_misread_image_is_named_and_does_not_count():
    rig = stereo_rig()
    corners = seen_corners(rig, CHESSBOARD, board_poses(CHESSBOARD, 12, seed=5))
    rng = np.random.default_rng(0)
    noisy = corners.pixels + 0.1 * rng.standard_normal(corners.pixels.shape)
    clean = run(rig, replace(corners, pixels=noisy), "radtan5")
    mine = (corners.image == 3) & (corners.eye == 1)
    broken = noisy.copy()
    broken[mine] += rng.uniform(-8.0, 8.0, (np.count_nonzero(mine), 2))
    result = run(rig, replace(corners, pixels=broken), "radtan5")
    assert [each.name for each in result.outlier_images] == ["image3"]
    assert "a quarter of its corners are" in result.outlier_images[0].reason
    assert {*result.names, "image3"} == set(clean.names)
    np.testing.assert_array_less(np.abs(rig_error(result.rig, clean.rig)), 2.0 * clean.sigmas)


def test_single_wrong_corners_are_left_out():
    rig = stereo_rig()
    corners = seen_corners(rig, CHESSBOARD, board_poses(CHESSBOARD, 10, seed=6))
    pixels = corners.pixels + 0.1 * np.random.default_rng(1).standard_normal(corners.pixels.shape)
    inside = np.flatnonzero(np.all((pixels > 9.0) & (pixels < (630.0, 470.0)), axis=1))
    wrong = inside[[7, 200, 401]]
    pixels[wrong] += 2.0
    result = run(rig, replace(corners, pixels=pixels), "radtan5")
    assert not result.outlier_images
    kept = {tuple(each) for each in result.outlier_corners.pixels.tolist()}
    assert {tuple(each) for each in pixels[wrong].tolist()} <= kept
    assert len(kept) <= 4
    assert np.all(np.linalg.norm(result.outlier_residuals, axis=1) > 0.4)


@pytest.mark.long
def test_a_pair_with_three_wrong_corners_stays():
    """AprilTags near the border: one or two of eight pairs were left out whole."""
    rig = stereo_rig()
    corners = seen_corners(rig, CHESSBOARD, board_poses(CHESSBOARD, 10, seed=6))
    pixels = corners.pixels + 0.1 * np.random.default_rng(1).standard_normal(corners.pixels.shape)
    wrong = np.flatnonzero(corners.image == 4)[[3, 30, 60]]
    pixels[wrong] += 3.0
    result = run(rig, replace(corners, pixels=pixels), "radtan5")
    assert not result.outlier_images
    kept = {tuple(each) for each in result.outlier_corners.pixels.tolist()}
    assert {tuple(each) for each in pixels[wrong].tolist()} <= kept


@pytest.mark.long
def test_a_board_in_one_eye_alone_counts():
    rig = stereo_rig()
    corners = seen_corners(rig, CHESSBOARD, board_poses(CHESSBOARD, 8, seed=7))
    corners = corners.select(
        ~((corners.image == 2) & (corners.eye == 1)) & ~((corners.image == 5) & (corners.eye == 0))
    )
    result = run(rig, corners, "radtan5")
    assert len(result.names) == 8
    np.testing.assert_allclose(result.rig.T_left_right, rig.T_left_right, atol=1e-6)


@pytest.mark.long
def test_a_chessboard_may_be_counted_from_either_end():
    rig = stereo_rig()
    views = views_of(rig, CHESSBOARD, seen_corners(rig, CHESSBOARD, board_poses(CHESSBOARD, 8, seed=8)))
    whole = [view for view in views if len(view[0]) == len(view[1]) == len(CHESSBOARD.points)]
    assert len(whole) >= 3
    turned = [(left, replace(right, pixels=right.pixels[::-1])) for left, right in whole]
    names = [str(k) for k in range(len(whole))]
    result = calibrate(names, turned, CHESSBOARD.points, [SIZE] * 2, "radtan5")
    assert result.rms < 1e-6
    assert not result.outlier_images


@pytest.mark.long
def test_images_without_a_board_are_named():
    rig = stereo_rig()
    views = views_of(rig, CHESSBOARD, seen_corners(rig, CHESSBOARD, board_poses(CHESSBOARD, 6, seed=9)))
    nothing = DetectedCorners(np.zeros(0, np.int64), np.zeros((0, 2)))
    result = calibrate(list("abcdefg"), [*views, (nothing, nothing)], CHESSBOARD.points, [SIZE] * 2, "radtan5")
    assert [(each.name, each.reason) for each in result.outlier_images] == [("g", "the board is not found")]


def test_too_few_images_say_so():
    rig = stereo_rig()
    views = views_of(rig, CHESSBOARD, seen_corners(rig, CHESSBOARD, board_poses(CHESSBOARD, 2, seed=3)))
    with pytest.raises(CalibrationError, match="2 images show the board to one camera: take 3 or more"):
        calibrate(list("ab"), views, CHESSBOARD.points, [SIZE] * 2, "radtan4")
    nothing = DetectedCorners(np.zeros(0, np.int64), np.zeros((0, 2)))
    with pytest.raises(CalibrationError, match=r"board is found in none of 1 images: check --board .*inner corners"):
        calibrate(["a"], [(nothing,)], CHESSBOARD.points, [SIZE], "radtan4")


def test_boards_that_are_not_tilted_leave_the_focal_length_open():
    """Nearer and longer look the same: the sigma says so, or the images are refused."""
    rig = Rig((replace(RADTAN, distortion_model="none", distortion=()),), np.eye(4))
    rng = np.random.default_rng(0)
    poses = np.tile(np.eye(4), (8, 1, 1))
    poses[:, :3, 3] = np.column_stack([rng.uniform((-0.2, -0.15), (0.0, 0.05), (8, 2)), rng.uniform(0.4, 0.6, 8)])
    corners = seen_corners(rig, CHESSBOARD, poses)
    noisy = replace(corners, pixels=corners.pixels + 0.1 * rng.standard_normal(corners.pixels.shape))
    tilted = seen_corners(rig, CHESSBOARD, board_poses(CHESSBOARD, 8, seed=1))
    known = run(rig, replace(tilted, pixels=tilted.pixels + 0.1 * rng.standard_normal(tilted.pixels.shape)), "none")
    try:
        result = run(rig, noisy, "none")
    except CalibrationError:
        return
    assert result.sigmas[0] > 20.0 * known.sigmas[0]
