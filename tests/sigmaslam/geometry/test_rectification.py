from pathlib import Path

import cv2
import numpy as np
import pytest

from sigmaslam.calibration_files.kitti_calibration import read_kitti_calibration
from sigmaslam.errors import CalibrationError, FrameError
from sigmaslam.geometry.camera import CameraModel, StereoCamera
from sigmaslam.geometry.rectification import StereoRectifier
from sigmaslam.readers import open_sequence

RADTAN = (-0.28, 0.07, 2e-4, 2e-5)


def pair(left, right, rotation=(0.0, 0.0, 0.0), translation=(0.11, 0.0, 0.0)):
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = cv2.Rodrigues(np.array(rotation, dtype=float))[0], translation
    return StereoCamera(left, right, T)


def features(image):
    return cv2.SIFT_create(1000).detectAndCompute(image, None)


def matches(left, right):
    """Matches of SIFT features: (M, 2) pixels in each image."""
    (k0, d0), (k1, d1) = left, right
    found = cv2.BFMatcher(cv2.NORM_L2).knnMatch(d0, d1, k=2)
    good = [a for a, b in found if a.distance < 0.7 * b.distance]
    return np.array([k0[m.queryIdx].pt for m in good]), np.array([k1[m.trainIdx].pt for m in good])


def row_offset(left, right):
    """Median |v_left - v_right| of matches with positive disparity, px."""
    p0, p1 = matches(left, right)
    disparity = p0[:, 0] - p1[:, 0]
    kept = (disparity > 0) & (disparity < 200)
    assert kept.sum() > 50
    return np.median(np.abs(p0[kept, 1] - p1[kept, 1]))


PLAIN = CameraModel(752, 480, 458.7, 457.3, 367.2, 248.4)
SMALL = CameraModel(640, 400, 400.0, 401.0, 320.0, 200.0)
BENT = CameraModel(752, 480, 458.7, 457.3, 367.2, 248.4, 0.0, "radtan", RADTAN)
BENT_RIGHT = CameraModel(752, 480, 457.6, 456.1, 380.0, 255.2, 0.0, "radtan", RADTAN)
SKEWED = CameraModel(752, 480, 458.7, 457.3, 367.2, 248.4, 4.0, "radtan", RADTAN)
FISHEYE = CameraModel(640, 480, 230.0, 230.0, 320.0, 240.0, 0.0, "equidistant", (-0.01, 0.02, -0.01, 0.003))

UNLIKE = [(BENT, BENT_RIGHT), (SKEWED, SMALL), (FISHEYE, PLAIN), (FISHEYE, FISHEYE)]


@pytest.mark.parametrize(("left", "right"), UNLIKE)
def test_rectified_geometry_projects_to_the_same_source_pixels(left, right):
    camera = pair(left, right, rotation=(0.02, -0.03, 0.01), translation=(0.11, 0.004, -0.006))
    rectifier = StereoRectifier(camera)
    stereo = rectifier.rectified
    rng = np.random.default_rng(0)
    uvd = np.c_[rng.uniform(0, stereo.width - 1, 300), rng.uniform(0, stereo.height - 1, 300), rng.uniform(2, 40, 300)]
    points = stereo.triangulate(uvd)
    in_left = points @ rectifier.R_rectified_left
    in_right = (in_left - camera.T_left_right[:3, 3]) @ camera.T_left_right[:3, :3]
    again = in_right @ rectifier.R_rectified_right.T
    np.testing.assert_allclose(again, points - [stereo.baseline, 0, 0], atol=1e-9)
    # The maps say the same, at whole pixels.
    u, v = uvd[:, 0].astype(int), uvd[:, 1].astype(int)
    rays = np.c_[(u - stereo.cx) / stereo.fx, (v - stereo.cy) / stereo.fy, np.ones(300)]
    for model, R, maps in zip(
        (left, right), (rectifier.R_rectified_left, rectifier.R_rectified_right), rectifier._maps, strict=True
    ):
        np.testing.assert_allclose(np.c_[maps[0][v, u], maps[1][v, u]], model.project(rays @ R), atol=1e-3)
        # As alpha = 0: every rectified pixel has a source.
        assert maps[0].min() > -0.5
        assert maps[0].max() < model.width - 0.5
        assert maps[1].min() > -0.5
        assert maps[1].max() < model.height - 0.5


def test_rotations_and_view_are_those_of_opencv():
    left, right = UNLIKE[0]
    camera = pair(left, right, rotation=(0.02, -0.03, 0.01), translation=(0.11, 0.004, -0.006))
    rectifier = StereoRectifier(camera)
    T_right_left = np.linalg.inv(camera.T_left_right)
    R1, R2, P1, P2, *_ = cv2.stereoRectify(
        left.matrix, np.array(left.distortion), right.matrix, np.array(right.distortion), (752, 480),
        T_right_left[:3, :3], T_right_left[:3, 3:], flags=cv2.CALIB_ZERO_DISPARITY, alpha=0,
    )  # fmt: skip
    np.testing.assert_allclose(rectifier.R_rectified_left, R1, atol=1e-9)
    np.testing.assert_allclose(rectifier.R_rectified_right, R2, atol=1e-9)
    assert rectifier.rectified.baseline == pytest.approx(-P2[0, 3] / P2[0, 0], rel=1e-9)
    # OpenCV zooms about a fixed principal point, so it never shows more.
    assert 0.85 * P1[0, 0] < rectifier.rectified.fx <= 1.01 * P1[0, 0]


def test_rectified_camera_passes_through():
    eye = CameraModel(64, 48, 50.0, 51.0, 32.0, 24.0)
    rectifier = StereoRectifier(pair(eye, eye))
    left, right = np.zeros((48, 64), np.uint8), np.ones((48, 64), np.uint8)
    out = rectifier.rectify(left, right)
    assert out[0] is left
    assert out[1] is right
    assert rectifier.valid_mask is None
    np.testing.assert_array_equal(rectifier.R_rectified_left, np.eye(3))
    np.testing.assert_array_equal(rectifier.rectified.matrix, eye.matrix)


def test_wrong_image_size_names_both_sizes():
    eye = CameraModel(64, 48, 50.0, 51.0, 32.0, 24.0)
    rectifier = StereoRectifier(pair(eye, eye))
    with pytest.raises(FrameError, match="right image is 48x64, its calibration is for 64x48"):
        rectifier.rectify(np.zeros((48, 64), np.uint8), np.zeros((64, 48), np.uint8))


def test_eyes_that_look_apart_are_refused():
    eye = CameraModel(64, 48, 80.0, 80.0, 32.0, 24.0)
    with pytest.raises(CalibrationError, match="share no rectangle"):
        StereoRectifier(pair(eye, eye, rotation=(0, 1.0, 0)))


def test_valid_mask_leaves_out_the_border():
    rectifier = StereoRectifier(pair(*UNLIKE[0]))
    assert rectifier.valid_mask.shape == (480, 752)
    assert set(np.unique(rectifier.valid_mask)) == {0, 255}
    assert rectifier.valid_mask.mean() > 0.9 * 255


def test_euroc_rows_align(real_data: Path):
    sequence = open_sequence(real_data / "euroc_v1_01_static")
    rectifier = StereoRectifier(sequence.camera)
    frame = next(sequence.frames())
    assert rectifier.rectified.baseline == pytest.approx(0.11008, abs=1e-5)
    assert row_offset(*map(features, rectifier.rectify(frame.left, frame.right))) < 0.25
    assert rectifier.valid_mask.mean() > 0.9 * 255


@pytest.mark.long
def test_kitti_raw_agrees_with_the_published_rectification(real_data: Path):
    folder = real_data / "kitti_raw_0926_0039_a"
    camera = read_kitti_calibration(folder / "calib_cam_to_cam.txt", (1392, 512), (0, 1))
    rectifier = StereoRectifier(camera)
    assert rectifier.rectified.baseline == pytest.approx(0.53715, abs=5e-4)
    sequence = open_sequence(folder / "raw_unrectified", calibration=folder / "calib_cam_to_cam.txt")
    reference = open_sequence(folder).camera.left
    R_kitti_left = np.array(
        [[9.999239e-01, 9.837760e-03, -7.445048e-03], [-9.869795e-03, 9.999421e-01, -4.278459e-03],
         [7.402527e-03, 4.351614e-03, 9.999631e-01]]
    )  # fmt: skip
    for frame, number in zip(sequence.frames(), (60, 61, 62), strict=True):
        left, right = map(features, rectifier.rectify(frame.left, frame.right))
        # The rows cannot align better than the published calibration lets them (0.43 px at its focal length).
        scale = reference.fx / rectifier.rectified.fx
        paths = [folder / eye / f"{number:010d}.png" for eye in ("image_0", "image_1")]
        published = [features(cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)) for path in paths]
        offset = row_offset(left, right) * scale
        assert offset < 0.5
        assert offset < row_offset(*published) + 0.02
        # A pixel of our left image, turned into KITTI's rectified camera, shows the same thing.
        ours, theirs = matches(left, published[0])
        stereo = rectifier.rectified
        rays = np.c_[(ours - [stereo.cx, stereo.cy]) / [stereo.fx, stereo.fy], np.ones(len(ours))]
        predicted = reference.project(rays @ rectifier.R_rectified_left @ R_kitti_left.T)
        assert len(ours) > 100
        assert np.median(np.linalg.norm(predicted - theirs, axis=1)) < 0.25
