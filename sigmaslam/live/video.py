"""A run as a video: every frame with its tracks, and the path from above beside it."""

from contextlib import ExitStack
from pathlib import Path

import cv2
import numpy as np

from sigmaslam.errors import OutputError
from sigmaslam.files import atomic_path
from sigmaslam.geometry.camera import StereoCamera
from sigmaslam.live.frame_drawing import FramePainter
from sigmaslam.live.frame_sink import TrackedFrame

# The rate is that of the first frames, and a player's at least and at most, frames a second.
_FIRST, _MIN_RATE, _MAX_RATE = 10, 5.0, 60.0


class VideoSink:
    """Writes a picture a frame; the file appears when it is whole.

    Args:
        camera: of the raw images.

    Attributes:
        name: of the file.
    """

    def __init__(self, path: Path, camera: StereoCamera) -> None:
        self.name = str(path)
        self._path = path
        self._painter = FramePainter(camera)
        self._first: list[tuple[float, np.ndarray]] = []
        self._file = ExitStack()
        self._writer: cv2.VideoWriter | None = None
        self._temporary = path
        self._count = 0

    def add(self, frame: TrackedFrame) -> None:
        """Draws a frame and writes it."""
        self._count += 1
        self._painter.add(frame)
        picture = self._painter.draw()
        if self._writer is not None:
            self._writer.write(picture)
            return
        self._first.append((frame.result.timestamp, picture))
        if len(self._first) == _FIRST:
            self._open()

    def close(self) -> None:
        """Writes what a video ends with.

        Raises:
            OutputError: the file does not hold all frames, as on a full disk; it is removed then.
        """
        if not self._count:
            return
        with self._file:
            if self._writer is None and self._first:
                self._open()
            if self._writer is None:
                raise OutputError(f"{self.name}: no frame could be drawn")
            self._writer.release()
            held = count_frames(self._temporary)
            if held != self._count:
                raise OutputError(f"{self.name}: holds {held} of {self._count} frames: make room on the disk")

    def _open(self) -> None:
        """Begins the file with the frames so far."""
        self._temporary = self._file.enter_context(atomic_path(self._path))
        size = self._first[0][1].shape[1::-1]
        rate = frame_rate(np.array([timestamp for timestamp, _ in self._first]))
        writer = cv2.VideoWriter(str(self._temporary), cv2.VideoWriter.fourcc(*"mp4v"), rate, size)
        if not writer.isOpened():
            raise OutputError(f"{self.name}: OpenCV cannot write MPEG-4 here: install opencv-python-headless from PyPI")
        self._writer = writer
        for _, picture in self._first:
            writer.write(picture)
        self._first.clear()


def frame_rate(timestamps: np.ndarray) -> float:
    """Frames a second of a video that is as fast as its frames (N,) came, seconds; a slow one is played faster."""
    if len(timestamps) < 2:
        return _MIN_RATE
    return float(np.clip(1.0 / np.median(np.diff(timestamps)), _MIN_RATE, _MAX_RATE))


def count_frames(path: Path) -> int:
    """Frames that a video's index names; 0 where it cannot be opened."""
    video = cv2.VideoCapture(str(path))
    try:
        return int(video.get(cv2.CAP_PROP_FRAME_COUNT)) if video.isOpened() else 0
    finally:
        video.release()
