"""The keyframes of the window, and those that left it."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from sigmaslam.errors import InputError
from sigmaslam.estimation.acceptance import ACCEPTANCE
from sigmaslam.estimation.keyframe_window import KeyframeWindow
from sigmaslam.estimation.landmark_table import LandmarkViews
from sigmaslam.estimation.marginalised_poses import step_between
from sigmaslam.estimation.published_state import published_state, with_shown_errors
from sigmaslam.frontend import StereoView
from sigmaslam.frontend.image_sharpness import patch_energies
from sigmaslam.geometry.camera import RectifiedStereo
from sigmaslam.slam.appearance import AppearanceIndex
from sigmaslam.slam.hanging_keyframes import hang_over
from sigmaslam.slam.keyframe import HangingKeyframe, Keyframe, KnownKeyframe
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
# Poses that are remembered together; time and memory of their joint covariance grow with the square.
_REMEMBERED = 60
# What is as well known relative to many of them, as after a loop, hangs at a near one: by the drift of a good track.
_PER_METRE = 0.01


class Keyframes:
    """Keyframes with their poses: moves them from the window to the past, forgets the superfluous ones, makes the map.

    Args:
        window: owns the poses.
        max_keyframes: of those that left the window no more are known. Poses are remembered of the first sixty; the
            others hang at these.
        max_points: of the map; when there are twice as many, the least confirmed half goes.

    Attributes:
        active: keyframes of the window, in its order.
        remembered: keyframes that left it, in the order of its past.
        hanging: those without a pose in the past, by their numbers.
        appearance: of both, by their numbers.
    """

    def __init__(self, window: KeyframeWindow, max_keyframes: int, max_points: int) -> None:
        self._window = window
        self._most_remembered = min(max(max_keyframes, 1), _REMEMBERED)
        self._max_points = max_points
        self._next_id = self._first_id = 0
        self.active: list[Keyframe] = []
        self.remembered: list[Keyframe] = []
        self._most_hanging = max(max_keyframes, 1) - self._most_remembered
        self.hanging: dict[int, HangingKeyframe] = {}
        self.appearance = AppearanceIndex()

    def index(self, id: int) -> int:
        """Where a remembered keyframe stands in the past."""
        return next(k for k, keyframe in enumerate(self.remembered) if keyframe.id == id)

    def poses(self, keyframes: list[KnownKeyframe]) -> np.ndarray:
        """(K, 4, 4) T_world_keyframe of some, in the window or out of it."""
        place = {keyframe.id: index for index, keyframe in enumerate([*self.remembered, *self.active])}
        origin = np.array([place[keyframe.origin] for keyframe in keyframes], np.int64)
        steps = np.array([keyframe.step for keyframe in keyframes]).reshape(-1, 4, 4)
        state = self._window.posterior
        return np.asarray(np.concatenate([state.past.poses, state.poses])[origin] @ steps)

    def left_long_ago(self, count: int = 0) -> list[KnownKeyframe]:
        """Keyframes that left the window, but for the last `count`, by their numbers upwards."""
        recent = max(self._first_id, self.active[0].id - count) if self.active else self._next_id
        known: dict[int, KnownKeyframe] = {keyframe.id: keyframe for keyframe in self.remembered} | self.hanging
        return [known[id] for id in sorted(known) if id < recent]

    def append(
        self,
        view: StereoView,
        timestamp: float,
        blur: float = 1.0,
        landmarks: np.ndarray | slice = slice(None),
        spreads: tuple[np.ndarray, np.ndarray] | None = None,
    ) -> None:
        """Takes the newest keyframe of the window, with its blur and which of its features (K,) are landmarks.

        `spreads` are its `spread` and `drawn`: as the last keyframe is drawn unless given.
        """
        energies = np.zeros((len(view.features.keypoints), 2))
        energies[landmarks] = patch_energies(view.left, view.features.keypoints[landmarks])
        known = [*self.remembered, *self.active]
        spread, drawn = spreads or 2 * (known[-1].drawn if known else np.zeros((6, 6)),)
        self.active.append(Keyframe(self._next_id, timestamp, view, energies, blur, spread=spread, drawn=drawn))
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
        sharp = np.flatnonzero(blurs <= blurs[np.argsort(blurs, kind="stable")[:_COMPARED]].max())
        first = np.cumsum([0] + [len(keyframe.energies) for keyframe in self.active])[anchor[sharp]]
        energies = np.concatenate([keyframe.energies for keyframe in self.active])[first + feature[sharp]].sum(axis=0)
        here = patch_energies(left, seen.measurement[sharp, :2]).sum(axis=0)
        reference = here[0] * energies[1] * blurs[sharp].mean()
        # Where nothing varies there is nothing to compare.
        share = float(here[1] * energies[0] / reference) if reference > 0.0 else 1.0
        own = 1.0 if share >= ACCEPTANCE.sharpness else 1.0 / max(share, ACCEPTANCE.least_sharpness)
        return own, own + float(blurs.mean()) - 1.0

    def marginalise_oldest(self, spare: KnownKeyframe | None = None) -> np.ndarray:
        """Moves the oldest keyframe to the past, and its landmarks to the map.

        Args:
            spare: one whose pose must stay remembered, or that of the one that it hangs at.
        Returns:
            New row of each landmark, as of `KeyframeWindow.marginalise_oldest`.
        """
        self.active[0].measure_surfaces(self._window.landmarks, 0)
        points = anchor_points(self._window, 0, _times(self.active))
        points = points.shade(self.active[0].view.left, self.active[0].timestamp)
        new_row = self._window.marginalise_oldest()
        self._remember([self.active.pop(0).leave_window(points)], spare)
        return new_row

    def restart(self) -> None:
        """Forgets all keyframes and their poses, but not the calibration."""
        self._window.restart()
        self.active, self.remembered, self.hanging, self.appearance = [], [], {}, AppearanceIndex()
        self._first_id = self._next_id

    def map(self) -> PointMap:
        """All landmarks so far that were seen at least three times, in the world of the window."""
        for anchor, keyframe in enumerate(self.active):
            keyframe.measure_surfaces(self._window.landmarks, anchor)
        past = points_in_world([keyframe.points for keyframe in self.remembered], published_state(self._window).past)
        points = window_points(self._window, _times(self.active))
        for keyframe in self.active:
            points = points.shade(keyframe.view.left, keyframe.timestamp)
        return merge_maps([past, points])

    def load(self, path: Path, frontend: str, camera: RectifiedStereo) -> None:
        """Remembers the keyframes of a map, before there are others.

        Raises:
            InputError: the file is no map, or made with another front-end or camera, or there are others.
        """
        if self.remembered or self.active:
            raise InputError(f"{path}: a tracker takes one map, before its first keyframe: make another tracker")
        keyframes, past, hanging = read_keyframes(path, frontend, camera)
        self._window.restart(past)
        for each in hanging:
            self.hanging[each.id] = each
            self.appearance.add(each.id, each.descriptors)
        self._next_id = self._first_id = len(keyframes) + len(hanging)
        self._remember(keyframes)

    def pack(self, frontend: str, camera: RectifiedStereo) -> dict[str, Any]:
        """All of them as arrays by name, by which a later run finds its place in the map."""
        keyframes = [*self.remembered, *self.active]
        return pack_keyframes(
            keyframes, with_shown_errors(self._window).all_poses, frontend, camera, self.hanging.values()
        )

    def _remember(self, keyframes: list[Keyframe], spare: KnownKeyframe | None = None) -> None:
        """Takes keyframes of the window's past, and hangs superfluous ones at others, but not the one to spare."""
        self.remembered.extend(keyframes)
        for keyframe in keyframes:
            self.appearance.add(keyframe.id, keyframe.descriptors)
        if sum(len(each.points) for each in self.remembered) > 2 * self._max_points:
            kept = most_confirmed([each.points for each in self.remembered], self._max_points)
            self.remembered = [replace(each, points=points) for each, points in zip(self.remembered, kept, strict=True)]
        while len(self.remembered) > self._most_remembered:
            # Of the two that are closest to each other the later one.
            past = self._window.posterior.past
            earlier, leaving = closest_pair(past.poses[: len(self.remembered)])
            if spare is not None and self.remembered[leaving].id == spare.origin:
                leaving = earlier
            gone = self.remembered[leaving]
            if len(gone.points):
                index = past.closest(leaving)
                points = merge_maps(
                    [self.remembered[index].points, hand_over_points(gone.points, *step_between(past, index, leaving))]
                )
                self.remembered[index] = replace(self.remembered[index], points=points)
            index = past.closest(leaving, per_metre=_PER_METRE)
            heir = self.remembered[index].id
            for id in hang_over(self.hanging, self._most_hanging, gone, heir, *step_between(past, index, leaving)):
                self.appearance.remove(id)
            del self.remembered[leaving]
            self._window.forget_past(leaving)


def _times(keyframes: list[Keyframe]) -> np.ndarray:
    """(K,) time stamps, seconds."""
    return np.array([keyframe.timestamp for keyframe in keyframes])
