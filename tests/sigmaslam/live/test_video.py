"""Videos of runs: every frame is there, and shows what was matched; a failure costs the video alone."""

import json
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from sigmaslam.bodies.object_tracker import ObjectEstimate
from sigmaslam.errors import InputError
from sigmaslam.geometry.camera import StereoCamera
from sigmaslam.geometry.se3 import se3_exp
from sigmaslam.live.frame_drawing import STATUS_COLOURS, FramePainter, Plan
from sigmaslam.live.frame_sink import ThreadedSink, TrackedFrame, check_sink_path
from sigmaslam.live.keyframe_points import KeyframePoints
from sigmaslam.live.video import VideoSink, count_frames, frame_rate
from sigmaslam.readers import open_sequence
from sigmaslam.slam.mapping import KeyframeTracks
from tests.support.commands import run_here
from tests.support.demo_parts import copy_frames
from tests.support.recorded_runs import frame_at

FRAMES = 12


@pytest.fixture(scope="module")
def sequence(demo_sequence: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return copy_frames(demo_sequence, tmp_path_factory.mktemp("some") / "sequence", FRAMES)


@pytest.fixture(scope="module")
def camera(demo_sequence: Path) -> StereoCamera:
    return open_sequence(demo_sequence).camera


@pytest.mark.long
@pytest.mark.usefixtures("without_report")
def test_the_video_of_a_run_has_its_frames_and_its_rate(sequence: Path, tmp_path: Path):
    run = tmp_path / "run"
    arguments = ("track", sequence, "--out", run, "--frontend", "klt", "--video", run / "video.mp4")
    done = run_here(*arguments)
    assert done.returncode == 0, done.stderr
    video = cv2.VideoCapture(str(run / "video.mp4"))
    assert video.get(cv2.CAP_PROP_FPS) == pytest.approx(20.0)
    pictures = []
    while (read := video.read())[0]:
        pictures.append(read[1])
    assert len(pictures) == FRAMES
    # The left half is the image of that frame and of no other, tracks drawn over it or not.
    images = [cv2.imread(str(path), cv2.IMREAD_GRAYSCALE) for path in sorted((sequence / "image_0").iterdir())]
    for number, picture in enumerate(pictures):
        shown = cv2.resize(cv2.cvtColor(picture[:, :640], cv2.COLOR_BGR2GRAY), images[0].shape[::-1])
        assert np.argmax([np.corrcoef(shown.ravel(), image.ravel())[0, 1] for image in images]) == number
    # It belongs to the run, which may be tracked anew.
    assert run_here(*arguments, "--overwrite").returncode == 0
    assert count_frames(run / "video.mp4") == FRAMES


@pytest.mark.long
@pytest.mark.usefixtures("without_report")
def test_a_video_that_fails_leaves_a_whole_run(sequence: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    taken = FramePainter.add

    def add(self: FramePainter, frame: TrackedFrame) -> None:
        if frame.number == FRAMES - 2:
            raise RuntimeError("no more paint")
        taken(self, frame)

    monkeypatch.setattr(FramePainter, "add", add)
    video = tmp_path / "video.mp4"
    done = run_here("track", sequence, "--out", tmp_path / "run", "--frontend", "klt", "--video", video)
    assert done.returncode == 2
    assert "no more paint" in done.stderr
    assert not video.exists()
    assert [path.name for path in tmp_path.iterdir()] == ["run"]
    summary = json.loads((tmp_path / "run" / "run.json").read_text())["summary"]
    assert summary["poses"] == FRAMES


def test_a_short_video_is_written_and_an_empty_one_is_not(camera: StereoCamera, tmp_path: Path):
    for count in (0, 1, 3):
        sink = ThreadedSink(VideoSink(tmp_path / f"{count}.mp4", camera))
        for number in range(count):
            sink.add(frame_at(number, np.eye(4)))
        sink.close()
    assert not (tmp_path / "0.mp4").exists()
    assert [count_frames(tmp_path / f"{count}.mp4") for count in (1, 3)] == [1, 3]


def test_the_path_turns_on_the_panel_as_it_does_from_above(camera: StereoCamera):
    """Ahead is up, to the right is right, and a loss has its colour."""
    painter = FramePainter(camera)
    poses = [se3_exp(np.array([0.0, 0.0, z, 0.0, 0.0, 0.0])) for z in np.linspace(0, 10, 11)]
    poses += [se3_exp(np.array([x, 0.0, 10.0, 0.0, 0.0, 0.0])) for x in np.linspace(1, 10, 10)]
    for number, pose in enumerate(poses):
        painter.add(frame_at(number, pose, "tracking" if number < 11 else "lost"))
    picture = painter.draw()
    assert picture.shape[0] % 2 == picture.shape[1] % 2 == 0
    panel = picture[:370, picture.shape[1] - picture.shape[0] :].astype(int)  # above the words
    tracked, lost = (
        np.argwhere(np.abs(panel - STATUS_COLOURS[status]).sum(axis=2) < 30) for status in ("tracking", "lost")
    )
    assert np.ptp(tracked[:, 0]) > 10 * np.ptp(tracked[:, 1])
    assert np.ptp(lost[:, 1]) > 5 * np.ptp(lost[:, 0])
    assert lost[:, 0].max() < tracked[:, 0].mean()
    assert lost[:, 1].min() > tracked[:, 1].min()


def test_frames_without_a_pose_and_bodies_are_drawn(camera: StereoCamera):
    unknown = frame_at(0, np.full((4, 4), np.nan), "starting")
    body = TrackedFrame(2, ObjectEstimate(frame_at(2, np.eye(4)).result.camera), unknown.seen)
    painter, shapes = FramePainter(camera), set()
    for frame in (unknown, frame_at(1, np.eye(4)), body):
        painter.add(frame)
        shapes.add(painter.draw().shape)
    assert len(shapes) == 1


def test_the_plan_of_a_long_run_is_thinned_and_ends_at_the_newest_pose(
    camera: StereoCamera, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setattr("sigmaslam.live.frame_drawing._MOST_POSES", 11)
    plan = Plan(KeyframePoints(camera))
    for number in range(100):
        pose = np.eye(4)
        pose[2, 3] = number
        plan.add(frame_at(number, pose))
        depths = [each[1] for each in plan._path]
        assert len(depths) == len(plan._status) <= 11
        assert (depths[0], depths[-1]) == (0, number)
        steps = np.diff(depths)
        assert len(set(steps[:-1])) <= 1
        assert number < 10 or len(depths) > 5


def test_points_of_keyframes_are_where_they_were_seen_and_shown_once(camera: StereoCamera):
    shown = KeyframePoints(camera)
    points = np.column_stack([np.linspace(-1, 1, 9), np.linspace(0.5, -0.5, 9), np.linspace(3, 5, 9)])
    pose = se3_exp(np.array([0.3, 0.1, -0.2, 0.1, 0.5, -0.1]))
    T_rectified_left = np.linalg.inv(shown.T_left_rectified)
    measured = shown.camera.project(points @ T_rectified_left[:3, :3].T + T_rectified_left[:3, 3])
    covariance = np.tile(0.01 * np.eye(3), (9, 1, 1))
    covariance[8, 2, 2] = 1e6  # nothing is known of its depth
    measured[7, 2] = np.nan
    frame = frame_at(0, pose)
    tracks = KeyframeTracks(np.arange(9), measured + [0.0, 0.0, 0.4], covariance)
    calibration = replace(frame.result.calibration, disparity_offset=0.4)
    frame = replace(frame, result=replace(frame.result, tracks=tracks, calibration=calibration))
    found, grey = shown.add(frame)
    np.testing.assert_allclose(found, points[:7] @ pose[:3, :3].T + pose[:3, 3], atol=1e-9)
    assert len(grey) == 7
    assert not len(shown.add(frame)[0])


@pytest.mark.parametrize(("interval", "rate"), [(0.05, 20.0), (0.1, 10.0), (1.0, 5.0), (0.001, 60.0)])
def test_the_rate_is_that_of_the_frames_within_what_players_show(interval: float, rate: float):
    times = 1.7e9 + interval * np.arange(10)
    times[5:] += 3.0  # a gap
    assert frame_rate(times) == pytest.approx(rate, rel=1e-4)


@pytest.mark.parametrize("name", ["run/clip.mp4", "clip.avi", "nowhere/clip.mp4", "there.mp4"])
def test_a_name_that_cannot_be_a_video_is_refused(tmp_path: Path, name: str):
    (tmp_path / "there.mp4").touch()
    with pytest.raises(InputError, match="--video"):
        check_sink_path("--video", tmp_path / name, tmp_path / "run", "video.mp4")
    check_sink_path("--video", tmp_path / "run" / "video.mp4", tmp_path / "run", "video.mp4")
