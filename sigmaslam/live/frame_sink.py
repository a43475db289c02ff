"""Where the frames of a run go while it goes on, beside its folder: streams, videos, viewers."""

import logging
import queue
import threading
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

import numpy as np

from sigmaslam.bodies.object_tracker import ObjectEstimate
from sigmaslam.errors import InputError
from sigmaslam.slam.estimate import Estimate
from sigmaslam.slam.matched_frame import MatchedFrame

_LOGGER = logging.getLogger(__name__)
# Frames that wait for a sink in a thread of its own; the tracker waits for it when there are more.
_WAITING = 32


@dataclass(frozen=True, slots=True)
class TrackedFrame:
    """A frame, and what was said of it.

    Attributes:
        number: of its row in frames.csv, from 0 on.
        seen: the images with their matches; None where a caller has none.
        colour: of the frame, as `StereoFrame` has it.
    """

    number: int
    result: Estimate | ObjectEstimate
    seen: MatchedFrame | None
    colour: np.ndarray | None = None


class FrameSink(Protocol):
    """Takes the frames of a run in order.

    Attributes:
        name: for messages.
    """

    name: str

    def add(self, frame: TrackedFrame) -> None:
        """Takes a frame."""

    def close(self) -> None:
        """The last frame has come; errors are of a result that is not whole."""


class ThreadedSink:
    """Gives frames to another sink in a thread, so that the tracker does not wait for it to draw or to write.

    After an error of the sink the frames that follow are dropped, and `close` raises it.

    Args:
        sink: whose methods are called in the thread alone.

    Attributes:
        name: of the sink.
    """

    def __init__(self, sink: FrameSink) -> None:
        self.name = sink.name
        self._sink = sink
        self._queue: queue.Queue[TrackedFrame | None] = queue.Queue(_WAITING)
        self._error: Exception | None = None
        self._thread = threading.Thread(target=self._run, name=f"sigmaslam-{type(sink).__name__}", daemon=True)
        self._thread.start()

    def add(self, frame: TrackedFrame) -> None:
        """Takes a frame."""
        self._queue.put(frame)

    def close(self) -> None:
        """Waits until the sink has taken all frames, and closes it.

        Raises:
            Exception: what the sink has raised.
        """
        self._queue.put(None)
        self._thread.join()
        if self._error is not None:
            raise self._error

    def _run(self) -> None:
        while (frame := self._queue.get()) is not None:
            self._attempt(frame)
        self._attempt(None)

    def _attempt(self, frame: TrackedFrame | None) -> None:
        """Gives a frame to the sink, or closes it at the end; it is closed after an error, too."""
        try:
            if frame is None:
                self._sink.close()
            elif self._error is None:
                self._sink.add(frame)
        except Exception as error:
            self._error = self._error or error


def close_all(sinks: Sequence[FrameSink]) -> list[str]:
    """Closes sinks; the names of those whose result is not whole are returned, and the log says why."""
    failed = []
    for sink in sinks:
        try:
            sink.close()
        except Exception as error:
            _LOGGER.error("%s is not written: %s", sink.name, error)
            failed.append(sink.name)
    return failed


def check_sink_path(option: str, path: Path, out: Path, name: str) -> None:
    """A file beside the results of a run can be written there.

    Args:
        option: of the command line, for messages.
        out: folder of the run, which may be still to make.
        name: that the file has in the folder of a run, where `--overwrite` removes it; elsewhere its suffix counts.
    Raises:
        InputError: it has another suffix, its folder does not exist, or it is there already.
    """
    suffix = Path(name).suffix
    if path.suffix.lower() != suffix:
        raise InputError(f"{option} {path}: give a name that ends with {suffix}")
    if path.parent.resolve() == out.resolve():
        if path.name != name:
            raise InputError(f"{option} {path}: call it {name} in the folder of the run, or put it elsewhere")
    elif not path.parent.is_dir():
        raise InputError(f"{option} {path}: there is no folder {path.parent}: make it, or choose another")
    elif path.exists():
        raise InputError(f"{option} {path}: exists: remove it, or choose another name")
