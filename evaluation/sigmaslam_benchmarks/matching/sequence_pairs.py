"""Pairs from stereo sequences: rows of the rectified eyes, and motion from frame to frame."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from sigmaslam.geometry.camera import RectifiedStereo
from sigmaslam.geometry.rectification import StereoRectifier
from sigmaslam.geometry.se3 import se3_inverse
from sigmaslam.readers import StereoSequence, open_sequence
from sigmaslam.readers.trajectory_files import read_trajectory
from sigmaslam_benchmarks.matching.image_pairs import ImagePair, Motion, SameRows, resize
from sigmaslam_benchmarks.matching.stereo import StereoStep

_KITTI_STEP = 6


def kitti(folder: Path) -> list[ImagePair]:
    """Every sixth frame: its two eyes, and its left image with those 1 and 3 frames later (parts gap1 and gap3)."""
    return sequence_pairs(open_sequence(folder), folder / "poses.txt", _KITTI_STEP, {1: "gap1", 3: "gap3"})


def euroc(folder: Path) -> list[ImagePair]:
    """Every keyframe: its two eyes rectified, and its left image with the next one (part next)."""
    return sequence_pairs(open_sequence(folder), folder / "groundtruth.csv", 1, {1: "next"})


def kitti_steps(folder: Path, gap: int) -> list[StereoStep]:
    """From every sixth frame to the one so many frames later."""
    return sequence_steps(open_sequence(folder), folder / "poses.txt", _KITTI_STEP, gap)


def euroc_steps(folder: Path) -> list[StereoStep]:
    """From every keyframe to the next."""
    return sequence_steps(open_sequence(folder), folder / "groundtruth.csv")


def sequence_pairs(sequence: StereoSequence, truth: Path, step: int, gaps: Mapping[int, str]) -> list[ImagePair]:
    """Stereo and temporal pairs of a sequence.

    Args:
        sequence: images as stored; they are rectified here.
        truth: trajectory of the left camera, any format.
        step: every so many frames pairs begin.
        gaps: by frames between the two images of a temporal pair, the name of its part.
    """
    views = {
        view.index: view
        for view in views_of(sequence, truth)
        if any((view.index - gap) % step == 0 for gap in (0, *gaps))
    }
    begins = [index for index in views if index % step == 0]
    pairs = [ImagePair(f"{index} stereo", views[index].left, views[index].right, SameRows()) for index in begins]
    for gap, part in gaps.items():
        for first, second in ((views[index], views[index + gap]) for index in begins if index + gap in views):
            motion = Motion(first.camera.matrix, se3_inverse(second.T_world_camera) @ first.T_world_camera)
            pairs.append(ImagePair(f"{first.index} {second.index}", first.left, second.left, motion, part))
    return pairs


def sequence_steps(sequence: StereoSequence, truth: Path, step: int = 1, gap: int = 1) -> list[StereoStep]:
    """Steps from frames to later ones.

    Args:
        sequence: images as stored; they are rectified here.
        truth: trajectory of the left camera, any format.
        step: every so many frames one begins.
        gap: frames from one to the other.
    """
    views = {view.index: view for view in views_of(sequence, truth) if view.index % step in (0, gap % step)}
    pairs = [(view, views[index + gap]) for index, view in views.items() if index % step == 0 and index + gap in views]
    return [
        StereoStep(
            f"{first.index} {second.index}",
            first.left,
            first.right,
            second.left,
            first.camera,
            se3_inverse(second.T_world_camera) @ first.T_world_camera,
        )
        for first, second in pairs
    ]


@dataclass(frozen=True, slots=True)
class _View:
    """A stereo pair, rectified and resized, with its camera and the true pose of the left eye."""

    index: int
    left: np.ndarray
    right: np.ndarray
    camera: RectifiedStereo
    T_world_camera: np.ndarray


def views_of(sequence: StereoSequence, truth: Path) -> Iterator[_View]:
    """The frames of a sequence with the poses of a trajectory file."""
    rectifier = StereoRectifier(sequence.camera)
    T_camera_rectified = np.eye(4)
    T_camera_rectified[:3, :3] = rectifier.R_rectified_left.T
    trajectory = read_trajectory(truth)
    for frame in sequence.frames():
        left, right = rectifier.rectify(frame.left, frame.right)
        (small_left, S), (small_right, _) = resize(left), resize(right)
        K = S @ rectifier.rectified.matrix
        height, width = small_left.shape
        camera = RectifiedStereo(
            K[0, 0], K[1, 1], K[0, 2], K[1, 2], rectifier.rectified.baseline, width=width, height=height
        )
        nearest = np.abs(trajectory.timestamps - frame.timestamp).argmin()
        pose = trajectory.poses[nearest] @ T_camera_rectified
        yield _View(frame.index, small_left, small_right, camera, pose)
