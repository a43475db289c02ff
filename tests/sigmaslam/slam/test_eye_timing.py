"""A texture that moves up and down, seen by two eyes of one moment or of two."""

from pathlib import Path

import cv2
import numpy as np
import pytest

from sigmaslam.geometry.se3 import se3_exp
from sigmaslam.readers import open_sequence
from sigmaslam.slam.doubt import Doubt
from sigmaslam.slam.eye_timing import EyeTiming
from sigmaslam.slam.frame import Frame
from sigmaslam.slam.tracker import StereoTracker

DISPARITY, FRAMES = 5, 40
BASELINE, STEP = 0.5, np.array([0.1, 0.2, 0.2, 0.0, 0.0, 0.0])
ROWS = np.random.default_rng(3).integers(-3, 4, FRAMES)
"""By which the texture is lower in each frame."""
PLACES = np.stack(np.meshgrid(np.arange(30, 180, 15), np.arange(30, 140, 15)), axis=-1).reshape(-1, 2)


class Texture:
    """In place of a front-end, which is not asked."""

    observe = None


def seen_apart(
    right_rows: np.ndarray, follows: bool = True, timing: EyeTiming | None = None, light: float = 1.0
) -> list[bool]:
    """What is said of each frame, whose right eye shows the texture by so many rows lower, from 10 on in that light."""
    noise = np.random.default_rng(2).normal(128.0, 120.0, (170, 210))  # as faint as sand
    texture = np.clip(cv2.GaussianBlur(noise, (0, 0), 3.0), 0, 255).astype(np.uint8)
    timing, said, pose = timing or EyeTiming(BASELINE), [], np.eye(4)
    for number, (left, right) in enumerate(zip(ROWS, right_rows, strict=True)):
        lit = np.uint8(light * texture) if number >= 10 else texture
        frame = Frame(np.roll(texture, left, 0), np.roll(lit, (right, -DISPARITY), (0, 1)), Texture)  # type: ignore[arg-type]
        seen = np.column_stack([PLACES + (0, left), np.full(len(PLACES), float(DISPARITY))])
        pose = pose @ se3_exp(STEP)
        said.append(timing.are_apart(frame, pose, np.arange(len(PLACES)), seen, follows))
    return said


def test_eyes_of_one_moment_are_never_apart():
    assert not any(seen_apart(ROWS))


@pytest.mark.parametrize("by", [1, 3, 8])
def test_another_height_of_the_right_eye_is_no_other_moment(by: int):
    assert not any(seen_apart(ROWS + by))


def test_an_eye_that_becomes_dark_is_of_the_same_moment():
    """Patches that are compared as they are then slide to other rows, of which some fit those before better."""
    assert not any(seen_apart(ROWS, light=0.5))


@pytest.mark.parametrize("light", [1.0, 0.5])
@pytest.mark.parametrize("late", [1, -1], ids=["right", "left"])
def test_an_eye_that_is_a_frame_behind_is_named_within_four_frames(late: int, light: float):
    said = seen_apart(np.roll(ROWS, late), light=light)
    assert all(said[4:])


def test_what_a_frame_without_a_pose_was_before_is_not_compared():
    assert not any(seen_apart(np.roll(ROWS, 1), follows=False))


def test_eyes_that_agree_again_are_apart_as_long_as_the_map_is_spoilt():
    rows = ROWS.copy()
    rows[5:12] = ROWS[4:11]
    said = seen_apart(rows)
    assert all(said[9:31])
    assert not any(said[:5] + said[36:])


def test_poses_drift_as_long_as_eyes_are_apart_and_keep_that():
    rows, together, apart = ROWS.copy(), EyeTiming(BASELINE), EyeTiming(BASELINE)
    rows[5:12] = ROWS[4:11]
    seen_apart(ROWS, timing=together)
    seen_apart(rows, timing=apart)
    seen_apart(np.roll(ROWS, 1), timing=(always := EyeTiming(BASELINE)))
    assert together.drift == 0.0
    # Each step of 0.3 m goes on 0.1 m along the baseline, a fifth of it.
    assert 7 * 0.3 * 0.2 < apart.drift < always.drift < FRAMES * 0.3


@pytest.mark.slow
def test_a_rover_whose_right_eye_turns_dark_is_honest(real_data: Path):
    """At 181 s of 225; its disparities are 3.6 px off and its lenses have no model, as the covariances must hold."""
    folder = real_data / "lunar_sand_rover_f000_224"
    truth = np.loadtxt(folder / "truth_xy.csv", delimiter=",")[:, 1:]
    sequence = open_sequence(folder)
    tracker = StereoTracker(sequence.camera)
    estimates = [tracker.step(each.left, each.right, each.timestamp) for each in sequence.frames()]
    assert not any(Doubt.APART in each.doubts for each in estimates)
    for k in range(30, len(estimates), 30):
        pose, covariance = estimates[k].T_world_camera, estimates[k].covariance
        way = pose[:3, 3]
        ahead = pose[:3, :3].T @ way / np.linalg.norm(way)  # as the covariance, in the camera's frame
        off = np.linalg.norm(way) - np.linalg.norm(truth[k] - truth[0])
        # The truth is off by 2 cm for its time.
        assert abs(off) < 3.0 * np.sqrt(ahead @ covariance[:3, :3] @ ahead + 0.02**2)
