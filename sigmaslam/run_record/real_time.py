"""Recordings played as if they came from cameras, and how long poses take from there."""

import time
from array import array
from collections.abc import Iterator
from typing import Any

import numpy as np

from sigmaslam.readers import StereoFrame

POLICY = "the newest frame that has come is tracked; older ones that are still waiting are dropped"


class FrameTiming:
    """Whether frames come in real time, and how long their poses take from there.

    Args:
        is_live: they come from cameras.
        is_played: recorded ones are handed over at their time stamps, always the newest one that has come.

    Attributes:
        is_real: frames do not wait for the tracker.
        dropped: played frames that were still waiting when a newer one had come.
        waited: seconds until the last played frame came, when it was the tracker that was early.
    """

    def __init__(self, is_live: bool = False, is_played: bool = False) -> None:
        self.is_real = is_live or is_played
        self.dropped, self.waited = 0, 0.0
        self._is_played = is_played and not is_live
        self._first: float | None = None
        self._seconds = array("d")

    def start(self, timestamp: float) -> None:
        """The frame of that time stamp, seconds, arrives now, if it is the first one."""
        if self._first is None:
            self._first = time.perf_counter() - timestamp

    def age(self, timestamp: float) -> float:
        """Seconds since the arrival of the frame of that time stamp; negative if it is still to come."""
        assert self._first is not None
        return time.perf_counter() - self._first - timestamp

    def play(self, frames: Iterator[StereoFrame]) -> Iterator[StereoFrame]:
        """The frames, in order, that are not dropped; cameras give them in real time anyway."""
        waiting = next(frames, None)
        while waiting is not None:
            self.start(waiting.timestamp)
            coming = None
            if self._is_played:
                self.waited = max(-self.age(waiting.timestamp), 0.0)
                time.sleep(self.waited)
                coming = next(frames, None)
                while coming is not None and self.age(coming.timestamp) >= 0.0:
                    self.dropped += 1
                    waiting, coming = coming, next(frames, None)
            yield waiting
            waiting = coming if self._is_played else next(frames, None)

    def note(self, timestamp: float) -> None:
        """The pose of the frame of that time stamp is known now."""
        if self.is_real:
            self._seconds.append(self.age(timestamp))

    def latency_ms(self) -> dict[str, float]:
        """Percentiles in milliseconds by name; empty before the first pose."""
        if not self._seconds:
            return {}
        milliseconds = 1e3 * np.asarray(self._seconds)
        names = ("p50", "p95", "p99", "max")
        values = np.percentile(milliseconds, (50, 95, 99, 100))
        return {name: round(float(value), 1) for name, value in zip(names, values, strict=True)}

    def describe(self, dropped: int) -> dict[str, Any]:
        """Entry of run.json: how many frames were dropped, and the latency; none where frames wait for the tracker."""
        timing = {"policy": POLICY, "dropped": dropped, "latency_ms": self.latency_ms()}
        return {"real_time": timing} if self.is_real else {}


def format_latency(latency_ms: dict[str, float]) -> str:
    """Percentiles as `FrameTiming.latency_ms` gives them, in words."""
    return ", ".join(f"{name} {value:.0f}" for name, value in latency_ms.items())
