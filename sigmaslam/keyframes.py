"""What is kept of keyframes beside their poses: images and features, the map, and those that left the window."""

from __future__ import annotations

from collections import deque
from pathlib import Path
from typing import Any

import numpy as np

from sigmaslam.camera import RectifiedStereo
from sigmaslam.frontend import StereoView
from sigmaslam.frontend.smooth import sharpness
from sigmaslam.landmarks import PointMap, RetiredPoints, host_points, map_points, merge_maps
from sigmaslam.past import PastPoses
from sigmaslam.recall import KeyframeMemory, RememberedKeyframe, pack_keyframes, read_keyframes
from sigmaslam.rotation import se3_body, se3_inverse
from sigmaslam.tables import CALIBRATION_SIZE, pose_slice
from sigmaslam.window import KeyframeWindow

# A loop is looked for beyond so many remembered keyframes, among those that look less than 60 degrees away.
_RECENT, _LOOP_COSINE = 10, 0.5

# A view less sharp by this factor than the sharpest of the keyframes is blurred: in drives 0.9 to 1.1 are common from
# frame to frame and 0.8 half a second later; motion blur over 11 px gives 0.6 to 0.75.
_BLUNT = 0.75


class Keyframes:
    """The keyframes of a window, in its order, and those that left it, in the order of its past.

    Args:
        window: owns the poses; keyframes leave it here.
        remembered: keyframes that are kept to find the way back to.
        most_points: of the map (`RetiredPoints`).

    Attributes:
        views, times: of those in the window; time stamps in seconds.
        memory: those that left it.
    """

    def __init__(self, window: KeyframeWindow, remembered: int, most_points: int) -> None:
        self._window = window
        self._most_points = most_points
        self.views: list[StereoView] = []
        self.times: list[float] = []
        self.memory = KeyframeMemory(remembered)
        self._sharpness: list[float] = []
        self._retired = RetiredPoints(most_points)
        self._recent: deque[float] = deque(maxlen=_RECENT)  # time stamps of the last that left the window

    def append(self, view: StereoView, timestamp: float) -> None:
        """The newest keyframe of the window."""
        self.views.append(view)
        self.times.append(timestamp)
        self._sharpness.append(sharpness(view.left))

    def blur(self, view: StereoView) -> float:
        """How many times as sharp as the view the sharpest keyframe is; 1 where that may be what is seen."""
        own, sharpest = sharpness(view.left), max(self._sharpness)
        return sharpest / max(own, 0.1 * sharpest) if own < _BLUNT * sharpest else 1.0

    def retire_oldest(self, spare: float | None = None) -> np.ndarray:
        """The oldest one leaves the window for the memory, its landmarks for the map.

        Args:
            spare: time stamp of one that the memory must not drop for it.
        Returns:
            New row of each landmark, as of `KeyframeWindow.retire_oldest`.
        """
        keyframe = self._remembered(0)
        self._retired.append(host_points(self._window, 0, np.array(self.times)))
        number = self._window.retire_oldest()
        del self.views[0], self.times[0], self._sharpness[0]
        self._memorise(keyframe, spare)
        self._recent.append(keyframe.timestamp)
        return number

    def restart(self) -> None:
        """As before the first one, the window too, but for what is known of the calibration."""
        self._window.restart()
        self.views, self.times, self._sharpness = [], [], []
        self._retired = RetiredPoints(self._most_points)
        self.memory.keyframes.clear()
        self._recent.clear()

    def revisited(self) -> list[RememberedKeyframe]:
        """Those that left the window long ago and should see what its newest one sees."""
        window = self._window
        pose, place = window.poses[-1], pose_slice(len(window) - 1)
        reach = window.depth + 3.0 * np.sqrt(np.trace(se3_body(pose, window.covariance[place, place])[:3, :3]))

        def near(keyframe: RememberedKeyframe) -> bool:
            between = se3_inverse(pose) @ keyframe.pose
            return bool(np.linalg.norm(between[:3, 3]) < reach and between[2, 2] > _LOOP_COSINE)

        return [each for each in self.memory.keyframes if each.timestamp not in self._recent and near(each)]

    def map(self) -> PointMap:
        """All landmarks so far that were seen at least three times, in the world of the window."""
        whole = np.ones(len(self._window.landmarks), bool)
        late = map_points(self._window, whole, np.array(self.times))
        return merge_maps([self._retired.in_world(self._window.past), late])

    def load(self, path: Path, frontend: str, camera: RectifiedStereo) -> None:
        """Remembers the keyframes of a map, before there are others.

        Raises:
            InputError: the file is no map, or made with another front-end or camera.
        """
        keyframes, joint = read_keyframes(path, frontend, camera)
        poses = np.array([keyframe.pose for keyframe in keyframes])
        self._window.load_past(PastPoses(poses, joint, np.zeros((len(joint), CALIBRATION_SIZE))))
        for _ in keyframes:
            self._retired.append(PointMap.empty())
        for keyframe in keyframes:
            self._memorise(keyframe)

    def pack(self, frontend: str, camera: RectifiedStereo) -> dict[str, Any]:
        """All of them as arrays by name, by which a later run finds its place in the map."""
        window = self._window
        late = [self._remembered(k) for k in range(len(window))]
        past = window.past
        for k, pose in enumerate(window.poses):
            past = past.append(pose, window.covariance, pose_slice(k))
        return pack_keyframes([*self.memory.keyframes, *late], past.covariance, frontend, camera)

    def _memorise(self, keyframe: RememberedKeyframe, spare: float | None = None) -> None:
        """Remembers a keyframe of the window's past; another, not that of the time stamp `spare`, may go for it."""
        dropped = self.memory.add(keyframe, spare)
        if dropped is not None:
            self._retired.drop(dropped, self._window.past)
            self._window.forget_past(dropped)

    def _remembered(self, host: int) -> RememberedKeyframe:
        """A keyframe of the window as the memory keeps it."""
        place = pose_slice(host)
        window = self._window
        return RememberedKeyframe(
            self.views[host], window.poses[host], window.covariance[place, place], self.times[host]
        )
