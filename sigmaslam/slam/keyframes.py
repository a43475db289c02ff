"""The keyframes of the window, and those that left it."""

from __future__ import annotations

from concurrent.futures import Executor
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from sigmaslam.estimation.acceptance import ACCEPTANCE
from sigmaslam.estimation.keyframe_window import KeyframeWindow
from sigmaslam.estimation.landmark_table import LandmarkViews
from sigmaslam.frontend import StereoView
from sigmaslam.frontend.image_sharpness import patch_energies
from sigmaslam.frontend.patch_disparity_range import dense_disparity
from sigmaslam.geometry.camera import RectifiedStereo
from sigmaslam.slam.deferred import Deferred
from sigmaslam.slam.keyframe import Keyframe
from sigmaslam.slam.map_file import pack_keyframes, read_keyframes
from sigmaslam.slam.place_recognition import closest_pair
from sigmaslam.slam.point_map import (
    PointMap,
    anchor_points,
    hand_over_points,
    merge_maps,
    most_confirmed,
    points_in_world,
    window_points,
)

# Patches that are compared for blur: in the mean of so many what single ones show of the scene evens out.
_COMPARED = 30


class Keyframes:
    """Keyframes with their poses: moves them from the window to the past, forgets the superfluous ones, makes the map.

    Args:
        window: owns the poses.
        max_keyframes: more than so many that left the window are not remembered.
        max_points: of the map; when there are twice as many, the least confirmed half goes.
        executor: makes what only the map needs beside the tracking, if there is one.

    Attributes:
        active: keyframes of the window, in its order.
        remembered: keyframes that left it, in the order of its past.
    """

    def __init__(
        self, window: KeyframeWindow, max_keyframes: int, max_points: int, executor: Executor | None = None
    ) -> None:
        self._window = window
        self._executor = executor
        self._max_keyframes = max(max_keyframes, 1)
        self._max_points = max_points
        self._next_id = self._first_id = 0
        self.active: list[Keyframe] = []
        self.remembered: list[Keyframe] = []

    def index(self, id: int) -> int:
        """Where a remembered keyframe stands in the past."""
        return next(k for k, keyframe in enumerate(self.remembered) if keyframe.id == id)

    def pose(self, keyframe: Keyframe) -> np.ndarray:
        """(4, 4) T_world_keyframe of a remembered one."""
        return np.asarray(self._window.posterior.past.poses[self.index(keyframe.id)])

    def left_long_ago(self, count: int) -> list[Keyframe]:
        """Remembered keyframes but for the last `count` that left the window."""
        recent = max(self._first_id, self.active[0].id - count)
        return [keyframe for keyframe in self.remembered if keyframe.id < recent]

    def append(
        self, view: StereoView, timestamp: float, blur: float = 1.0, landmarks: np.ndarray | slice = slice(None)
    ) -> None:
        """Takes the newest keyframe of the window, with its blur and which of its features (K,) are landmarks."""
        dense = Deferred(lambda: dense_disparity(view))
        if self._executor is not None:
            dense.begin(self._executor)
        energies = np.zeros((len(view.features.keypoints), 2))
        energies[landmarks] = patch_energies(view.left, view.features.keypoints[landmarks])
        self.active.append(Keyframe(self._next_id, timestamp, view, energies, blur, dense))
        self._next_id += 1

    def blur(self, left: np.ndarray, seen: LandmarkViews) -> tuple[float, float]:
        """By how much blur makes places in an image less certain, and by how much its matches; 1 where sharp.

        The first is how many times as sharp as the image the keyframes saw the same landmarks, where chance is not
        the reason. A match has the errors of both images.

        Args:
            left: (H, W) uint8.
            seen: landmarks of the window in it.
        """
        landmarks = self._window.landmarks
        anchor, feature = landmarks.anchor[seen.landmark], landmarks.feature[seen.landmark]
        blurs = np.array([keyframe.blur for keyframe in self.active])[anchor]
        # Compared with the sharpest keyframes that share enough with the image.
        by_sharpness = np.argsort(blurs, kind="stable")
        sharp = np.flatnonzero(blurs <= blurs[by_sharpness[:_COMPARED]].max())
        energies = np.array([self.active[anchor[k]].energies[feature[k]] for k in sharp]).sum(axis=0)
        here = patch_energies(left, seen.measurement[sharp, :2]).sum(axis=0)
        reference = here[0] * energies[1] * blurs[sharp].mean()
        # Where nothing varies there is nothing to compare.
        share = float(here[1] * energies[0] / reference) if reference > 0.0 else 1.0
        own = 1.0 if share >= ACCEPTANCE.sharpness else 1.0 / max(share, ACCEPTANCE.least_sharpness)
        return own, own + float(blurs.mean()) - 1.0

    def marginalise_oldest(self, spare: Keyframe | None = None) -> np.ndarray:
        """Moves the oldest keyframe to the past, and its landmarks to the map.

        Args:
            spare: a remembered one that must not be forgotten for it.
        Returns:
            New row of each landmark, as of `KeyframeWindow.marginalise_oldest`.
        """
        self.active[0].measure_surfaces(self._window.landmarks, 0)
        points = anchor_points(self._window, 0, _times(self.active))
        points = points.shade(self.active[0].view.left, self.active[0].timestamp)
        new_row = self._window.marginalise_oldest()
        self._remember(self.active.pop(0).leave_window(points), spare)
        return new_row

    def restart(self) -> None:
        """Forgets all keyframes and their poses, but not the calibration."""
        self._window.restart()
        self.active, self.remembered = [], []
        self._first_id = self._next_id

    def map(self) -> PointMap:
        """All landmarks so far that were seen at least three times, in the world of the window."""
        for anchor, keyframe in enumerate(self.active):
            keyframe.measure_surfaces(self._window.landmarks, anchor)
        past = points_in_world([keyframe.points for keyframe in self.remembered], self._window.posterior.past)
        points = window_points(self._window, _times(self.active))
        for keyframe in self.active:
            points = points.shade(keyframe.view.left, keyframe.timestamp)
        return merge_maps([past, points])

    def load(self, path: Path, frontend: str, camera: RectifiedStereo) -> None:
        """Remembers the keyframes of a map, before there are others.

        Raises:
            InputError: the file is no map, or made with another front-end or camera.
        """
        keyframes, past = read_keyframes(path, frontend, camera)
        self._window.restart(past)
        for keyframe in keyframes:
            self._remember(keyframe)
        self._next_id = self._first_id = len(keyframes)

    def pack(self, frontend: str, camera: RectifiedStereo) -> dict[str, Any]:
        """All of them as arrays by name, by which a later run finds its place in the map."""
        return pack_keyframes([*self.remembered, *self.active], self._window.posterior.all_poses, frontend, camera)

    def _remember(self, keyframe: Keyframe, spare: Keyframe | None = None) -> None:
        """Takes a keyframe of the window's past, and forgets a superfluous one for it, but not the one to spare."""
        self.remembered.append(keyframe)
        if sum(len(each.points) for each in self.remembered) > 2 * self._max_points:
            kept = most_confirmed([each.points for each in self.remembered], self._max_points)
            self.remembered = [replace(each, points=points) for each, points in zip(self.remembered, kept, strict=True)]
        if len(self.remembered) <= self._max_keyframes:
            return
        # Of the two that are closest to each other the later one.
        past = self._window.posterior.past
        earlier, leaving = closest_pair(past.poses[: len(self.remembered)])
        if spare is not None and self.remembered[leaving].id == spare.id:
            leaving = earlier
        if len(self.remembered[leaving].points):
            heir = past.closest(leaving)
            points = hand_over_points(self.remembered[leaving].points, past, leaving, heir)
            inherited = merge_maps([self.remembered[heir].points, points])
            self.remembered[heir] = replace(self.remembered[heir], points=inherited)
        del self.remembered[leaving]
        self._window.forget_past(leaving)


def _times(keyframes: list[Keyframe]) -> np.ndarray:
    """(K,) time stamps, seconds."""
    return np.array([keyframe.timestamp for keyframe in keyframes])
