"""Calibration boards: chessboard, ChArUco, AprilGrid; their points, and how images of them are read."""

from dataclasses import dataclass

import cv2
import numpy as np

from sigmaslam.errors import InputError
from sigmaslam.table import Table

BOARD_FORMS = "chessboard:9x6:0.025, charuco:8x6:0.04:0.03:DICT_5X5_100 or aprilgrid:6x6:0.088:0.3"

# Half of the window in which a corner is refined, as a share of the distance to its nearest neighbour; pixels at most.
_WINDOW_SHARE, _MAX_WINDOW = 0.3, 11
_REFINED = (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_MAX_ITER, 100, 1e-4)
# Of one image; fewer say hardly more than where the board is.
MIN_CORNERS = 6


@dataclass(frozen=True, slots=True)
class DetectedCorners(Table):
    """Corners of a board in one image.

    Attributes:
        ids: (M,) indices of the board's points.
        pixels: (M, 2) (u, v); (0, 0) is the centre of the top-left pixel.
    """

    ids: np.ndarray
    pixels: np.ndarray


NOTHING = DetectedCorners(np.zeros(0, np.int64), np.zeros((0, 2)))


@dataclass(frozen=True, slots=True)
class Chessboard:
    """A chessboard, which is found as a whole or not at all.

    Attributes:
        columns, rows: numbers of inner corners.
        square: side of a square, metres.
    """

    columns: int
    rows: int
    square: float

    @property
    def points(self) -> np.ndarray:
        """(columns rows, 3), row by row."""
        return _grid(self.columns, self.rows, self.square)

    def detect(self, image: np.ndarray) -> DetectedCorners:
        """All corners, or none."""
        flags = cv2.CALIB_CB_ADAPTIVE_THRESH + cv2.CALIB_CB_NORMALIZE_IMAGE
        found, corners = cv2.findChessboardCorners(image, (self.columns, self.rows), flags=flags)
        if not found:
            return NOTHING
        grid = corners.reshape(self.rows, self.columns, 2)
        steps = (np.linalg.norm(np.diff(grid, axis=axis), axis=-1).min() for axis in (0, 1))
        pixels = _refined(image, corners.reshape(-1, 2), np.full(len(corners), min(steps)))
        return DetectedCorners(np.arange(len(corners)), pixels)


@dataclass(frozen=True, slots=True)
class Charuco:
    """A chessboard with ArUco or AprilTag markers in its white squares, of which parts are enough.

    Attributes:
        columns, rows: numbers of squares.
        square, marker: sides of squares and markers, metres.
        dictionary: OpenCV's name of the markers' dictionary.
    """

    columns: int
    rows: int
    square: float
    marker: float
    dictionary: str

    @property
    def points(self) -> np.ndarray:
        """((columns - 1) (rows - 1), 3), row by row."""
        return _grid(self.columns - 1, self.rows - 1, self.square)

    @property
    def opencv(self) -> cv2.aruco.CharucoBoard:
        """OpenCV's board, which also draws it."""
        dictionary = _dictionary(self.dictionary)
        return cv2.aruco.CharucoBoard((self.columns, self.rows), self.square, self.marker, dictionary)

    def detect(self, image: np.ndarray) -> DetectedCorners:
        """Corners between two markers that were read."""
        board = self.opencv
        pixels, ids, _, _ = cv2.aruco.CharucoDetector(board).detectBoard(image)
        if self.rows % 2 == 0 and (ids is None or len(ids) < MIN_CORNERS):  # OpenCV before 4.6 printed another one
            board.setLegacyPattern(True)
            pixels, ids, _, _ = cv2.aruco.CharucoDetector(board).detectBoard(image)
        if ids is None or len(ids) < MIN_CORNERS:
            return NOTHING
        ids, pixels = ids.ravel().astype(np.int64), pixels.reshape(-1, 2)
        # Markers come as near to a corner as the white rim around them.
        rim = 0.5 * (self.square - self.marker) / self.square
        return DetectedCorners(ids, _refined(image, pixels, _nearest_distance(pixels) * rim / _WINDOW_SHARE))


@dataclass(frozen=True, slots=True)
class AprilGrid:
    """Kalibr's grid of AprilTags 36h11 with small black squares between their corners, of which parts are enough.

    Point 4 k + c is corner c of tag k, from its bottom left anti-clockwise; tags count from the bottom left, by rows.

    Attributes:
        columns, rows: numbers of tags.
        tag: side of a tag, metres.
        spacing: gap between tags, as a share of `tag`.
    """

    columns: int
    rows: int
    tag: float
    spacing: float

    @property
    def points(self) -> np.ndarray:
        """(4 columns rows, 3)."""
        origins = _grid(self.columns, self.rows, self.tag * (1.0 + self.spacing))
        corners = self.tag * np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [1.0, 1.0, 0.0], [0.0, 1.0, 0.0]])
        return (origins[:, None] + corners).reshape(-1, 3)

    def detect(self, image: np.ndarray) -> DetectedCorners:
        """Corners of the tags that were read; a tag of which one corner cannot be refined is left out."""
        settings = cv2.aruco.DetectorParameters()
        # Kalibr's tags have a black border of two cells.
        settings.markerBorderBits = 2
        # The small squares touch the tags' corners: thresholds over small windows keep them apart.
        settings.adaptiveThreshWinSizeStep = 4
        detector = cv2.aruco.ArucoDetector(_dictionary("DICT_APRILTAG_36h11"), settings)
        quads, tags, _ = detector.detectMarkers(image)
        tags = np.zeros(0, np.int64) if tags is None else tags.ravel()
        read = [k for k, tag in enumerate(tags) if tag < self.columns * self.rows]
        if 4 * len(read) < MIN_CORNERS:
            return NOTHING
        # OpenCV begins at the corner that is the bottom right of Kalibr's tag, and goes clockwise.
        ids = (4 * tags[read, None] + [1, 0, 3, 2]).ravel().astype(np.int64)
        pixels = np.concatenate([quads[k].reshape(4, 2) for k in read])
        # The gap to the next tag is the smallest distance between corners.
        around = pixels.reshape(-1, 4, 2)
        sides = np.repeat(np.linalg.norm(around - np.roll(around, 1, axis=1), axis=2).min(axis=1).astype(float), 4)
        refined = _refined(image, pixels, sides * self.spacing / _WINDOW_SHARE * 0.5)
        # Quads end inside their corners, blurred by as much.
        moved = np.linalg.norm(refined - pixels, axis=1).reshape(-1, 4).max(axis=1)
        stayed = np.repeat(moved <= 0.5 * self.spacing * sides[::4], 4)
        return DetectedCorners(ids[stayed], refined[stayed])


Board = Chessboard | Charuco | AprilGrid
"""A plane with `points` (M, 3) that images show, Z = 0, metres; `detect` finds them in an (H, W) uint8 image."""


def parse_board(text: str) -> Board:
    """A board in words: kind, columns x rows, sizes in metres, with colons between.

    Raises:
        InputError: it is none of the forms.
    """
    kind, _, rest = text.partition(":")
    parts = rest.split(":")
    try:
        columns, rows = (int(number) for number in parts[0].split("x"))
        sizes = [float(number) for number in parts[1:3]]
        if min(columns, rows) < 2 or not sizes or not all(0.0 < size < 10.0 for size in sizes):
            raise ValueError
        if kind == "chessboard" and len(parts) == 2:
            return Chessboard(columns, rows, sizes[0])
        if kind == "charuco" and len(parts) == 4 and sizes[1] < sizes[0]:
            _dictionary(parts[3])
            return Charuco(columns, rows, sizes[0], sizes[1], parts[3])
        if kind == "aprilgrid" and len(parts) == 3:
            return AprilGrid(columns, rows, sizes[0], sizes[1])
    except ValueError:
        pass
    raise InputError(
        f"--board is {text!r}: give {BOARD_FORMS} (inner corners and square; squares, square, marker and dictionary; "
        "tags, tag and gap as a share of it; metres)"
    )


def _dictionary(name: str) -> cv2.aruco.Dictionary:
    number = getattr(cv2.aruco, name, None) if name.startswith("DICT_") else None
    if number is None:
        names = ", ".join(sorted(each for each in dir(cv2.aruco) if each.startswith("DICT_")))
        raise InputError(f"{name!r} is no dictionary of markers; known are {names}")
    return cv2.aruco.getPredefinedDictionary(number)


def _grid(columns: int, rows: int, step: float) -> np.ndarray:
    y, x = np.divmod(np.arange(columns * rows), columns)
    return step * np.column_stack([x, y, np.zeros(len(x))]).astype(float)


def _refined(image: np.ndarray, pixels: np.ndarray, distances: np.ndarray) -> np.ndarray:
    """(M, 2) corners to a fraction of a pixel, in windows that hold no other corner (distances (M,) to the nearest)."""
    refined = np.array(pixels, np.float64)
    half = np.clip((_WINDOW_SHARE * distances).astype(int), 2, _MAX_WINDOW)
    for size in np.unique(half).tolist():
        at = half == size
        corners = np.ascontiguousarray(pixels[at], np.float32).reshape(-1, 1, 2)
        refined[at] = cv2.cornerSubPix(image, corners, (size, size), (-1, -1), _REFINED).reshape(-1, 2)
    return refined


def _nearest_distance(pixels: np.ndarray) -> np.ndarray:
    """(M,) distance of each point to the nearest other one."""
    apart = np.linalg.norm(pixels[:, None] - pixels, axis=-1)
    np.fill_diagonal(apart, np.inf)
    return np.asarray(apart.min(axis=1))
