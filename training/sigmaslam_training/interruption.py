"""Ctrl-C and SIGTERM wait for the end of the step that is under way, so that what is saved is a whole step."""

import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType

from sigmaslam_training.devices import Workplace


class Interruption:
    """Turns SIGINT and SIGTERM into a KeyboardInterrupt that never tears a step apart.

    Between steps it comes at once. With several processes it comes after a step alone, in all of them after the same.

    Args:
        place: of this process.

    Attributes:
        torn: a step was left in its middle (another error than the signals): its state is worth nothing.
    """

    def __init__(self, place: Workplace) -> None:
        self._place = place
        self._asked = False
        self._held = place.ranks > 1
        self.torn = False

    @contextmanager
    def listening(self) -> Iterator[None]:
        """Handles the signals inside the block; elsewhere than in the main thread nothing can be handled."""
        if threading.current_thread() is not threading.main_thread():
            yield
            return
        before = {number: signal.signal(number, self._handle) for number in (signal.SIGINT, signal.SIGTERM)}
        try:
            yield
        finally:
            for number, handler in before.items():
                signal.signal(number, handler)

    @contextmanager
    def whole_step(self) -> Iterator[None]:
        """What happens inside is finished before a signal counts."""
        self._held = True
        self.torn = True
        try:
            yield
            self.torn = False
        finally:
            self._held = self._place.ranks > 1
        if self._place.agree(self._asked):
            raise KeyboardInterrupt

    def _handle(self, number: int, frame: FrameType | None) -> None:
        if not self._held:
            raise KeyboardInterrupt
        self._asked = True
