"""A frame of a run as a picture: the left image with its tracks, the path from above beside it, and sigma in words."""

from collections import deque
from collections.abc import Iterable, Sequence

import cv2
import numpy as np

from sigmaslam.bodies.object_tracker import ObjectEstimate
from sigmaslam.geometry.camera import StereoCamera
from sigmaslam.live.frame_sink import TrackedFrame
from sigmaslam.live.keyframe_points import KeyframePoints
from sigmaslam.plot_style import bgr
from sigmaslam.slam.matched_frame import MatchedFrame

STATUS_COLOURS = {
    "starting": bgr("#9aa3ad"),
    "tracking": bgr("#3fa7f0"),
    "lost": bgr("#ff6a3d"),
    "skipped": bgr("#c8a24a"),
    "relocalised": bgr("#e08bc0"),
    "doubtful": bgr("#f0d03f"),
    "ambiguous": bgr("#b57bff"),
    "inertial": bgr("#4fc3a1"),
    "odometry": bgr("#a1c34f"),
}
"""Those of the report."""
_BACKGROUND, _TEXT, _FAINT, _OUTLIER = bgr("#14181d"), bgr("#e6e9ec"), bgr("#7d8791"), bgr("#ff4d3d")
_TRAIL = 8
# Matches by their probability: colours from 0 to 1.
_SHADES = cv2.applyColorMap(np.linspace(0, 255, 12).astype(np.uint8)[:, None], cv2.COLORMAP_VIRIDIS)[:, 0]
_HEIGHT, _MAX_WIDTH = 480, 1280
# With more poses every other one, and every other point, is left out, so that long runs are drawn as fast; odd.
_MOST_POSES = 2001
_LINES, _LINE = 5, 19  # of text, and pixels of each
_DIMMED = 0.8
# Share of the plan that the path and the points fill, steps of its scale an octave, and the grey of a black point.
_MARGIN, _STEPS, _DARKEST = 0.95, 6.0, 90.0
# Coordinates of OpenCV's lines have so many binary digits behind the point.
_SHIFT = 4


class FramePainter:
    """Takes frames in order and draws the newest one, with the path until then.

    Args:
        camera: of the raw images.

    Attributes:
        plan: what is drawn beside the image.
    """

    def __init__(self, camera: StereoCamera) -> None:
        self._trails = MatchTrails()
        self.plan = Plan(KeyframePoints(camera))
        self._newest: tuple[TrackedFrame, MatchedFrame] | None = None

    def add(self, frame: TrackedFrame) -> None:
        """Takes a frame, which costs little."""
        assert frame.seen is not None
        self._newest = frame, frame.seen
        self._trails.add(frame.seen)
        self.plan.add(frame)

    def draw(self) -> np.ndarray:
        """(H, W, 3) uint8 in OpenCV's order of colours, of the same even size for every frame of a run.

        The left image is on the left, a square of the plan and of words on the right.
        """
        assert self._newest is not None
        frame, seen = self._newest
        height, width = seen.left.shape
        scale = min(_HEIGHT / height, _MAX_WIDTH / width)
        size = 2 * round(0.5 * scale * width), 2 * round(0.5 * scale * height)
        image = _draw_matches(seen, self._trails, size)
        words = self.plan.describe(frame)
        panel = np.full((size[1], size[1], 3), _BACKGROUND, np.uint8)
        self.plan.draw(panel[: size[1] - _LINES * _LINE - 8])
        for k, (text, colour) in enumerate(words):
            _write(panel, text, (12, size[1] - _LINES * _LINE + k * _LINE + 8), colour)
        return np.hstack([image, panel])


class MatchTrails:
    """Where the landmarks of the newest image were in those before."""

    def __init__(self) -> None:
        self._frames: deque[MatchedFrame] = deque(maxlen=_TRAIL + 1)

    def add(self, frame: MatchedFrame) -> None:
        """Takes a frame."""
        self._frames.appendleft(frame)

    def follow(self) -> tuple[np.ndarray, list[np.ndarray]]:
        """(K,) rows of the matches that the pose agrees with, and of each the places (T, 2), the latest first."""
        frame, *earlier = self._frames
        rows = np.flatnonzero(frame.inliers)
        steps = np.full((_TRAIL + 1, len(rows), 2), np.nan)
        steps[0] = frame.pixels[rows]
        for k, before in enumerate(earlier, start=1):
            _, here, there = np.intersect1d(frame.landmark[rows], before.landmark, return_indices=True)
            # A trail ends where the landmark was not matched.
            steps[k, here] = np.where(np.isnan(steps[k - 1, here]), np.nan, before.pixels[there])
        length = np.isfinite(steps[..., 0]).sum(axis=0)
        return rows, [steps[: length[k], k] for k in range(len(rows))]


def shade_matches(probability: np.ndarray) -> np.ndarray:
    """(N, 3) uint8 colours, blue first, of probabilities (N,)."""
    return _SHADES[np.rint((len(_SHADES) - 1) * np.clip(probability, 0.0, 1.0)).astype(np.int64)]


def _draw_matches(frame: MatchedFrame, trails: MatchTrails, size: tuple[int, int]) -> np.ndarray:
    """The left image at another size (width, height), with trails coloured by probability, outliers as crosses."""
    scale = size[0] / frame.left.shape[1]

    def place(pixels: np.ndarray) -> np.ndarray:
        return scale * (pixels + 0.5) - 0.5

    grey = cv2.resize(frame.left, size, interpolation=cv2.INTER_AREA if scale < 1.0 else cv2.INTER_CUBIC)
    picture = cv2.cvtColor(cv2.convertScaleAbs(grey, alpha=_DIMMED), cv2.COLOR_GRAY2BGR)
    rows, steps = trails.follow()
    for trail, colour in zip(steps, shade_matches(frame.matches.probability[rows]).tolist(), strict=True):
        _draw_lines(picture, [_fixed_point(place(trail))], colour)
        cv2.circle(picture, _pair(place(trail[0])), 5 << (_SHIFT - 1), colour, -1, cv2.LINE_AA, _SHIFT)
    crosses = place(frame.pixels[~frame.inliers])
    ends = np.array([[[-3.0, -3.0], [3.0, 3.0]], [[-3.0, 3.0], [3.0, -3.0]]])
    _draw_lines(picture, _fixed_point(crosses[:, None, None] + ends).reshape(-1, 2, 2), _OUTLIER)
    _draw_legend(picture)
    return np.asarray(picture)


class Plan:
    """The path and the points of keyframes, seen along the y axis of the first camera, which points down.

    Attributes:
        count: of the points so far.
    """

    def __init__(self, points: KeyframePoints) -> None:
        self._keyframe_points = points
        self._points: list[np.ndarray] = []
        self._grey: list[np.ndarray] = []
        self._path: list[np.ndarray] = []
        self._status: list[str] = []
        self._length = 0.0
        self._poses, self._step, self.count = 0, 1, 0
        self._position: np.ndarray | None = None
        self._covariance = np.zeros((2, 2))
        self._heading = np.array([0.0, 1.0])
        self._first: float | None = None

    def add(self, frame: TrackedFrame) -> None:
        """Takes a frame."""
        result, estimate = frame.result, frame.result.camera
        self._first = estimate.timestamp if self._first is None else self._first
        if not estimate.has_pose:
            return
        position, rotation = result.pose[:3, 3], result.pose[:3, :3]
        if self._position is not None:
            self._length += float(np.linalg.norm(position - self._position))
        self._position = position
        if (self._poses - 1) % self._step:  # the last pose was drawn as the newest alone
            del self._path[-1], self._status[-1]
        self._path.append(position[[0, 2]])
        self._status.append(estimate.status)
        self._poses += 1
        self._heading = rotation[[0, 2], 2]
        self._covariance = (rotation @ result.pose_covariance[:3, :3] @ rotation.T)[np.ix_([0, 2], [0, 2])]
        if not isinstance(result, ObjectEstimate):
            points, grey = self._keyframe_points.add(frame)
            self.count += len(points)
            self._points.append(points[:: self._step, [0, 2]])
            self._grey.append(grey[:: self._step])
        if len(self._path) == _MOST_POSES:
            self._step *= 2
            del self._path[1::2], self._status[1::2]
            self._points, self._grey = [np.concatenate(self._points)[::2]], [np.concatenate(self._grey)[::2]]

    def describe(self, frame: TrackedFrame) -> list[tuple[str, Sequence[float]]]:
        """Lines of text and their colours."""
        estimate, result = frame.result.camera, frame.result
        assert self._first is not None
        lines = [(f"frame {frame.number}, {estimate.timestamp - self._first:.2f} s", _FAINT)]
        lines.append((estimate.status, STATUS_COLOURS[estimate.status]))
        if not estimate.has_pose:
            return [*lines, ("no pose yet", _TEXT)]
        variances = np.diag(result.pose_covariance)
        position, rotation = np.sqrt(variances[:3].sum()), np.degrees(np.sqrt(variances[3:].sum()))
        matches = f"{estimate.inliers} of {estimate.matches} matches agree" if estimate.dof else "predicted by motion"
        if estimate.tracks is not None and not estimate.dof:
            matches = "a new keyframe"
        return [
            *lines,
            (f"sigma {format_length(float(position))}, {rotation:.2g} deg", _TEXT),
            (f"path {format_length(self._length)}", _TEXT),
            (matches, _TEXT),
        ]

    def draw(self, panel: np.ndarray) -> None:
        """Draws into an empty panel (H, W, 3)."""
        if not self._path:
            return
        path = np.array(self._path)
        points = np.concatenate([np.zeros((0, 2)), *self._points])
        height, width = panel.shape[:2]
        low, high = extent(path, points, path[-1], 5.0)
        margin = max(0.1 * float(np.max(high - low)), 1e-3)
        low, high = low - margin, high + margin
        scale = _MARGIN * min(width / (high[0] - low[0]), height / (high[1] - low[1]))
        # In steps, so that the view does not creep.
        scale = float(2.0 ** (np.floor(_STEPS * np.log2(scale)) / _STEPS))
        middle = 0.5 * (low + high)

        def place(points: np.ndarray) -> np.ndarray:
            return np.array([0.5 * width, 0.5 * height]) + scale * (points - middle) * np.array([1.0, -1.0])

        dots = np.rint(place(points))
        inside = ((dots >= 0) & (dots < [width, height])).all(axis=1)
        u, v = dots[inside].astype(np.int64).T
        grey = np.concatenate([np.zeros(0, np.uint8), *self._grey])[inside, None]
        panel[v, u] = (_DARKEST + (1.0 - _DARKEST / 255.0) * grey).astype(np.uint8)
        places = _fixed_point(place(path))
        for status, colour in STATUS_COLOURS.items():
            ends = [k for k in range(1, len(path)) if self._status[k] == status]
            _draw_lines(panel, [places[k - 1 : k + 1] for k in ends], colour, 2)
        self._draw_camera(panel, place(path[-1:])[0], scale)
        _draw_scale(panel, scale)

    def _draw_camera(self, panel: np.ndarray, at: np.ndarray, scale: float) -> None:
        """The field of view as an open triangle, and the ellipse of three sigma of the position."""
        colour = STATUS_COLOURS[self._status[-1]]
        heading = self._heading * np.array([1.0, -1.0])
        length = float(np.linalg.norm(heading))
        if length > 1e-6:
            heading = heading / length
            side = np.array([-heading[1], heading[0]])
            corners = np.array([at, at + 16.0 * heading + 9.0 * side, at + 16.0 * heading - 9.0 * side])
            cv2.polylines(panel, [_fixed_point(corners)], True, _TEXT, 1, cv2.LINE_AA, _SHIFT)
        cv2.circle(panel, _pair(at), 4 << _SHIFT, colour, -1, cv2.LINE_AA, _SHIFT)
        variances, axes = np.linalg.eigh(self._covariance)
        half = 3.0 * scale * np.sqrt(np.maximum(variances, 0.0))
        angle = np.degrees(np.arctan2(-axes[1, 1], axes[0, 1]))
        if 5.0 < half[1] < 4.0 * panel.shape[1]:
            cv2.ellipse(panel, _pair(at), _pair(half[::-1]), angle, 0.0, 360.0, colour, 1, cv2.LINE_AA, _SHIFT)


def extent(path: np.ndarray, points: np.ndarray, centre: np.ndarray, far: float) -> tuple[np.ndarray, np.ndarray]:
    """Corners (D,), (D,) of what a view shows: the path, and the points as far as they are near.

    Args:
        path: (P, D) metres.
        points: (N, D); the farthest are the least certain ones.
        centre: (D,) from which points count as near, as the median one or 0.3 times the size of the path.
        far: percent of the points on either side that are left out.
    """
    low, high = path.min(axis=0), path.max(axis=0)
    if len(points):
        reach = max(0.3 * float(np.max(high - low)), float(np.median(np.linalg.norm(points - centre, axis=1))))
        near_low, near_high = np.percentile(points, (far, 100.0 - far), axis=0)
        low = np.minimum(low, np.maximum(near_low, low - reach))
        high = np.maximum(high, np.minimum(near_high, high + reach))
    return low, high


def format_length(metres: float) -> str:
    """A length with the unit that makes it readable."""
    if metres < 0.01:
        return f"{1e3 * metres:.3g} mm"
    return f"{100 * metres:.3g} cm" if metres < 1.0 else f"{float(f'{metres:.3g}'):g} m"


def _draw_legend(picture: np.ndarray) -> None:
    height, bar = picture.shape[0], 8 * len(_SHADES)
    cv2.rectangle(picture, (0, height - 24), (136 + bar, height), _BACKGROUND, -1)
    _write(picture, "probability 0", (8, height - 8), _TEXT)
    for k, colour in enumerate(_SHADES.tolist()):
        cv2.rectangle(picture, (108 + 8 * k, height - 17), (115 + 8 * k, height - 8), colour, -1)
    _write(picture, "1", (114 + bar, height - 8), _TEXT)


def _draw_scale(panel: np.ndarray, scale: float) -> None:
    """A bar of a round length; scale is in pixels a metre."""
    longest = 0.3 * panel.shape[1] / scale
    power = 10.0 ** np.floor(np.log10(longest))
    length = float(power * max(step for step in (1, 2, 5) if step * power <= longest))
    end = panel.shape[1] - 14
    cv2.line(panel, (round(end - length * scale), 14), (end, 14), _TEXT, 2)
    text = format_length(length)
    _write(panel, text, (end - 9 * len(text), 32), _TEXT)


def _write(picture: np.ndarray, text: str, at: tuple[int, int], colour: Sequence[float]) -> None:
    cv2.putText(picture, text, at, cv2.FONT_HERSHEY_SIMPLEX, 0.46, colour, 1, cv2.LINE_AA)


def _draw_lines(picture: np.ndarray, lines: Iterable[np.ndarray], colour: Sequence[float], thickness: int = 1) -> None:
    """Polygonal lines (N, 2) of `_fixed_point`."""
    for line in lines:
        cv2.polylines(picture, [np.ascontiguousarray(line)], False, colour, thickness, cv2.LINE_AA, _SHIFT)


def _fixed_point(points: np.ndarray) -> np.ndarray:
    """Pixels as OpenCV takes them with `_SHIFT`; far outside of every picture they are cut off."""
    return np.rint(np.clip(points, -4096, 4096) * (1 << _SHIFT)).astype(np.int32)


def _pair(point: np.ndarray) -> tuple[int, int]:
    u, v = _fixed_point(point).tolist()
    return u, v
