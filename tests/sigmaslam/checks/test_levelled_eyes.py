"""A right camera that is turned, moved or enlarged is found again from where matches are in the images."""

from dataclasses import replace

import cv2
import numpy as np
import pytest

from sigmaslam.checks import check_pairs, check_sequence
from sigmaslam.checks.eye_matches import EyeMatches
from sigmaslam.checks.finding import wrong
from sigmaslam.checks.levelled_eyes import level_eyes
from sigmaslam.checks.rig import check_rig
from sigmaslam.errors import InputError
from sigmaslam.geometry.calibration_covariance import CalibrationCovariance
from sigmaslam.geometry.calibration_sigmas import CalibrationSigmas
from sigmaslam.geometry.camera import CameraModel, StereoCamera
from sigmaslam.geometry.rectification import StereoRectifier
from sigmaslam.geometry.se3 import rigid_motion
from sigmaslam.readers import open_sequence
from sigmaslam.readers.selection import Selection
from sigmaslam.slam.tracker import StereoTracker
from tests.support.estimates import Demo
from tests.support.injected_faults import FAULTS, sequence_of

LENS = (-0.28, 0.07, 0.0002, 0.00002)
NOISE = 0.1


def rig(distortion: tuple[float, ...] = (), turn: tuple[float, float, float] = (0.0, 0.0, 0.0)) -> StereoCamera:
    """Cameras of 640 x 480 pixels, 0.1 m apart; the right one is turned by degrees about its axes."""
    kind = "radtan" if distortion else "none"
    model = CameraModel(640, 480, 500.0, 500.0, 319.5, 239.5, distortion_model=kind, distortion=distortion)
    return StereoCamera(model, model, rigid_motion(cv2.Rodrigues(np.radians(turn))[0], [0.1, 0.0, 0.0]))


def matches_of(true: StereoCamera, given: StereoCamera, outliers: float = 0.1) -> EyeMatches:
    """Of points 1 to 20 m away, seen by one rig and rectified by the calibration of another."""
    rng, rectifier = np.random.default_rng(0), StereoRectifier(given)
    points = rng.uniform((-0.5, -0.4, 1.0), (0.5, 0.4, 1.0), (600, 3)) / rng.uniform(0.05, 1.0, (600, 1))
    of_right = (points - true.T_left_right[:3, 3]) @ true.T_left_right[:3, :3]
    seen = [true.left.project(points), true.right.project(of_right)]
    seen[1] += rng.normal(scale=NOISE, size=seen[1].shape)
    seen[1][rng.random(600) < outliers] += rng.uniform(-80.0, 80.0, 2)
    turns = rectifier.R_rectified_left, rectifier.R_rectified_right
    models = given.left, given.right
    places = [
        rectifier.rectified.project(model.unproject(pixels) @ R.T)[:, :2]
        for model, pixels, R in zip(models, seen, turns, strict=True)
    ]
    inside = np.isfinite(np.hstack(places)).all(axis=1)
    left, right = (each[inside] for each in places)
    covariance, flow = np.tile(NOISE**2 * np.eye(2), (len(left), 1, 1)), np.full_like(left, np.nan)
    return EyeMatches(left, right, covariance, np.full(len(left), 0.9), flow, np.zeros(len(left), int))


def turned_by(camera: StereoCamera, other: StereoCamera) -> np.ndarray:
    """(3,) degrees from one right camera to another's."""
    return np.degrees(cv2.Rodrigues(camera.T_left_right[:3, :3].T @ other.T_left_right[:3, :3])[0].ravel())


@pytest.mark.parametrize("distortion", [(), LENS])
@pytest.mark.parametrize(
    "turn", [(0.5, 0.0, 0.0), (-2.0, 0.0, 0.0), (0.0, 0.0, 1.0), (1.0, 0.0, -2.0), (1.0, 4.0, 1.0)]
)
def test_a_turned_right_camera_is_turned_back(turn: tuple[float, float, float], distortion: tuple[float, ...]):
    true, given = rig(distortion, turn), rig(distortion)
    level = level_eyes(matches_of(true, given), StereoRectifier(given))
    # A tenth of a pixel over six hundred matches; a yaw shows in the corners alone.
    np.testing.assert_array_less(np.abs(turned_by(true, level.rectifier.camera)), (0.003, 0.05, 0.01))
    assert np.median(np.abs(level.matches.row_difference)) < 2.0 * NOISE


@pytest.mark.parametrize("rows", [-20.0, 3.0])
def test_a_moved_principal_point_is_no_turn(rows: float):
    given, true = rig(LENS), rig(LENS)
    true = replace(true, right=replace(true.right, cy=true.right.cy + rows))
    camera = level_eyes(matches_of(true, given), StereoRectifier(given)).rectifier.camera
    assert camera.right.cy == pytest.approx(true.right.cy, abs=0.05)
    np.testing.assert_allclose(turned_by(true, camera), 0.0, atol=0.01)


def test_an_enlarged_right_image_is_no_turn():
    given, true = rig(LENS), rig(LENS)
    true = replace(true, right=replace(true.right, fx=1.03 * 500.0, fy=1.03 * 500.0))
    level = level_eyes(matches_of(true, given), StereoRectifier(given))
    assert list(level.causes) == ["zoom"]
    assert level.rectifier.camera.right.fy == pytest.approx(515.0, abs=0.3)
    # It may be the left one, and the scale with it.
    assert level.rectifier.camera.sigmas.focal == pytest.approx(0.03 / np.sqrt(2.0), rel=0.1)


@pytest.mark.long
def test_lenses_that_bend_rows_hide_no_fault_of_a_highway_camera(real_data):
    """KITTI 01: rows bent as by half a degree of yaw; those of its road go with y^2, as a pitch's and a delay's do."""
    sequence = open_sequence(real_data / "kitti_odometry_01_f000_050").select(Selection(count=17))
    given = sequence.camera
    turn = rigid_motion(cv2.Rodrigues(np.radians((0.45, 0.0, 0.0)))[0], np.zeros(3))
    sequence.camera = replace(given, T_left_right=given.T_left_right @ turn)
    check = check_sequence(sequence, 4, 1)
    np.testing.assert_array_less(np.abs(turned_by(check.camera, given)), (0.03, 0.05, 0.05))
    assert check.camera.right.cy == given.right.cy
    assert not [each for each in wrong(check.findings) if each.name == "synchronisation"]
    sequence.camera = replace(given, right=replace(given.right, cx=given.right.cx - 4.0))
    assert check_sequence(sequence, 4, 1).camera.right.cx - given.right.cx == pytest.approx(0.0, abs=3.0)


@pytest.mark.long
@pytest.mark.parametrize(("pitch", "rows"), [(-0.5, 0.0), (0.0, 3.0)])
def test_pitch_and_principal_point_are_told_apart_by_a_swaying_camera(real_data, pitch: float, rows: float):
    """MH01, whose lenses leave rows that are more curved than what the wrong one of the two leaves."""
    sequence = open_sequence(real_data / "euroc_mh01_f000_099").select(Selection(20, 17))
    given = sequence.camera
    turn = rigid_motion(cv2.Rodrigues(np.radians((pitch, 0.0, 0.0)))[0], np.zeros(3))
    right = replace(given.right, cy=given.right.cy + rows)
    sequence.camera = replace(given, right=right, T_left_right=given.T_left_right @ turn)
    found = check_sequence(sequence, 4, 1).camera
    assert found.right.cy == pytest.approx(given.right.cy, abs=0.5)
    assert abs(turned_by(found, given)[0]) < 0.05


@pytest.mark.long
def test_a_size_that_a_large_shift_hides_is_corrected(real_data):
    sequence = open_sequence(real_data / "euroc_mh01_f000_099").select(Selection(count=17))
    given = sequence.camera
    turn = rigid_motion(cv2.Rodrigues(np.radians((0.28, 0.0, -0.14)))[0], np.zeros(3))
    right = replace(given.right, fx=1.0094 * given.right.fx, fy=1.0094 * given.right.fy, cy=given.right.cy + 7.5)
    sequence.camera = replace(given, right=right, T_left_right=given.T_left_right @ turn)
    check = check_sequence(sequence, 4, 1)
    assert check.camera.right.fy == pytest.approx(given.right.fy, rel=2e-3)
    (scale,) = [each for each in wrong(check.findings) if each.name == "scale"]
    # What was corrected, not what the shift left of it.
    assert "the right image is -0.89 % taller" in scale.message


def test_an_image_that_is_stretched_down_alone_is_not_widened():
    given, true = rig(LENS), rig(LENS)
    true = replace(true, right=replace(true.right, fy=1.03 * 500.0))
    right = level_eyes(matches_of(true, given), StereoRectifier(given)).rectifier.camera.right
    # Pixels were given as square, and rows cannot tell: the wider image bends rows at the border, too.
    assert (right.fx, right.fy) == (pytest.approx(515.0, abs=1.0), pytest.approx(515.0, abs=1.0))
    given = replace(given, right=replace(given.right, fy=0.97 * 500.0))
    right = level_eyes(matches_of(rig(LENS), given), StereoRectifier(given)).rectifier.camera.right
    assert (right.fx, right.fy) == (pytest.approx(500.0, abs=0.5), pytest.approx(500.0, abs=0.5))


def test_rows_that_agree_are_left_as_they_are():
    given = rig(LENS)
    rectifier = StereoRectifier(given)
    # Less than calibrations are usually off by.
    level = level_eyes(matches_of(rig(LENS, (0.05, 0.0, 0.05)), given), rectifier)
    assert level.causes == {}
    assert level.rectifier is rectifier


def test_a_calibration_is_held_to_what_it_claims():
    true = rig(LENS, (0.0, 0.0, 0.06))
    for claimed, causes in ((CalibrationSigmas(), []), (CalibrationSigmas.none(), ["roll"])):
        given = replace(rig(LENS), sigmas=claimed)
        assert list(level_eyes(matches_of(true, given), StereoRectifier(given)).causes) == causes
    measured = CalibrationCovariance(("roll",), np.diag([0.01**2]))
    given = replace(rig(LENS), covariance=measured)
    assert level_eyes(matches_of(rig(LENS, (0.0, 0.0, 0.2)), given), StereoRectifier(given)).causes == {}
    # However little a calibration claims, rows beyond what is searched are corrected.
    given = replace(rig(LENS), sigmas=CalibrationSigmas(rotation=0.1))
    assert level_eyes(matches_of(rig(LENS, (1.0, 0.0, 0.0)), given), StereoRectifier(given)).causes.keys() == {"shift"}


def test_few_matches_correct_nothing_that_may_be_chance():
    given, rng = rig(), np.random.default_rng(3)
    matches = matches_of(given, given).select(np.arange(60))
    matches.right[:, 1] += rng.normal(scale=3.0, size=60)
    level = level_eyes(matches, StereoRectifier(given))
    # Roll and size are off by more than usual, and by less than that scatter.
    assert max(abs(level.fit.roll), abs(level.fit.zoom)) > 1.0
    assert level.causes == {}


def test_no_rig_is_made_of_matches_that_follow_none():
    given = rig()
    matches = matches_of(given, given)
    matches.right[:] = np.random.default_rng(1).uniform((0, 0), (640, 480), matches.right.shape)
    assert level_eyes(matches, StereoRectifier(given)).causes == {}


@pytest.mark.long
def test_a_rig_that_nothing_could_be_is_left_as_it_is():
    given, rng = rig(), np.random.default_rng(0)
    matches = matches_of(given, given).select(np.arange(60))
    for _ in range(20):
        roll, yaw = rng.uniform(-800.0, 800.0, 2)
        x, y = ((matches.right - (319.5, 239.5)) / 500.0).T
        bent = replace(matches, right=matches.right + np.stack([0.0 * x, roll * x + yaw * x * y], 1))
        _, camera = check_rig(bent, StereoRectifier(given), None)
        assert np.isfinite(camera.T_left_right).all()


def test_what_is_corrected_is_said_and_hinders_nothing():
    given = rig(LENS)
    findings, camera = check_rig(matches_of(rig(LENS, (1.0, 0.0, 1.0)), given), StereoRectifier(given), 0.1)
    named = {each.name: each for each in findings}
    for name in ("rows", "rotation"):
        assert named[name].severity == "warning"
        assert "poses are corrected" in named[name].message
        assert not named[name].pixels
    assert {each.severity for each in findings if each.name not in ("rows", "rotation")} == {"ok", "unknown"}
    np.testing.assert_allclose(turned_by(given, camera), (1.0, 0.0, 1.0), atol=0.05)


def test_a_yaw_that_lenses_could_be_leaves_poses_doubtful():
    given = rig(LENS)
    findings, _ = check_rig(matches_of(rig(LENS, (0.0, 4.0, 0.0)), given), StereoRectifier(given), 0.1)
    rotation = next(each for each in findings if each.name == "rotation")
    # Half a pixel of rows in the corners.
    assert rotation.pixels == pytest.approx(4.0, abs=3.0)


@pytest.mark.long
@pytest.mark.parametrize("fault", ["rows off by 3", "turned by roll 1", "turned by pitch 2"])
def test_the_demo_is_tracked_as_well_with_a_right_eye_that_is_off(fault: str, demo: Demo):
    camera, frames, truth = demo
    frames = frames[:12]
    sequence = FAULTS[fault].inject(frames, camera)
    errors = []
    for seen, calibration in ((sequence_of(frames, camera), camera), (sequence, check_sequence(sequence, 4).camera)):
        tracker = StereoTracker(calibration)
        poses = [tracker.step(each.left, each.right, each.timestamp).T_world_camera for each in seen.frames()]
        motion = np.linalg.inv(truth[0]) @ truth[len(frames) - 1]
        errors.append(np.linalg.norm(poses[-1][:3, 3] - motion[:3, 3]))
    assert errors[1] < 3.0 * errors[0] + 0.001


@pytest.mark.long
def test_pairs_in_memory_are_checked_as_a_stream_is(demo: Demo):
    camera, frames, _ = demo
    sequence = FAULTS["turned by roll 1"].inject(frames[:18], camera)
    pairs = [(each.left, each.right, each.timestamp) for each in sequence.frames()]
    streamed, check = (check_pairs(sequence.camera, part) for part in (iter(pairs[:17]), pairs))
    assert [each.message for each in check.findings] == [each.message for each in streamed.findings]
    np.testing.assert_allclose(turned_by(check.camera, camera), (0.0, 0.0, 1.0), atol=0.1)
    assert check.tracker_arguments == {"camera": check.camera, "disparity_error": None, "right_delay": 0.0}
    for few in ([], [pairs[0][:2]], frames[:17], [(None, None, 0.0)], [(np.zeros(3), np.zeros(3), 0.0)]):
        with pytest.raises(InputError, match=r"\(left, right, seconds\).*17"):
            check_pairs(camera, few)
