"""Ctrl-C, SIGTERM and SIGHUP end a run once; while its results are written, further ones change nothing."""

import signal
import threading
from types import FrameType
from typing import Any, Self

_NAMES = ("SIGINT", "SIGTERM", "SIGHUP")  # Windows has no SIGHUP


class Stopped(KeyboardInterrupt):
    """A signal has ended the run.

    Attributes:
        signal: its number.
    """

    def __init__(self, signal: signal.Signals) -> None:
        super().__init__(signal.name)
        self.signal = signal

    @property
    def exit_code(self) -> int:
        """Of a process that ends because of it, by the convention of shells."""
        return 128 + self.signal


class StopSignals:
    """Inside the block the first of these signals raises `Stopped`; later ones, and any after `hold`, are ignored.

    So are those that come after the block once one has been received.

    Signals that the process ignores already, as SIGHUP under nohup, stay ignored. Outside the main thread, where
    Python handles no signals, nothing changes.

    Attributes:
        received: the signal that came; None if none did.
    """

    def __init__(self) -> None:
        self.received: signal.Signals | None = None
        self._held = False
        self._before: dict[signal.Signals, Any] = {}

    def __enter__(self) -> Self:
        if threading.current_thread() is threading.main_thread():
            for number in (signal.Signals[name] for name in _NAMES if name in signal.Signals.__members__):
                if signal.getsignal(number) != signal.SIG_IGN:
                    self._before[number] = signal.signal(number, self._handle)
        return self

    def __exit__(self, *_: object) -> None:
        for number, handler in self._before.items():
            # The process is about to end after a stop, and one signal more must not change how. Python takes its
            # handlers away before it ends, so that a signal would kill it; what is ignored stays ignored.
            signal.signal(number, handler if self.received is None else signal.SIG_IGN)

    def hold(self) -> None:
        """From here on no signal interrupts."""
        self._held = True

    def _handle(self, number: int, frame: FrameType | None) -> None:
        if self._held:
            return
        self._held = True
        self.received = signal.Signals(number)
        raise Stopped(self.received)
