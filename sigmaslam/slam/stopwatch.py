"""Wall time of the stages of a frame."""

import time


class Stopwatch:
    """Adds up wall time by stage."""

    def __init__(self) -> None:
        self.milliseconds = dict.fromkeys(("rectify", "features", "match", "filter", "map"), 0.0)
        self._since = time.perf_counter()

    def lap(self, stage: str) -> None:
        """The time since the last lap, or the start, was that stage's."""
        now = time.perf_counter()
        self.milliseconds[stage] += 1e3 * (now - self._since)
        self._since = now
