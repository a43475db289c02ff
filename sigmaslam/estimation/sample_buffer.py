"""The last samples of a sensor of motion, as they come."""

import logging
from collections import deque
from threading import RLock

import numpy as np

_LOGGER = logging.getLogger(__name__)

# Seconds of samples that are kept: twice what gravity is looked for in.
_KEPT = 20.0
# So many samples in a row that are not later than the last one, but each than the one before, are of a clock set back.
_SET_BACK = 20
# A rate that leaps by more from one sample to the next and back, rad/s and times the usual step, is no motion.
_LEAP, _UNUSUAL, _BACK = 0.5, 20.0, 0.25


class SampleBuffer:
    """Takes samples of two vectors as they come, by a clock that is `time_shift` seconds ahead of the camera's.

    They may come in another thread than that which uses them.
    """

    def __init__(self, time_shift: float) -> None:
        self.time_shift = time_shift
        self._turn = RLock()
        self._samples: deque[np.ndarray] = deque()
        self._late: deque[np.ndarray] = deque()  # in a row
        self._has_said = False
        self._table: np.ndarray | None = None  # of the samples, while they stay as they are

    def add(self, timestamp: float, turn: np.ndarray, other: np.ndarray) -> None:
        """Takes a sample: seconds of its clock, angular rate (3,) and what else is measured (3,)."""
        sample = np.concatenate(([timestamp], turn, other))
        with self._turn:
            if not self._samples or timestamp > self._samples[-1][0]:
                self._samples.append(sample)
                self._late.clear()
            else:
                if not self._has_said:
                    _LOGGER.warning("a sample at %.6f s is not later than the last one: left out", timestamp)
                self._has_said = True
                if self._late and timestamp <= self._late[-1][0]:
                    self._late.clear()
                self._late.append(sample)
                if len(self._late) < _SET_BACK:
                    return
                _LOGGER.warning("the samples' clock was set back to %.6f s: they count from there", timestamp)
                self._samples, self._late = self._late, deque()
            self._table = None
            self.forget(timestamp - _KEPT)

    def forget(self, before: float) -> None:
        """Samples before that time of the sensor's clock, but for the last of them, are needed no longer."""
        with self._turn:
            while len(self._samples) > 2 and self._samples[1][0] < before:
                self._samples.popleft()
                self._table = None

    def around(self, start: float, end: float) -> np.ndarray:
        """(N, 7) samples between two time stamps of the camera, with the last one before and the first one behind."""
        with self._turn:
            if self._table is None:
                self._table = _without_leaps(np.array(self._samples).reshape(-1, 7))
            t = self._table[:, 0]
            first = max(int(np.searchsorted(t, start + self.time_shift, "right")) - 1, 0)
            return self._table[first : int(np.searchsorted(t, end + self.time_shift)) + 1]


def _without_leaps(samples: np.ndarray) -> np.ndarray:
    """Samples (N, 7) whose rates leap and return at once, as a disturbed bus makes them, have the neighbours' mean."""
    rates = samples[:, 1:4]
    sizes, returned = (np.linalg.norm(rates[n:] - rates[:-n], axis=1) for n in (1, 2))
    if len(returned):
        leaps = np.minimum(sizes[:-1], sizes[1:])
        wrong = 1 + np.flatnonzero((leaps > max(_LEAP, _UNUSUAL * np.median(sizes))) & (returned < _BACK * leaps))
        rates[wrong] = 0.5 * (rates[wrong - 1] + rates[wrong + 1])
    return samples
