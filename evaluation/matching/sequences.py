"""Pairs from stereo sequences: rows of the rectified eyes, and motion from frame to frame."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np

from sigmaslam.evaluation.matching.pairs import ImagePair, Motion, SameRows, resize
from sigmaslam.readers import StereoSequence, open_sequence
from sigmaslam.rectify import StereoRectifier
from sigmaslam.rotation import se3_inverse
from sigmaslam.trajectory import read_trajectory

_KITTI_STEP = 6


def kitti(folder: Path) -> list[ImagePair]:
    """Every sixth frame: its two eyes, and its left image with those 1 and 3 frames later (parts gap1 and gap3)."""
    return sequence_pairs(open_sequence(folder), folder / "poses.txt", _KITTI_STEP, {1: "gap1", 3: "gap3"})


def euroc(folder: Path) -> list[ImagePair]:
    """Every keyframe: its two eyes rectified, and its left image with the next one (part next)."""
    return sequence_pairs(open_sequence(folder), folder / "groundtruth.csv", 1, {1: "next"})


def sequence_pairs(sequence: StereoSequence, truth: Path, step: int, gaps: Mapping[int, str]) -> list[ImagePair]:
    """Stereo and temporal pairs of a sequence.

    Args:
        sequence: images as stored; they are rectified here.
        truth: trajectory of the left camera, any format.
        step: every so many frames pairs begin.
        gaps: by frames between the two images of a temporal pair, the name of its part.
    """
    rectifier = StereoRectifier(sequence.camera)
    view = rectifier.rectified
    T_camera_rectified = np.eye(4)
    T_camera_rectified[:3, :3] = rectifier.R_rectified_left.T
    trajectory = read_trajectory(truth)
    lefts, poses, pairs = {}, {}, []
    K = np.eye(3)
    for frame in sequence.frames():
        if not any((frame.index - gap) % step == 0 for gap in (0, *gaps)):
            continue
        left, right = rectifier.rectify(frame.left, frame.right)
        lefts[frame.index], S = resize(left)
        K = S @ view.matrix
        nearest = np.abs(trajectory.timestamps - frame.timestamp).argmin()
        poses[frame.index] = trajectory.poses[nearest] @ T_camera_rectified
        if frame.index % step == 0:
            pairs.append(ImagePair(f"{frame.index} stereo", lefts[frame.index], resize(right)[0], SameRows()))
    for gap, part in gaps.items():
        for first in lefts:
            second = first + gap
            if first % step == 0 and second in lefts:
                motion = Motion(K, se3_inverse(poses[second]) @ poses[first])
                pairs.append(ImagePair(f"{first} {second}", lefts[first], lefts[second], motion, part))
    return pairs
