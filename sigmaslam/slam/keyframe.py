"""One keyframe: what it saw, and what became of it."""

from dataclasses import dataclass, field, replace
from typing import Self

import numpy as np

from sigmaslam.estimation.landmark_table import LandmarkTable
from sigmaslam.frontend import StereoView
from sigmaslam.frontend.patch_disparity_range import patch_disparity_range
from sigmaslam.geometry.se3 import se3_inverse, turn_covariance
from sigmaslam.slam.packed_view import PackedView
from sigmaslam.slam.point_map import MIN_VIEWS, PointMap
from sigmaslam.two_view.stereo_pose import RelativePose


@dataclass(frozen=True, slots=True)
class Keyframe:
    """A view that is kept; its pose is in the window's state, or among the poses that left the window.

    Attributes:
        id: number that no other keyframe of the tracker has.
        timestamp: seconds.
        view: what it saw; the right image is given up with the window.
        energies: (N, 2) of patches as of `patch_energies`, of the features that became landmarks; none once it has left
            the window.
        blur: of its image, as of `Keyframes.blur`.
        points: landmarks that it was the anchor of, in its frame, once it has left the window.
        spread: (6, 6) by which its pose is less certain than its views say, perturbed from the left in the world.
        drawn: (6, 6) likewise, by what moved, here or where keyframes were made that its pose rests on.
    """

    id: int
    timestamp: float
    view: StereoView
    energies: np.ndarray = field(default_factory=lambda: np.zeros((0, 2)))
    blur: float = 1.0
    points: PointMap = field(default_factory=PointMap.empty)
    spread: np.ndarray = field(default_factory=lambda: np.zeros((6, 6)))
    drawn: np.ndarray = field(default_factory=lambda: np.zeros((6, 6)))

    # As of `HangingKeyframe`: it hangs at itself.
    step, covariance = np.eye(4), np.zeros((6, 6))

    @property
    def origin(self) -> int:
        """Its own number."""
        return self.id

    @property
    def descriptors(self) -> np.ndarray:
        """(N, D) of its features."""
        return self.view.features.descriptors

    def leave_window(self, points: PointMap) -> Self:
        """The keyframe as it is remembered, with the points (in its frame) that leave with it."""
        view = replace(self.view, right=np.zeros((0, 0), np.uint8), small=(), usable=None)
        return replace(self, view=view, energies=np.zeros((0, 2)), points=points)

    def measure_surfaces(self, landmarks: LandmarkTable, anchor: int) -> None:
        """Notes how much surfaces vary around landmarks of this keyframe, number `anchor`, that are in the map."""
        if self.view.slope is None:
            return
        rows = (landmarks.anchor == anchor) & (landmarks.views >= MIN_VIEWS)
        index = landmarks.feature[rows]
        patches = self.view.measured(index), self.view.slope[index]
        landmarks.disparity_range[rows] = patch_disparity_range(self.view.left, self.view.right, *patches)


@dataclass(frozen=True, slots=True)
class HangingKeyframe:
    """A keyframe without a pose of its own in the past: it hangs at a neighbour whose pose is remembered.

    Attributes:
        id, timestamp: as of `Keyframe`.
        packed: what it saw.
        origin: number of the neighbour.
        step: (4, 4) T_origin_keyframe.
        covariance: (6, 6) of that, perturbed from the left, as independent of all else.
    """

    id: int
    timestamp: float
    packed: PackedView
    origin: int
    step: np.ndarray
    covariance: np.ndarray

    @property
    def view(self) -> StereoView:
        """What it saw, unpacked."""
        return self.packed.unpack()

    @property
    def descriptors(self) -> np.ndarray:
        """(N, D) of its features."""
        return self.packed.descriptors

    def handed_over(self, heir: int, T_heir_origin: np.ndarray, covariance: np.ndarray) -> Self:
        """The keyframe at another neighbour; covariance: (6, 6) of the step to it, perturbed from the left there."""
        pose = T_heir_origin @ self.step
        own = turn_covariance(T_heir_origin, self.covariance)
        return replace(self, origin=heir, step=pose, covariance=covariance + own)


KnownKeyframe = Keyframe | HangingKeyframe
"""One that left the window."""


def from_origin(keyframe: KnownKeyframe, relative: RelativePose) -> RelativePose:
    """A pose relative to a keyframe, as it is relative to the one whose pose is remembered."""
    pose = keyframe.step @ relative.T_key_camera
    own = turn_covariance(se3_inverse(pose), keyframe.covariance)
    return replace(relative, T_key_camera=pose, covariance=relative.covariance + own)
