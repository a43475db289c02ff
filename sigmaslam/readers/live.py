"""Live cameras as a sequence: the consumer gets the latest pair, pairs that it misses are dropped."""

import logging
import threading
import time
from collections.abc import Generator, Iterator
from contextlib import closing
from dataclasses import replace
from functools import cached_property
from pathlib import Path

from sigmaslam.calibration_files.calibration import calibrated_size, read_calibration
from sigmaslam.errors import InputError
from sigmaslam.geometry.camera import StereoCamera
from sigmaslam.readers.capture import Capture, StereoCapture, open_capture
from sigmaslam.readers.images import MAX_FAILURES, PairSource, RawPair, SkippedFrame
from sigmaslam.readers.kitti import common_size
from sigmaslam.readers.stereo_sequence import FrameStep, StereoFrame, StereoSequence

logger = logging.getLogger(__name__)

SIDE_BY_SIDE = "side-by-side:"
# Images in the drivers' buffers are old when the tracker is ready: images of the first half second are dropped.
SETTLE_S = 0.5
# The run ends after so long without a pair.
STALL_S = 10.0
_RETRY_S = 0.01
_JOIN_S = 2.0


def open_cameras(device: str, calibration: Path, seconds: float | None = None) -> "LiveSequence":
    """Open live cameras.

    Args:
        device: 'LEFT,RIGHT' or 'side-by-side:DEVICE'. Each is a number, a path (/dev/video2), a URL, or a video
            file, which is played at its own rate as if it were a camera.
        calibration: as for `read_calibration`; the cameras are asked for the image size that it names.
        seconds: ends the sequence after so long.

    Raises:
        InputError: a camera cannot be opened or gives no images.
        CalibrationError: the calibration cannot be read, or the images have another size than it or each other.
    """
    both = device.startswith(SIDE_BY_SIDE)
    devices = [device.removeprefix(SIDE_BY_SIDE)] if both else device.split(",")
    if len(devices) != (1 if both else 2) or not all(devices) or len(set(devices)) < len(devices):
        raise InputError(f"camera {device!r}: give two different ones as LEFT,RIGHT (0,1), or {SIDE_BY_SIDE}0")
    size = calibrated_size(calibration)
    if size is not None and both:
        size = (2 * size[0], size[1])
    captures: list[Capture] = []
    try:
        for name in devices:
            captures.append(open_capture(name, size))
        pairs = LivePairs(StereoCapture(captures, [f"camera {name}" for name in devices]), device, seconds)
        return LiveSequence(pairs, read_calibration(calibration, common_size(pairs.first_pair)), device)
    except BaseException:
        for capture in captures:
            capture.release()
        raise


class LiveSequence(StereoSequence):
    """Pairs as they come, with their calibration; `frames` can be run once."""

    def __init__(self, pairs: "LivePairs", camera: StereoCamera, device: str) -> None:
        super().__init__(pairs, camera, device, "camera")
        self._live = pairs

    @property
    def dropped(self) -> int:
        """Number of pairs that the consumer missed."""
        return self._live.dropped

    def _items(self) -> Generator[StereoFrame | SkippedFrame, None, None]:
        # Live pairs are not read ahead: they would age in the queue.
        return self._convert(self._live)

    def sample(self, count: int) -> list[FrameStep]:
        """The next `count` pairs of frames; to be called before `frames`, which begins after them."""
        with closing(self._convert(self._live.take(2 * count))) as converted:
            frames = [item for item in converted if isinstance(item, StereoFrame)]
        return list(zip(frames[::2], frames[1::2], strict=False))


class LivePairs(PairSource):
    """A source of pairs that yields the latest pair; timestamps begin at 0 with the first.

    A thread takes pairs continuously, so that the drivers' buffers hold no old ones.

    Args:
        capture: the cameras; they are released when the iteration ends.
        name: for messages.
        seconds: ends the iteration after so long.

    Attributes:
        dropped: number of pairs that the consumer missed.
    """

    def __init__(self, capture: StereoCapture, name: str, seconds: float | None = None) -> None:
        self.dropped = 0
        self._capture = capture
        self.source = self._name = name
        self._seconds = seconds
        self._thread: threading.Thread | None = None
        self._stop = threading.Event()
        # The condition guards the three fields below, through which the thread passes pairs to the iteration.
        self._changed = threading.Condition()
        self._latest: RawPair | None = None
        self._ended = False
        self._error: BaseException | None = None

    @cached_property
    def first_pair(self) -> RawPair:
        """The first pair, for its size; InputError if there is none."""
        for _ in range(MAX_FAILURES + 1):
            pair = self._capture.take(0)
            if pair is not None:
                return pair
        raise InputError(
            f"{self._capture.failed} gives no images; is another program using it? Two cameras on one USB hub may ask "
            "for more than it carries: use another port, or smaller images and a calibration for them"
        )

    def take(self, count: int) -> list[RawPair]:
        """The next pairs, before the iteration begins; cameras are left half a second to settle first."""
        settled = time.monotonic() + SETTLE_S
        pairs: list[RawPair] = []
        failures = 0
        while len(pairs) < count and failures <= MAX_FAILURES:
            pair = self._capture.take(len(pairs))
            failures += pair is None
            if pair is not None and (self._capture.played or pair.timestamp >= settled):
                pairs.append(pair)
        return pairs

    def __iter__(self) -> Iterator[RawPair]:
        if self._thread is not None:
            raise InputError(f"camera {self._name}: live images can be read once; open the camera again")
        self._thread = threading.Thread(target=self._take_all, name="sigmaslam-camera", daemon=True)
        self._thread.start()
        began, last, used = 0.0, -1.0, 0
        try:
            while (pair := self._wait()) is not None:
                began = began if used else pair.timestamp
                last = max(pair.timestamp - began, last + 1e-6)
                if self._seconds is not None and last >= self._seconds:
                    return
                used += 1
                yield replace(pair, timestamp=last)
        finally:
            self._stop.set()
            self._thread.join(_JOIN_S)
            if self.dropped:
                logger.warning(
                    "%d of %d pairs were dropped: tracking takes longer than the %.0f ms from one pair to the next",
                    self.dropped,
                    self.dropped + used,
                    1e3 * self._capture.period,
                )

    def _wait(self) -> RawPair | None:
        """The latest pair, or None at the end of a video."""
        with self._changed:
            self._changed.wait_for(lambda: self._latest is not None or self._ended, STALL_S)
            pair, self._latest = self._latest, None
        if pair is not None:
            return pair
        if self._error is not None:
            raise self._error
        if self._ended and self._capture.played:
            return None
        what = f"{self._capture.failed} gives" if self._ended else f"for {STALL_S:g} s camera {self._name} gave"
        raise InputError(f"{what} no more images: unplugged? The run ends here")

    def _take_all(self) -> None:
        """Takes pairs in the thread until the iteration stops or the cameras fail."""
        settled = time.monotonic() + (0.0 if self._capture.played else SETTLE_S)
        patience = 0 if self._capture.played else MAX_FAILURES
        index, failures = 0, 0
        try:
            while not self._stop.is_set() and failures <= patience:
                pair = self._capture.take(index)
                if pair is None:
                    failures += 1
                    self._stop.wait(_RETRY_S)
                    continue
                failures = 0
                if pair.timestamp < settled:
                    continue
                index += 1
                with self._changed:
                    self.dropped += self._latest is not None
                    self._latest = pair
                    self._changed.notify()
        except BaseException as error:
            self._error = error
        finally:
            self._capture.release()
            with self._changed:
                self._ended = True
                self._changed.notify()
