"""Cameras that OpenCV opens, and a pair of images from them that were taken at nearly the same time."""

import logging
import re
import time
from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np

from sigmaslam.errors import InputError
from sigmaslam.readers.images import RawPair
from sigmaslam.readers.pairing import STAMP_TOLERANCE_NS
from sigmaslam.readers.video import split_halves

logger = logging.getLogger(__name__)

# The median over so many pairs tells whether left and right are synchronised.
SYNCHRONY_PAIRS = 30
_DEFAULT_RATE_HZ = 30.0
# OpenCV requests so many buffers from V4L2.
_BUFFERS = 4
# A driver's time stamp that is older does not come from the monotonic clock.
_MAX_AGE_S = 10.0


class PlayedVideo:
    """A video file played as a camera: after the first image, `grab` waits until the next one is due."""

    def __init__(self, capture: cv2.VideoCapture) -> None:
        self._capture = capture
        self._period = 1.0 / rate_hz(capture)
        self._grabbed = 0
        self._began = 0.0
        self.retrieve = capture.retrieve
        self.get = capture.get
        self.getBackendName = capture.getBackendName
        self.release = capture.release

    def grab(self) -> bool:
        """Wait until the next image is due; False at the end."""
        if self._grabbed == 1:
            self._began = time.monotonic()
        elif self._grabbed > 1:
            due = self._began + (self._grabbed - 1) * self._period
            time.sleep(max(0.0, due - time.monotonic()))
        self._grabbed += 1
        return self._capture.grab()


Capture = cv2.VideoCapture | PlayedVideo


def open_capture(device: str, size: tuple[int, int] | None = None) -> Capture:
    """Open a camera or a video file.

    Args:
        device: number, path or URL.
        size: (width, height) to ask the camera for; it may give another one.

    Raises:
        InputError: OpenCV cannot open it.
    """
    # A number opens the camera directly; for a name OpenCV tries other backends first. /dev/v4l/by-id/* are links.
    number = re.fullmatch(r"(?:/dev/video)?(\d+)", device if device.isdecimal() else str(Path(device).resolve()))
    capture = cv2.VideoCapture(int(number[1])) if number else cv2.VideoCapture(device)
    if not capture.isOpened():
        raise InputError(
            f"camera {device} cannot be opened: is it plugged in, used by no other program, and may you read it "
            "(group 'video')? `ls /dev/video* /dev/v4l/by-id` shows the cameras"
        )
    if Path(device).is_file():
        return PlayedVideo(capture)
    if size is not None:
        capture.set(cv2.CAP_PROP_FRAME_WIDTH, size[0])
        capture.set(cv2.CAP_PROP_FRAME_HEIGHT, size[1])
    return capture


def rate_hz(capture: Capture) -> float:
    """Images per second that the camera or file reports, else 30."""
    rate = capture.get(cv2.CAP_PROP_FPS)
    return rate if 1.0 <= rate <= 1000.0 else _DEFAULT_RATE_HZ


class StereoCapture:
    """A left and a right camera, or one whose image holds both eyes.

    Args:
        captures: one or two.
        names: of these, for messages.

    Attributes:
        period: seconds from one pair to the next.
        played: whether these are video files.
        failed: name of the camera that failed last.
    """

    def __init__(self, captures: Sequence[Capture], names: Sequence[str]) -> None:
        self.period = 1.0 / rate_hz(captures[0])
        self.played = any(isinstance(capture, PlayedVideo) for capture in captures)
        self.failed = ""
        self._captures = list(captures)
        self._names = list(names)
        self._driver_clock = all(capture.getBackendName() == "V4L2" for capture in captures)
        self._spreads: list[float] = []

    def take(self, index: int) -> RawPair | None:
        """The next pair, or None when a camera fails; its timestamp is on the monotonic clock.

        The timestamp is the driver's for the left image (V4L2), else the time at which the image arrived.

        Raises:
            InputError: an image with both eyes has an odd width.
        """
        times = self._grab_both()
        if times is None:
            return None
        images = []
        for capture, name in zip(self._captures, self._names, strict=True):
            done, image = capture.retrieve()
            if not done:
                self.failed = name
                return None
            images.append(image)
        if len(images) == 2:
            self._check_synchrony(abs(times[1] - times[0]))
            return RawPair(index, times[0], images[0], images[1], *self._names)
        name = self._names[0]
        left, right = split_halves(images[0], name)
        return RawPair(index, times[0], left, right, f"{name} (left half)", f"{name} (right half)")

    def release(self) -> None:
        """Give the cameras back."""
        for capture in self._captures:
            capture.release()

    def _grab_both(self) -> list[float] | None:
        """Time stamps of the images of each eye, or None when a camera fails."""
        times = []
        for eye in range(len(self._captures)):
            moment = self._grab(eye)
            if moment is None:
                return None
            times.append(moment)
        for _ in range(_BUFFERS):
            # The image in a driver's buffer may be older than the other eye's by a frame or more.
            if not self._driver_clock or max(times) - min(times) < self.period / 2:
                break
            older = times.index(min(times))
            moment = self._grab(older)
            if moment is None:
                return None
            times[older] = moment
        return times

    def _grab(self, eye: int) -> float | None:
        capture = self._captures[eye]
        if not capture.grab():
            self.failed = self._names[eye]
            return None
        now = time.monotonic()
        if self._driver_clock:
            moment = capture.get(cv2.CAP_PROP_POS_MSEC) / 1e3
            if now - _MAX_AGE_S < moment <= now:
                return moment
            # The driver has another clock, or none.
            self._driver_clock = False
        return now

    def _check_synchrony(self, spread: float) -> None:
        if self.played or len(self._spreads) == SYNCHRONY_PAIRS:
            return
        self._spreads.append(spread)
        median = float(np.median(self._spreads))
        if len(self._spreads) == SYNCHRONY_PAIRS and 1e9 * median > STAMP_TOLERANCE_NS:
            logger.warning(
                "%s: left and right are taken %.0f ms apart (median of %d pairs): move slowly, or use cameras with a "
                "common trigger",
                " and ".join(self._names),
                1e3 * median,
                SYNCHRONY_PAIRS,
            )
