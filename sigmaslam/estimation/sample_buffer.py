"""The last samples of a sensor of motion, as they come."""

import logging
from collections import deque

import numpy as np

_LOGGER = logging.getLogger(__name__)

# Seconds of samples that are kept: twice what gravity is looked for in.
_KEPT = 20.0


class SampleBuffer:
    """Takes samples of two vectors as they come, by a clock that is `time_shift` seconds ahead of the camera's."""

    def __init__(self, time_shift: float) -> None:
        self.time_shift = time_shift
        self.late = 0
        """Samples that were left out, as they were not later than the one before."""
        self._samples: deque[np.ndarray] = deque()
        self._table: np.ndarray | None = None  # of the samples, while they stay as they are

    def add(self, timestamp: float, turn: np.ndarray, other: np.ndarray) -> None:
        """Takes a sample: seconds of its clock, angular rate (3,) and what else is measured (3,)."""
        if self._samples and timestamp <= self._samples[-1][0]:
            if not self.late:
                _LOGGER.warning("a sample at %.6f s is not later than the last one: left out", timestamp)
            self.late += 1
            return
        self._samples.append(np.concatenate(([timestamp], turn, other)))
        self._table = None
        self.forget(timestamp - _KEPT)

    def forget(self, before: float) -> None:
        """Samples before that time of the sensor's clock, but for the last of them, are needed no longer."""
        while len(self._samples) > 2 and self._samples[1][0] < before:
            self._samples.popleft()
            self._table = None

    def around(self, start: float, end: float) -> np.ndarray:
        """(N, 7) samples between two time stamps of the camera, with the last one before and the first one behind."""
        if self._table is None:
            self._table = np.array(self._samples).reshape(-1, 7)
        t = self._table[:, 0]
        first = max(int(np.searchsorted(t, start + self.time_shift, "right")) - 1, 0)
        return self._table[first : int(np.searchsorted(t, end + self.time_shift)) + 1]
