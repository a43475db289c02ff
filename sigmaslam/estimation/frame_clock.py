"""When frames were taken: time stamps are an observation of a clock, and their noise is in their intervals."""

from collections import deque
from collections.abc import Sequence, Sized
from statistics import median

import numpy as np

# Intervals that are remembered, and so many must be there before they are judged: a moment needs a few.
_REMEMBERED, _LEAST = 20, 4
# One long interval beside so many others is a pause; beside fewer, or another long one, it may end a burst of five.
_REGULAR = 9
# Share of the mean interval up to which stamps are believed as they are: recordings that a sensor has stamped stay
# below 0.02, and the motion's own noise covers more than this.
_BELIEVED = 0.05
# Intervals of up to so many frames are drops of a regular camera; a longer one alone is a pause. Stamps that alternate
# by two fifths of an interval are nine times as far apart as they are close.
_MOST_DROPPED = 4
# Share of the intervals' variance that successive ones have in common, with the opposite sign: none where frames are
# dropped, half for noise of stamps; above it long and short ones take turns, and no drops do that.
_TAKES_TURNS = 0.75
# Seconds. A slower camera's frames were chosen, and a host is late by less; the motion in between is unknown anyway.
_SLOWEST = 0.5
# Times the usual interval, from which on frames may be missing or the clock have been set or wrong; flow tells less.
_SET = 2.5
# Of the mean interval: cameras are as regular, whatever their stamps. With more near landmarks are not searched for.
_IRREGULAR = 0.25
# Seconds: after a pause predictions are not extrapolated any further, as variances that grow with t^3 drown all else.
_LONGEST = 20.0
# Of the mean interval: no two frames of a camera are closer.
_LEAST_STEP = 0.1


def stamp_noise(intervals: Sequence[float] | np.ndarray) -> float:
    """Standard deviation of time stamps, seconds: zero where they can be believed.

    The noise of a stamp lengthens one interval and shortens the next one: its variance is the negative covariance of
    successive intervals, of a camera whose own intervals are independent of each other (a moving average of order 1).

    Args:
        intervals: seconds between successive stamps, in order.
    """
    steps = np.asarray(intervals, float)
    if len(steps) and np.ptp(steps) <= _BELIEVED * steps.mean():
        return 0.0  # no noise is larger than the range
    others = np.delete(steps, np.argmax(steps)) if len(steps) else steps
    if len(others) >= _REGULAR and steps.max() > 3.0 * np.median(steps) >= others.max():
        steps = others
    if len(steps) < _LEAST or np.median(steps) > _SLOWEST:
        return 0.0
    departure = steps - steps.mean()
    variance = -float(np.sum(departure[1:] * departure[:-1])) / len(steps)
    if variance < _TAKES_TURNS * departure.var() and _are_multiples(steps):
        return 0.0
    sigma = float(np.sqrt(max(variance, 0.0)))
    return sigma if sigma > _BELIEVED * steps.mean() else 0.0


def missing_frames(intervals: np.ndarray) -> int:
    """How many frames of a regular camera are missing between stamps that can be believed, as of `stamp_noise`.

    Of a long interval those of 20 s at most; none of three or more alike in a row, which are another rate.
    """
    usual = float(np.median(intervals)) if len(intervals) and np.isfinite(intervals).all() else np.inf
    if not 0.0 < usual <= _SLOWEST or stamp_noise(intervals) > 0.0:
        return 0
    steps = np.pad(np.minimum(intervals, _LONGEST), 1)
    is_alone = np.maximum(np.abs(steps[1:-1] - steps[:-2]), np.abs(steps[1:-1] - steps[2:])) > _IRREGULAR * usual
    return int(np.sum(np.maximum(np.round(steps[1:-1] / usual) - 1.0, 0.0)[is_alone]))


class FrameClock:
    """Tells how long it is since the last frame, and how well that is known.

    A Kalman filter of the frame's time: it moves on by the mean interval, with the variance that intervals have beside
    the noise of stamps, by which a stamp is measured. Stamps that can be believed are taken to the bit.

    Args:
        sensors: of motion; without them the velocity alone predicts.

    Attributes:
        late: seconds by which the last interval is longer than usual, if the clock may have been set in it, or 0.
        was_blind: the frame before showed nothing; to be set by who sees it.
    """

    def __init__(self, sensors: Sized = ()) -> None:
        self._longest = np.inf if sensors else _LONGEST
        self._intervals: deque[float] = deque(maxlen=_REMEMBERED)
        self._is_believed, self._seconds, self.late, self.was_blind = True, 0.0, 0.0, False

    @property
    def interval(self) -> float:
        """Mean of the last ones, seconds; 0 before the first."""
        return float(np.mean(self._intervals)) if self._intervals else 0.0

    @property
    def after_gap(self) -> bool:
        """Nothing was seen for longer than usual."""
        return self.late > 0.0 or self.was_blind

    @property
    def differs(self) -> bool:
        """The last interval is unlike the one before: the velocity, or how far it leads, may be wrong by the ratio."""
        last = [*self._intervals][-2:]
        return len(last) == 2 and bool(np.ptp(last) > _IRREGULAR * np.mean(last))

    @property
    def is_slow(self) -> bool:
        """The last interval is one of frames that were chosen."""
        return bool(self._intervals) and self._intervals[-1] > _SLOWEST

    def tick(self, interval: float) -> tuple[float, float, float]:
        """Takes the interval between two stamps, seconds.

        Returns:
            The time between the two frames, its standard deviation, seconds, and by what velocities are too large that
            were learned by a wrong interval, or 1.
        """
        before, interval = [*self._intervals], min(interval, self._longest)
        self._intervals.append(interval)
        seconds, sigma = self._estimate(np.array(self._intervals))
        # Of bursts the longest interval is the usual one: they end in such, one like the other.
        usual = float(max(before) if sigma > 0.0 else median(before)) if len(before) >= _LEAST else np.inf
        self.late = interval - usual if _SET * usual < interval and usual <= _SLOWEST else 0.0
        is_other = sigma > 0.0 and (self._is_believed or self.interval > _SET * self._seconds)
        stretch = self.interval / self._seconds if is_other else 1.0
        self._seconds, self._is_believed = seconds, sigma == 0.0
        return seconds, sigma, stretch

    def _estimate(self, steps: np.ndarray) -> tuple[float, float]:
        """Time between the last two frames and its standard deviation, by the intervals (N,) so far."""
        noise = stamp_noise(steps) if len(steps) >= _LEAST else _first_noise(steps)
        if noise == 0.0:
            return float(steps[-1]), 0.0
        mean = float(steps.mean())
        # What the mean is off by, as it may hold one long interval too many, is part of it.
        regular = max(_IRREGULAR * mean, float(steps.max()) / len(steps))
        at_once = steps < _LEAST_STEP * mean
        if (at_once[1:] & at_once[:-1]).any():
            # Bursts of three or more: how many frames came in a time is known, not when each was taken.
            return mean, min(float(steps.std()), regular)
        own = max(float(steps.var()) - 2.0 * noise**2, 0.0)
        # Times relative to a regular clock that starts with the first stamp.
        stamp, ahead, before, variance = 0.0, 0.0, 0.0, noise**2
        for step in steps:
            stamp, before = stamp + step - mean, ahead
            variance += own
            gain = variance / (variance + noise**2)
            ahead, variance = ahead + gain * (stamp - ahead), (1.0 - gain) * variance
        return max(mean + ahead - before, _LEAST_STEP * mean), min(noise, max(regular, float(np.sqrt(own))))


def _first_noise(steps: np.ndarray) -> float:
    """Of too few intervals for a moment: those that differ, but not by whole frames, show at once."""
    if len(steps) < 2 or steps.mean() > _SLOWEST or _are_multiples(steps):
        return 0.0
    return float(steps.std())


def _are_multiples(steps: np.ndarray) -> bool:
    """Whether all intervals are some few times one of a regular camera."""
    frames = np.round(steps / max(float(steps.min()), np.finfo(float).tiny))
    if frames.max() > _MOST_DROPPED:
        return False
    return float(np.sqrt(np.mean((steps * frames.sum() / steps.sum() - frames) ** 2))) <= _BELIEVED
