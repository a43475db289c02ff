"""The tracker as a whole, on rendered images with exact truth and on real ones."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from sigmaslam import StereoTracker, open_sequence
from sigmaslam.errors import InputError
from sigmaslam.geometry.se3 import se3_inverse, se3_log
from sigmaslam.geometry.trajectory import Trajectory
from sigmaslam.readers import StereoFrame
from sigmaslam.readers.trajectory_files import read_kitti
from sigmaslam.slam.tracker import Estimate
from sigmaslam_evaluation.metrics.trajectory_errors import absolute_trajectory_error, kitti_errors
from tests.support.estimates import Demo, mirrored, position_sigma, squared_error, track
from tests.support.faults import broken
from tests.support.quantiles import WITHIN_3_SIGMA

# The whole demo by the name of the front end.
Tracked = Callable[[str], list[Estimate]]


def trajectory_of(estimates: list[Estimate]) -> Trajectory:
    return Trajectory(np.array([e.timestamp for e in estimates]), np.stack([e.T_world_camera for e in estimates]))


def position_error(estimates: list[Estimate], demo: Demo) -> float:
    """Root of the mean square after alignment, metres."""
    _, frames, truth = demo
    times = np.array([frame.timestamp for frame in frames])
    return absolute_trajectory_error(trajectory_of(estimates), Trajectory(times, truth)).rmse


@pytest.mark.long
@pytest.mark.parametrize("frontend", ["learned", "sift", "orb", "klt"])
def test_every_front_end_follows_the_rendered_camera(demo: Demo, demo_estimates: Tracked, frontend: str):
    """Within two centimetres and half a degree over 1.1 m and 2 s."""
    _, frames, truth = demo
    estimates = demo_estimates(frontend)
    assert [e.status for e in estimates] == ["starting"] + ["tracking"] * (len(frames) - 1)
    assert position_error(estimates, demo) < 0.02
    last = se3_log(se3_inverse(truth[-1]) @ estimates[-1].T_world_camera)
    assert np.linalg.norm(last[:3]) < 0.06
    assert np.rad2deg(np.linalg.norm(last[3:])) < 0.5


@pytest.mark.long
def test_the_covariance_is_positive_definite_and_grows_along_the_way(demo_estimates: Tracked):
    estimates = demo_estimates("klt")
    smallest = [np.linalg.eigvalsh(e.covariance)[0] for e in estimates[1:]]
    assert min(smallest) > 0
    sigma = [position_sigma(e) for e in estimates]
    assert sigma[0] == 0.0
    assert sigma[-1] > sigma[3] > 0


@pytest.mark.long
def test_poses_between_two_keyframes_stand_on_one_offset(demo_estimates: Tracked):
    estimates = demo_estimates("learned")
    second = [k for k, each in enumerate(estimates) if each.tracks is not None][1]
    held = [each.calibration.disparity_offset for each in estimates[second:]]
    between = [k for k, each in enumerate(estimates[second:]) if k and each.tracks is None]
    assert len(between) > len(held) // 2
    assert all(held[k] == held[k - 1] for k in between)


@pytest.mark.long
def test_onnx_and_torch_give_the_same_poses(demo: Demo):
    pytest.importorskip("torch")
    camera, frames, _ = demo
    onnx = trajectory_of(track(StereoTracker(camera, "klt", backend="onnx"), frames[:5]))
    torch = trajectory_of(track(StereoTracker(camera, "klt", backend="torch"), frames[:5]))
    np.testing.assert_allclose(onnx.poses, torch.poses, atol=1e-9)


@pytest.mark.long
def test_frames_without_texture_are_lost_not_wrong_and_the_tracker_comes_back(demo: Demo):
    """Three black frames: lost, more and more uncertain, true pose inside three sigma; then tracking again."""
    camera, frames, truth = demo
    black = np.zeros_like(frames[0].left)
    dark = broken(frames[:20], range(10, 13), lambda frame: (black, black))
    estimates = track(StereoTracker(camera), dark)
    assert [e.status for e in estimates[10:13]] == ["lost"] * 3
    sigma = [position_sigma(e) for e in estimates]
    assert sigma[9] < sigma[10] < sigma[11] < sigma[12]
    assert [e.status for e in estimates[13:]] == ["tracking"] * 7
    for k in range(10, 13):
        assert squared_error(estimates[k], truth[k]) < WITHIN_3_SIGMA


@pytest.mark.long
def test_a_new_start_after_a_long_loss_is_accurate_from_there_and_uncertain_from_before(demo: Demo):
    """The world turns into its mirror image for good, five seconds pass: nothing matches, tracking starts anew.

    The pose is then hardly known, but motion from there is as well known as ever.
    """
    camera, frames, truth = demo
    reflected = [mirrored(frame, frame.timestamp + 5.0) for frame in frames[8:20]]
    estimates = track(StereoTracker(camera), frames[:8] + reflected)
    assert estimates[8].status == "lost"
    assert [e.status for e in estimates[9:]] == ["tracking"] * 11
    sigma = [position_sigma(e) for e in estimates]
    assert min(sigma[8:]) > 10 * max(sigma[:8])
    # The mirrored left camera is the right one: same motion, seen from the baseline's other end, with x turned round.
    mirror = np.diag([-1.0, 1.0, 1.0, 1.0])
    to_right = np.eye(4)
    to_right[0, 3] = camera.baseline
    right = [mirror @ pose @ to_right @ mirror for pose in truth]
    expected = se3_inverse(right[8]) @ right[19]
    found = se3_inverse(estimates[8].T_world_camera) @ estimates[19].T_world_camera
    error = se3_log(se3_inverse(expected) @ found)
    assert np.linalg.norm(error[:3]) < 0.03
    assert np.rad2deg(np.linalg.norm(error[3:])) < 0.3


@pytest.mark.long
def test_dropped_frames_are_bridged_by_their_time(demo: Demo):
    camera, frames, _ = demo
    kept = [k for k in range(len(frames)) if k not in (7, 8, 15, 16, 17, 30)]
    estimates = track(StereoTracker(camera), [frames[k] for k in kept])
    assert all(e.status == "tracking" for e in estimates[1:])
    assert position_error(estimates, demo) < 0.02


def test_a_camera_that_stands_still_does_not_drift(demo: Demo):
    camera, frames, _ = demo
    # No sensor gives the same row twice.
    images = [(frames[0].left.copy(), frames[0].right.copy()) for _ in range(8)]
    for k, pair in enumerate(images):
        for image in pair:
            image[:, 0] = k
    still = [StereoFrame(k, 0.05 * k, *pair) for k, pair in enumerate(images)]
    for estimate in track(StereoTracker(camera), still)[1:]:
        assert estimate.status == "tracking"
        assert np.abs(se3_log(estimate.T_world_camera)).max() < 1e-4


def test_time_that_does_not_go_forward_is_refused(demo: Demo):
    camera, frames, _ = demo
    tracker = StereoTracker(camera, "klt")
    tracker.step(frames[0].left, frames[0].right, 1.0)
    with pytest.raises(InputError, match=r"1\.000000"):
        tracker.step(frames[1].left, frames[1].right, 1.0)


@pytest.mark.long
def test_the_map_lies_in_the_room(demo: Demo):
    """Map points reproject near where the first camera would see them: in front of it and within the room."""
    camera, frames, _ = demo
    tracker = StereoTracker(camera)
    track(tracker, frames[:15])
    found = tracker.map()
    assert len(found.points) > 200
    assert (found.observations >= 3).all()
    assert np.quantile(np.linalg.norm(found.points, axis=1), 0.95) < 10.0
    assert (np.linalg.eigvalsh(found.covariances)[:, 0] > 0).all()


@pytest.mark.slow
def test_the_kitti_drive_meets_its_goals(real_data: Path):
    """All 186 frames across the 0.3 s gap; SIFT odometry of plain OpenCV has 0.351 m and 0.85 %."""
    folder = real_data / "kitti_raw_0926_0039_a"
    sequence = open_sequence(folder)
    estimates = track(StereoTracker(sequence.camera), list(sequence.frames()))
    assert len(estimates) == 186
    assert all(e.status == "tracking" for e in estimates[1:])
    estimate, truth = trajectory_of(estimates), read_kitti(folder / "poses.txt")
    assert absolute_trajectory_error(estimate, truth).rmse <= 0.35
    assert kitti_errors(estimate, truth).mean_translation_percent <= 1.0


@pytest.mark.slow
def test_a_drone_on_the_ground_stays_there(real_data: Path):
    sequence = open_sequence(real_data / "euroc_v1_01_static")
    for estimate in track(StereoTracker(sequence.camera), list(sequence.frames()))[1:]:
        drift = se3_log(estimate.T_world_camera)
        assert np.linalg.norm(drift[:3]) < 1e-3
        assert np.rad2deg(np.linalg.norm(drift[3:])) < 0.05
