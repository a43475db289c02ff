"""What speaks against a pose that images gave, and by how much it may be off."""

from dataclasses import dataclass, field
from enum import StrEnum

import numpy as np

from sigmaslam.geometry.se3 import se3_inverse, se3_log


class Doubt(StrEnum):
    """Reasons why a pose may be wrong; the words stand in frames.csv."""

    INPUT = "eyes do not fit"
    OFFSET = "offset too large"
    RIG = "rig changed"
    EYES = "eyes exchanged"
    APART = "eyes of two moments"
    TIME = "image of another time"
    MOTIONS = "two motions"
    FIXED = "fixed in the image"
    START = "shaken start"


@dataclass(slots=True)
class Doubts:
    """Of one pose.

    Attributes:
        reasons: each once, in the order in which they were found.
        spread: (6, 6) by what they make the image's pose less certain, perturbed from the left in the world.
        published: (6, 6) likewise, what is published alone: the pose at a doubtful time stamp, or by another offset.
        prediction_is_wrong: it was made less certain, so that the same matches give another pose.
        is_ambiguous: another pose explains the image about as well.
        spoils_keyframe: it is that, or nearer landmarks, which may move, draw the pose away from that of the others.
    """

    reasons: list[Doubt] = field(default_factory=list)
    spread: np.ndarray = field(default_factory=lambda: np.zeros((6, 6)))
    published: np.ndarray = field(default_factory=lambda: np.zeros((6, 6)))
    prediction_is_wrong: bool = False
    is_ambiguous: bool = False
    spoils_keyframe: bool = False

    def add(self, reason: Doubt, error: np.ndarray | None = None) -> None:
        """One more; `error` (6,) is how far off what is published is if it is right, as `spread` is perturbed."""
        if reason not in self.reasons:
            self.reasons.append(reason)
        if error is not None:
            self.published = self.published + np.outer(error, error)

    def add_motion(self, pose: np.ndarray, other: np.ndarray, covariance: float | np.ndarray = 0.0) -> None:
        """Two poses (4, 4), T_world_camera, explain the image about as well, `covariance` (6, 6) between them."""
        self.add(Doubt.MOTIONS)
        error = se3_log(pose @ se3_inverse(other))
        self.spread = self.spread + np.outer(error, error) + covariance
        self.is_ambiguous = self.spoils_keyframe = True

    @property
    def status(self) -> str:
        """Of a frame with such a pose."""
        return "ambiguous" if self.is_ambiguous else "doubtful" if self.reasons else "tracking"
