"""What is masked of the left image is not used: no keypoint, no landmark and no match is there."""

from pathlib import Path

import cv2
import numpy as np
import pytest

from sigmaslam import StereoTracker
from sigmaslam.errors import FrameError
from sigmaslam.geometry.camera import CameraModel, StereoCamera
from sigmaslam.geometry.rectification import StereoRectifier
from sigmaslam.slam.frame import usable_pixels
from tests.support.commands import assert_refused, run_here
from tests.support.estimates import Demo

FRONTENDS = [pytest.param("learned", marks=pytest.mark.long), "klt"]
FISHEYE = CameraModel(160, 120, 95.0, 95.0, 79.5, 59.5, 0.0, "equidistant", (-0.01, 0.004, -0.002, 0.0))


def turned_rig() -> StereoCamera:
    """Two fisheye lenses, the right one turned by some degrees."""
    T = np.eye(4)
    T[:3, :3] = cv2.Rodrigues(np.array([0.02, -0.03, 0.05]))[0]
    T[0, 3] = 0.1
    return StereoCamera(FISHEYE, FISHEYE, T)


@pytest.mark.parametrize("frontend", FRONTENDS)
def test_a_mask_of_nothing_changes_no_bit(demo: Demo, frontend: str):
    camera, frames, _ = demo
    white = np.full((camera.left.height, camera.left.width), 255, np.uint8)
    without, masked = StereoTracker(camera, frontend), StereoTracker(camera, frontend)
    for frame in frames[:6]:
        expected = without.step(frame.left, frame.right, frame.timestamp)
        found = masked.step(frame.left, frame.right, frame.timestamp, white)
        np.testing.assert_array_equal(found.T_world_camera, expected.T_world_camera)
        np.testing.assert_array_equal(found.covariance, expected.covariance)


@pytest.mark.parametrize("frontend", FRONTENDS)
def test_nothing_is_found_where_it_is_masked(demo: Demo, frontend: str):
    """The left third is masked from the second keyframe's time on: landmarks that lie there are not matched either."""
    camera, frames, _ = demo
    mask = np.ones((camera.left.height, camera.left.width), bool)
    mask[:, : camera.left.width // 3] = False
    tracker = StereoTracker(camera, frontend)
    tracker.step(frames[0].left, frames[0].right, frames[0].timestamp)
    estimates = []
    for frame in frames[1:12]:
        estimates.append(tracker.step(frame.left, frame.right, frame.timestamp, mask))
        assert tracker.last_frame.pixels[:, 0].min() > camera.left.width // 3
        tracks = estimates[-1].tracks
        assert tracks is None or tracks.measurement[:, 0].min() > camera.left.width // 3
    assert [estimate.status for estimate in estimates] == ["tracking"] * 11
    assert any(estimate.tracks is not None for estimate in estimates)


def test_masks_are_rectified_as_images_are():
    """By the nearest pixel: where the bilinear one comes from one side of the border alone, it is that side."""
    rectifier = StereoRectifier(turned_rig())
    mask = np.zeros((120, 160), np.uint8)
    mask[:, 70:] = 255
    image, _ = rectifier.rectify(mask, mask)
    found, inside = rectifier.rectify_mask(mask), rectifier.valid_mask > 0
    assert set(np.unique(found)) == {0, 255}
    for value in (0, 255):
        assert (found[inside & (image == value)] == value).all()


def test_patches_that_show_what_is_masked_are_not_used():
    camera = StereoCamera(CameraModel(60, 40, 50.0, 50.0, 30.0, 20.0), CameraModel(60, 40, 50.0, 50.0, 30.0, 20.0), T())
    mask = np.ones((40, 60), np.uint8)
    mask[20, 30] = 0
    usable = usable_pixels(mask, StereoRectifier(camera))
    assert not usable[15:26, 25:36].any()
    assert (~usable).sum() == 11 * 11


def T() -> np.ndarray:  # noqa: N802
    """Of a rectified pair."""
    T = np.eye(4)
    T[0, 3] = 0.1
    return T


@pytest.mark.parametrize(
    ("mask", "words"),
    [
        (np.zeros((240, 320), bool), "zero everywhere"),
        (np.ones((120, 160), np.uint8), r"uint8 \(120, 160\): give a bool or uint8 array \(240, 320\)"),
        (np.ones((240, 320)), r"float64 \(240, 320\)"),
        ("mask.png", "mask is 'mask.png'"),
    ],
)
def test_a_wrong_mask_is_refused_and_the_next_frame_is_tracked(demo: Demo, mask: object, words: str):
    camera, frames, _ = demo
    tracker = StereoTracker(camera, "klt")
    tracker.step(frames[0].left, frames[0].right, frames[0].timestamp)
    with pytest.raises(FrameError, match=words):
        tracker.step(frames[1].left, frames[1].right, frames[1].timestamp, mask)
    assert tracker.step(frames[1].left, frames[1].right, frames[1].timestamp).status == "tracking"


@pytest.mark.long
def test_the_command_takes_a_mask(demo_sequence: Path, tmp_path: Path, without_report: None):
    mask = np.ones((240, 320), np.uint8)
    mask[200:] = 0
    cv2.imwrite(str(tmp_path / "mask.png"), mask)
    options = ("--out", tmp_path / "run", "--frontend", "klt", "--frames", "3")
    result = run_here("track", demo_sequence, *options, "--mask", tmp_path / "mask.png")
    assert result.returncode == 0, result.stderr
    assert str(tmp_path / "mask.png") in (tmp_path / "run" / "run.json").read_text()
    cv2.imwrite(str(tmp_path / "mask.png"), mask[::2])
    refused = run_here("track", demo_sequence, "--out", tmp_path / "other", "--mask", tmp_path / "mask.png")
    assert_refused(refused, "mask.png: the mask is 320x120 pixels, the left image 320x240")
