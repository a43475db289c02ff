"""pictures.npz of a run: small pictures of some frames and of the worst ones, with what was matched in them."""

import heapq
from collections import deque
from dataclasses import dataclass, fields
from itertools import count
from pathlib import Path

import cv2
import numpy as np

from sigmaslam.bounded_files import load_columns
from sigmaslam.errors import InputError
from sigmaslam.files import save_arrays
from sigmaslam.slam.estimate import Estimate
from sigmaslam.slam.matched_frame import MatchedFrame

PICTURES_NAME = "pictures.npz"
MAX_PICTURES, WORST = 60, 10
"""Frames that are spread evenly over the run, up to twice as many where its length is not known, and the worst ones."""
_WIDTH, _QUALITY = 480, 70
_MAX_MATCHES = 300
_TRAIL = 4


@dataclass(frozen=True, slots=True)
class FramePictures:
    """Pictures of P frames in order, and M matches in all of them together.

    Attributes:
        timestamp: (P,) seconds.
        score: (P,) how unlikely the frame is, in standard deviations of a consistent filter's NIS; infinite where
            tracking was lost or did not start.
        worst: (P,) bool, of the `WORST` frames.
        left, right: (B,), (C,) uint8, JPEG files one after the other, of the rectified images. Those of right images
            are empty where the frame has a pose.
        left_end, right_end: (P,) where each of them ends.
        size: (2,) width and height of the rectified images, pixels; the pictures are smaller.
        match_end: (P,) where the matches of each frame end.
        pixels: (M, 2) float32 places (u, v) in the left image.
        covariance: (M, 2, 2) float32 of them, pixels squared.
        probability: (M,) float32 that the match is right.
        inlier: (M,) bool, the pose agrees with it.
        trail: (M, T, 2) float32, where the landmark was in the frames before, the latest first; NaN where it was not
            matched.
    """

    timestamp: np.ndarray
    score: np.ndarray
    worst: np.ndarray
    left: np.ndarray
    left_end: np.ndarray
    right: np.ndarray
    right_end: np.ndarray
    size: np.ndarray
    match_end: np.ndarray
    pixels: np.ndarray
    covariance: np.ndarray
    probability: np.ndarray
    inlier: np.ndarray
    trail: np.ndarray

    def __len__(self) -> int:
        return len(self.timestamp)

    def jpegs(self, index: int) -> tuple[bytes, bytes]:
        """The pictures of one frame, left and right; the right one may be empty."""
        left, right = (
            file[end[index - 1] if index else 0 : end[index]].tobytes()
            for file, end in ((self.left, self.left_end), (self.right, self.right_end))
        )
        return left, right

    def matches(self, index: int) -> slice:
        """The rows of the matches of one frame."""
        return slice(int(self.match_end[index - 1]) if index else 0, int(self.match_end[index]))


_SHAPES: dict[str, tuple[str | int, ...]] = {
    **dict.fromkeys(("timestamp", "score", "worst", "left_end", "right_end", "match_end"), ("P",)),
    **{"left": ("B",), "right": ("C",), "size": (2,)},
    **{"pixels": ("M", 2), "covariance": ("M", 2, 2), "probability": ("M",), "inlier": ("M",), "trail": ("M", "T", 2)},
}
_KINDS = {
    **dict.fromkeys(("left", "right"), "u"),
    **dict.fromkeys(("left_end", "right_end", "size", "match_end"), "iu"),
    **dict.fromkeys(("worst", "inlier"), "b"),
}


@dataclass(frozen=True, slots=True)
class _Picture:
    timestamp: float
    score: float
    left: bytes
    right: bytes
    pixels: np.ndarray
    covariance: np.ndarray
    probability: np.ndarray
    inlier: np.ndarray
    trail: np.ndarray


class PictureRecorder:
    """Takes every frame of a run, `length` if that is known, and keeps pictures of few, so that memory is bounded."""

    def __init__(self, length: int | None) -> None:
        self._every = 1 if length is None else max(1, -(-length // MAX_PICTURES))
        self._even: list[_Picture] = []
        self._worst: list[tuple[float, int, _Picture]] = []
        self._number = count()
        self._before: deque[MatchedFrame] = deque(maxlen=_TRAIL)
        self._had_pose = True
        self._size = (0, 0)

    def add(self, estimate: Estimate, frame: MatchedFrame) -> None:
        """Takes a frame, and makes its picture if it is due or one of the worst so far."""
        number = next(self._number)
        score = self._score(estimate)
        # Of equal ones the earlier frame is worse: it is where the trouble began.
        is_bad = score > -np.inf and (len(self._worst) < WORST or (score, -number) > self._worst[0][:2])
        is_due = number % self._every == 0
        if is_bad or is_due:
            picture = self._draw(estimate.timestamp, score, frame)
            if is_due:
                self._even.append(picture)
            if is_bad:
                place = heapq.heappush if len(self._worst) < WORST else heapq.heappushpop
                place(self._worst, (score, -number, picture))
        if len(self._even) > 2 * MAX_PICTURES:
            self._even, self._every = self._even[::2], 2 * self._every
        self._before.appendleft(frame)
        self._size = frame.left.shape[1], frame.left.shape[0]

    def write(self, path: Path) -> None:
        """Writes the pictures."""
        worst = {picture.timestamp for *_, picture in self._worst}
        by_time = {picture.timestamp: picture for picture in (*self._even, *(each[-1] for each in self._worst))}
        pictures = [by_time[timestamp] for timestamp in sorted(by_time)]

        def joined(name: str, empty: np.ndarray) -> np.ndarray:
            return np.concatenate([empty, *(getattr(each, name) for each in pictures)])

        def ends(sizes: list[int]) -> np.ndarray:
            return np.cumsum(sizes, dtype=np.int64)

        content = FramePictures(
            timestamp=np.array([each.timestamp for each in pictures]),
            score=np.array([each.score for each in pictures]),
            worst=np.array([each.timestamp in worst for each in pictures], bool),
            left=np.frombuffer(b"".join(each.left for each in pictures), np.uint8),
            left_end=ends([len(each.left) for each in pictures]),
            right=np.frombuffer(b"".join(each.right for each in pictures), np.uint8),
            right_end=ends([len(each.right) for each in pictures]),
            size=np.array(self._size),
            match_end=ends([len(each.pixels) for each in pictures]),
            pixels=joined("pixels", np.zeros((0, 2), np.float32)),
            covariance=joined("covariance", np.zeros((0, 2, 2), np.float32)),
            probability=joined("probability", np.zeros(0, np.float32)),
            inlier=joined("inlier", np.zeros(0, bool)),
            trail=joined("trail", np.zeros((0, _TRAIL, 2), np.float32)),
        )
        save_arrays(path, **{field.name: getattr(content, field.name) for field in fields(FramePictures)})

    def _score(self, estimate: Estimate) -> float:
        """As of `FramePictures`; of frames without a pose of their own only the first one of each loss has a score."""
        had_pose, self._had_pose = self._had_pose, estimate.dof > 0
        if estimate.dof > 0:
            # (chi2 / dof)^(1/3) is nearly normal (Wilson and Hilferty).
            spread = 2.0 / (9.0 * estimate.dof)
            return float((np.cbrt(estimate.nis / estimate.dof) - 1.0 + spread) / np.sqrt(spread))
        is_loss = estimate.status in ("lost", "starting") and estimate.tracks is None
        return np.inf if had_pose and is_loss else -np.inf

    def _draw(self, timestamp: float, score: float, frame: MatchedFrame) -> _Picture:
        rows = np.arange(len(frame.landmark))[:: max(1, -(-len(frame.landmark) // _MAX_MATCHES))]
        trail = np.full((len(rows), _TRAIL, 2), np.nan, np.float32)
        for k, before in enumerate(self._before):
            _, here, there = np.intersect1d(frame.landmark[rows], before.landmark, return_indices=True)
            trail[here, k] = before.pixels[there]
        images = small_jpeg(frame.left), b"" if frame.agreeing is not None else small_jpeg(frame.right)
        pixels, covariance, probability = (
            each[rows].astype(np.float32) for each in (frame.pixels, frame.covariance, frame.matches.probability)
        )
        return _Picture(timestamp, score, *images, pixels, covariance, probability, frame.inliers[rows], trail)


def read_pictures(path: Path) -> FramePictures:
    """The content of a pictures.npz.

    Raises:
        InputError: it is no such file.
    """
    mend = "run `sigmaslam track` again"
    arrays = load_columns(path, mend, _SHAPES, _KINDS)
    ends = (("left_end", "left"), ("right_end", "right"), ("match_end", "pixels"))
    for end, values in ((arrays[name], arrays[of]) for name, of in ends):
        if not (np.diff(end, prepend=0) >= 0).all() or (end[-1] if len(end) else 0) != len(values):
            raise InputError(f"{path}: its parts do not go together; {mend}")
    return FramePictures(**arrays)


def small_jpeg(image: np.ndarray, most: int = _WIDTH, quality: int = _QUALITY) -> bytes:
    """An image (H, W) or (H, W, 3) as a JPEG file, at most so many pixels wide."""
    height, width = image.shape[:2]
    scale = min(1.0, most / width)
    size = max(1, round(width * scale)), max(1, round(height * scale))
    small = cv2.resize(image, size, interpolation=cv2.INTER_AREA)
    _, encoded = cv2.imencode(".jpg", small, [cv2.IMWRITE_JPEG_QUALITY, quality])
    return bytes(encoded)
