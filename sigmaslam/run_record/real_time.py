"""Recordings played as if they came from cameras, and how long poses take from there."""

from __future__ import annotations

import time
from array import array
from collections.abc import Generator, Iterator
from typing import Any

import numpy as np

from sigmaslam.readers import StereoFrame

POLICY = "the newest frame that has come is tracked; older ones that are still waiting are dropped"


class Latency:
    """Time from the arrival of each frame to its pose; the first frame arrives when it is handed over."""

    def __init__(self) -> None:
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

    def note(self, timestamp: float) -> None:
        """The pose of the frame of that time stamp is known now."""
        self._seconds.append(self.age(timestamp))

    def describe(self) -> dict[str, float]:
        """Percentiles in milliseconds by name; empty before the first pose."""
        if not self._seconds:
            return {}
        milliseconds = 1e3 * np.asarray(self._seconds)
        names = ("p50", "p95", "p99", "max")
        values = np.percentile(milliseconds, (50, 95, 99, 100))
        return {name: round(float(value), 1) for name, value in zip(names, values, strict=True)}


class RealTimePlayer:
    """Hands over recorded frames at their time stamps, always the newest one that has come.

    Args:
        frames: in order.
        latency: tells when frames arrive.

    Attributes:
        dropped: frames that were still waiting when a newer one had come.
        waited: seconds until the last frame came.
    """

    def __init__(self, frames: Iterator[StereoFrame], latency: Latency) -> None:
        self.dropped = 0
        self.waited = 0.0
        self._frames = frames
        self._latency = latency

    def play(self) -> Generator[StereoFrame, None, None]:
        """The frames that are not dropped."""
        waiting = next(self._frames, None)
        while waiting is not None:
            self._latency.start(waiting.timestamp)
            self.waited = max(-self._latency.age(waiting.timestamp), 0.0)
            time.sleep(self.waited)
            coming = next(self._frames, None)
            while coming is not None and self._latency.age(coming.timestamp) >= 0.0:
                self.dropped += 1
                waiting, coming = coming, next(self._frames, None)
            yield waiting
            waiting = coming


def format_latency(latency_ms: dict[str, float]) -> str:
    """Percentiles as `Latency.describe` gives them, in words."""
    return ", ".join(f"{name} {value:.0f}" for name, value in latency_ms.items())


def describe_real_time(latency: Latency, dropped: int) -> dict[str, Any]:
    """Entry of run.json."""
    return {"real_time": {"policy": POLICY, "dropped": dropped, "latency_ms": latency.describe()}}
