"""Whether time stamps are in seconds, and as regular as a camera."""

from collections.abc import Sequence

import numpy as np

from sigmaslam.checks.finding import Finding
from sigmaslam.estimation.frame_clock import stamp_noise

# Frame intervals, seconds: high-speed cameras, and keyframes or slow rovers.
MIN_INTERVAL, MAX_INTERVAL = 1e-3, 5.0
# The interval of which rates differ least from the usual ones, seconds.
_USUAL = 0.05
_UNITS = (("nanoseconds", 1e-9), ("microseconds", 1e-6), ("milliseconds", 1e-3), ("minutes", 60.0), ("hours", 3600.0))


def jitter_words(noise: float) -> str:
    """What stamps with that standard deviation, seconds, are likely to be, and what to do."""
    return (
        f"stamps jitter by {1e3 * noise:.2g} ms: host stamps? Take those of the camera's own clock, or trigger it; "
        "poses are predicted with that uncertainty"
    )


def check_time_stamps(intervals: Sequence[float]) -> Finding:
    """The finding from seconds between successive frames."""
    if not len(intervals):
        return Finding("time stamps", "unknown", "one frame alone has no frame interval")
    interval = float(np.median(intervals))
    noise = stamp_noise(intervals)
    if noise > 0.0 and MIN_INTERVAL <= float(np.mean(intervals)) <= MAX_INTERVAL:
        return Finding("time stamps", "warning", jitter_words(noise), noise)
    if MIN_INTERVAL <= interval <= MAX_INTERVAL:
        return Finding("time stamps", "ok", f"{1e3 * interval:.4g} ms from frame to frame in the median", interval)
    fitting = [(name, unit) for name, unit in _UNITS if MIN_INTERVAL <= interval * unit <= MAX_INTERVAL]
    guess = "give seconds"
    if fitting and interval > 0:
        name, unit = min(fitting, key=lambda each: abs(np.log(interval * each[1] / _USUAL)))
        guess = f"they look like {name} ({interval * unit:.4g} s): give seconds"
    message = (
        f"time stamps are {interval:.4g} s apart in the median, not {MIN_INTERVAL:g} to {MAX_INTERVAL:g} s: {guess}"
    )
    return Finding("time stamps", "warning", message, interval)
