"""Poses of the camera over time."""

from dataclasses import dataclass, replace
from typing import Self

import numpy as np


@dataclass(frozen=True, slots=True)
class Trajectory:
    """Poses of the left camera over time.

    Attributes:
        timestamps: (N,) float64 seconds, strictly increasing.
        poses: (N, 4, 4) float64 T_world_camera, metres.
    """

    timestamps: np.ndarray
    poses: np.ndarray

    def __post_init__(self) -> None:
        timestamps = np.asarray(self.timestamps, dtype=np.float64)
        poses = np.asarray(self.poses, dtype=np.float64)
        if timestamps.ndim != 1 or poses.shape != (len(timestamps), 4, 4):
            raise ValueError(f"timestamps must be (N,) and poses (N, 4, 4); got {timestamps.shape} and {poses.shape}")
        object.__setattr__(self, "timestamps", timestamps)
        object.__setattr__(self, "poses", poses)

    def __len__(self) -> int:
        return len(self.timestamps)

    @property
    def positions(self) -> np.ndarray:
        """(N, 3) camera centres in the world, metres."""
        return self.poses[:, :3, 3]

    @property
    def rotations(self) -> np.ndarray:
        """(N, 3, 3) rotations that take camera axes to world axes."""
        return self.poses[:, :3, :3]

    @property
    def distances(self) -> np.ndarray:
        """(N,) metres travelled up to each pose, zero at the first."""
        steps = np.linalg.norm(np.diff(self.positions, axis=0), axis=1)
        return np.concatenate([np.zeros(min(1, len(self))), np.cumsum(steps)])

    @property
    def path_length(self) -> float:
        """Metres travelled from the first pose to the last."""
        return float(self.distances[-1]) if len(self) else 0.0

    def subset(self, index: np.ndarray) -> Self:
        """The poses at `index`, an index array, mask or slice."""
        return replace(self, timestamps=self.timestamps[index], poses=self.poses[index])
