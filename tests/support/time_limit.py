"""An error in code that takes too long."""

from __future__ import annotations

import signal
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType


class HangError(BaseException):
    """Something took too long; no Exception, which readers may catch."""


@contextmanager
def limited_time(seconds: float) -> Iterator[None]:
    """Raises a HangError in the block after so many seconds."""

    def stop(number: int, frame: FrameType | None) -> None:
        raise HangError(f"more than {seconds:g} s")

    handler = signal.signal(signal.SIGALRM, stop)
    # pytest-timeout has the same timer; what a few executions take does not matter to it.
    timer = signal.setitimer(signal.ITIMER_REAL, seconds)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_REAL, *timer)
        signal.signal(signal.SIGALRM, handler)
