"""Videos: left.* and right.* in a folder, or one file with the two images side by side."""

import logging
import math
from collections.abc import Iterator
from itertools import count, pairwise
from pathlib import Path

import cv2
import numpy as np

from sigmaslam.calibration_files.calibration import find_calibration, read_calibration
from sigmaslam.calibration_files.lens_models import ImageSize
from sigmaslam.errors import CalibrationError, InputError
from sigmaslam.geometry.camera import StereoCamera
from sigmaslam.readers.images import IMAGE_SUFFIXES, GreyConverter, PairSource, RawPair
from sigmaslam.readers.kitti import common_size
from sigmaslam.readers.stereo_sequence import StereoSequence

logger = logging.getLogger(__name__)

# Files beside videos with these suffixes are no videos: images, calibrations, notes.
_NOT_VIDEO = IMAGE_SUFFIXES | {"", ".yaml", ".yml", ".txt", ".csv", ".json", ".md", ".npz", ".npy", ".html", ".pdf"}
LOOKED_FOR = "one side-by-side video file, or a folder with videos left.* + right.*"
_CLOCK_PROBE = 3


def find_videos(folder: Path) -> tuple[Path, Path] | None:
    """The files left.* and right.* of a folder, if both are there."""
    chosen = []
    for eye in ("left", "right"):
        files = sorted(folder.glob(f"{eye}.*"))
        videos = [path for path in files if path.is_file() and path.suffix.lower() not in _NOT_VIDEO]
        if not videos:
            return None
        chosen.append(videos[0])
    return chosen[0], chosen[1]


def beside_calibration(
    folder: Path, calibration: Path | None, image_size: ImageSize, zed_export: bool = False
) -> StereoCamera:
    """The calibration given, else that of the folder.

    Args:
        folder: that has the images.
        calibration: as for `read_calibration`.
        image_size: (width, height) of the images.
        zed_export: the images lie as the ZED SDK exports them, rectified; the camera's SN*.conf, of raw images, must
            then be given and is not taken from the folder.

    Raises:
        CalibrationError: there is none, or it does not fit.
    """
    path = calibration or find_calibration(folder)
    if path is None:
        raise CalibrationError(
            f"{folder / 'calibration.yaml'}: no calibration; write it there or give one with --calibration"
        )
    if zed_export and calibration is None and path.suffix == ".conf":
        raise CalibrationError(
            f"{path}: is of raw images, and the ZED SDK exports rectified ones side by side, or as left* and right* in "
            "one folder: write its calibration_parameters into calibration.yaml; if the images are raw, give "
            "--calibration"
        )
    return read_calibration(path, image_size)


def open_video(path: Path, calibration: Path | None = None) -> StereoSequence:
    """Open one side-by-side video (left half, right half) or a folder with left.* and right.*.

    The calibration is the one beside the video unless one is given. Times are the container's, or
    from its frame rate where those do not increase.

    Raises:
        InputError: there is no such video, it cannot be decoded, or left and right have unequal frame counts.
        CalibrationError: the calibration is missing or does not fit.
    """
    if path.is_dir():
        videos = find_videos(path)
        if videos is None:
            raise InputError(f"{path}: no videos; looked for {LOOKED_FOR}")
        pairs, folder = VideoPairs(*videos), path
    else:
        if path.suffix.lower() in IMAGE_SUFFIXES:
            raise InputError(f"{path}: an image, not a video; give the folder that has the left and right images")
        if path.stem in ("left", "right") and find_videos(path.parent):
            raise InputError(f"{path}: is the video of one eye, the other lies beside it: give the folder")
        pairs, folder = VideoPairs(path), path.parent
    camera = beside_calibration(folder, calibration, common_size(pairs.first_pair), zed_export=path.is_file())
    return StereoSequence(pairs, camera, path, "video")


class VideoPairs(PairSource):
    """Frames of two videos, or the halves of one, as a source of pairs; as many as the container says.

    Raises:
        InputError: a file cannot be decoded, has no usable clock, or an odd width (side by
            side), or the two have unequal frame counts.
    """

    def __init__(self, left: Path, right: Path | None = None) -> None:
        self._files: tuple[Path, ...] = (left,) if right is None else (left, right)
        self.source = self._files[-1]
        captures = [_open(path) for path in self._files]
        counts = [int(capture.get(cv2.CAP_PROP_FRAME_COUNT)) for capture in captures]
        self._rate_hz = float(captures[0].get(cv2.CAP_PROP_FPS))
        for capture in captures:
            capture.release()
        if min(counts) > 0 and len(set(counts)) > 1:
            raise InputError(
                f"unequal left and right videos: {counts[0]} frames in {left}, {counts[1]} in {right}; "
                "cut them to the same frames"
            )
        self.length = counts[0] if counts[0] > 0 else None
        self._use_clock = self._clock_increases()
        if not self._use_clock and not (math.isfinite(self._rate_hz) and self._rate_hz > 0):
            raise InputError(f"{left}: the video has neither increasing times nor a frame rate; re-encode it")

    def __iter__(self) -> Iterator[RawPair]:
        captures = [_open(path) for path in self._files]
        last, warned = -math.inf, False
        try:
            for index in count():
                images = [_next_image(capture) for capture in captures]
                if any(image is None for image in images):
                    self._report_end(index, images)
                    return
                timestamp = index / self._rate_hz if not self._use_clock else _seconds(captures[0])
                if timestamp <= last:
                    if not warned:
                        logger.warning("%s: time goes back at frame %d; frame rate is used", self._files[0], index)
                    warned, timestamp = True, last + 1.0 / (self._rate_hz if self._rate_hz > 0 else 30.0)
                last = timestamp
                yield self._pair(index, timestamp, [image for image in images if image is not None])
        finally:
            for capture in captures:
                capture.release()

    def _pair(self, index: int, timestamp: float, images: list[np.ndarray]) -> RawPair:
        names = [f"{path} frame {index}" for path in self._files]
        if len(images) == 2:
            return RawPair(index, timestamp, images[0], images[1], names[0], names[1])
        left, right = split_halves(images[0], str(self._files[0]))
        return RawPair(index, timestamp, left, right, f"{names[0]} (left half)", f"{names[0]} (right half)")

    def _report_end(self, frames: int, images: list[np.ndarray | None]) -> None:
        if self.length is not None and frames < self.length:
            logger.warning("%s: ends after %d of %d frames", self._files[0], frames, self.length)
        elif len(images) == 2 and any(image is not None for image in images):
            longer = self._files[0] if images[0] is not None else self._files[1]
            logger.warning("%s: has more than the %d frames of the other eye", longer, frames)

    def _clock_increases(self) -> bool:
        capture = _open(self._files[0])
        times: list[float] = []
        while len(times) < _CLOCK_PROBE and capture.grab():
            times.append(_seconds(capture))
        capture.release()
        return len(times) > 1 and all(a < b < math.inf for a, b in pairwise(times))


def _open(path: Path) -> cv2.VideoCapture:
    if not path.is_file():
        raise InputError(f"{path}: no such video")
    capture = cv2.VideoCapture(str(path))
    if not capture.isOpened():
        raise InputError(f"{path}: not a video that OpenCV can decode ({path.stat().st_size} bytes)")
    return capture


def read_frames(path: Path) -> Iterator[np.ndarray]:
    """The grey frames of a video of one eye, (H, W) uint8.

    Raises:
        InputError: there is no such video, or it cannot be decoded.
    """
    capture, grey = _open(path), GreyConverter()
    try:
        while (image := _next_image(capture)) is not None:
            yield grey.convert(image, str(path))
    finally:
        capture.release()


def split_halves(image: np.ndarray, name: str) -> tuple[np.ndarray, np.ndarray]:
    """Left and right half of an image that holds both eyes.

    Raises:
        InputError: the width is odd.
    """
    if image.shape[1] % 2:
        raise InputError(f"{name}: {image.shape[1]} px wide; with both eyes side by side the width must be even")
    left, right = np.split(image, 2, axis=1)
    return np.ascontiguousarray(left), np.ascontiguousarray(right)


def _next_image(capture: cv2.VideoCapture) -> np.ndarray | None:
    ok, image = capture.read()
    return image if ok else None


def _seconds(capture: cv2.VideoCapture) -> float:
    return float(capture.get(cv2.CAP_PROP_POS_MSEC)) / 1000.0
