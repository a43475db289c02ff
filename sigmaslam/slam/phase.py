"""What a tracker has come to know so far."""

from enum import Enum, auto
from math import inf

import numpy as np


class Phase(Enum):
    """A tracker that is lost stays in its phase."""

    WAITING = auto()  # no keyframe yet
    WAITING_IN_MAP = auto()  # no keyframe yet, and the world is a map's
    STARTING = auto()  # a keyframe, but no pose from images yet
    TRACKING = auto()  # poses and a velocity
    RESUMED = auto()  # there have been poses, but the velocity since the last one is unknown


class Course:
    """The phase of a tracker, and when it came to it.

    Attributes:
        timestamp: of the last frame, seconds; None before the first.
        waiting_since: time stamp of the first view that could be a keyframe, blurred or not, seconds.
        started_at, tracked_at: time stamps of the first keyframe and of the last pose.
        found: pose (4, 4) of the last view that was found by a keyframe, T_world_camera, and its time stamp, seconds.
        is_shaken: motion blurred an image before the first keyframe, or soon after it.
        is_shifted: the last pair showed a bump, and was skipped: that stays, an image gone wrong is one alone.
    """

    def __init__(self) -> None:
        self.phase = Phase.WAITING
        self.timestamp: float | None = None
        self.waiting_since, self.is_shifted, self.is_shaken = inf, False, False
        self.started_at, self.tracked_at = -inf, 0.0
        self.found = np.eye(4), -inf

    def start(self, timestamp: float) -> None:
        """There is a first keyframe."""
        self.phase, self.started_at, self.tracked_at = Phase.STARTING, timestamp, timestamp

    def track(self, timestamp: float) -> None:
        """There is a pose from images."""
        self.phase, self.tracked_at = Phase.TRACKING, timestamp

    def resume(self, timestamp: float) -> None:
        """There is a new keyframe, but no velocity."""
        self.phase, self.tracked_at = Phase.RESUMED, timestamp

    @property
    def has_moved(self) -> bool:
        """There have been poses from images."""
        return self.phase in (Phase.TRACKING, Phase.RESUMED)

    @property
    def is_waiting(self) -> bool:
        """There is no keyframe yet."""
        return self.phase in (Phase.WAITING, Phase.WAITING_IN_MAP)
