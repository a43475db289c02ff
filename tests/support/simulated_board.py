"""Images and corners of calibration boards before cameras that are known."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import cv2
import numpy as np

from sigmaslam.calibration.board_bundle import Corners, Rig, project_corners
from sigmaslam.calibration.boards import AprilGrid, Board, Charuco, Chessboard, DetectedCorners
from sigmaslam.geometry.camera import CameraModel
from sigmaslam.geometry.se3 import se3_exp, se3_inverse

CHESSBOARD = Chessboard(9, 6, 0.025)
CHARUCO = Charuco(7, 5, 0.035, 0.025, "DICT_5X5_100")
APRIL_GRID = AprilGrid(4, 3, 0.05, 0.3)

RADTAN = CameraModel(640, 480, 520.0, 518.0, 325.0, 236.0, 0.0, "radtan", (-0.28, 0.08, 0.0005, -0.0003, 0.01))
FISHEYE = CameraModel(640, 480, 300.0, 299.0, 322.0, 238.0, 0.0, "equidistant", (0.01, -0.005, 0.002, -0.001))
T_LEFT_RIGHT = se3_exp(np.array([0.1, 0.0008, -0.0005, 0.004, -0.006, 0.003]))

# Texture of a board, pixels a metre.
_DENSITY = 6000.0
_SUPERSAMPLED = 2


def stereo_rig(eye: CameraModel = RADTAN) -> Rig:
    """Two slightly different cameras."""
    return Rig((eye, replace(eye, fx=eye.fx * 1.01, fy=eye.fy * 1.012, cx=eye.cx - 6.0)), T_LEFT_RIGHT)


def board_poses(board: Board, count: int, seed: int, depth: float = 0.45) -> np.ndarray:
    """(count, 4, 4) T_left_board of boards all over the image, tilted by up to 35 degrees."""
    rng = np.random.default_rng(seed)
    centre = np.eye(4)
    centre[:3, 3] = -board.points.mean(axis=0)
    tilt = rng.uniform(-0.6, 0.6, (count, 3)) * [1.0, 1.0, 0.5]
    place = np.column_stack(
        [rng.uniform((-0.08, -0.08), (0.14, 0.08), (count, 2)), depth * rng.uniform(0.8, 1.4, count)]
    )
    poses = se3_exp(np.column_stack([np.zeros((count, 3)), tilt])) @ centre
    poses[:, :3, 3] += place
    return poses


def seen_corners(rig: Rig, board: Board, poses: np.ndarray) -> Corners:
    """All corners in all eyes, without errors."""
    parts = []
    for image in range(len(poses)):
        for eye in range(len(rig.eyes)):
            count = len(board.points)
            part = Corners(np.full(count, image), np.full(count, eye), board.points, np.zeros((count, 2)))
            parts.append(part)
    corners = Corners.concatenate(parts)
    return replace(corners, pixels=project_corners(rig, poses, corners))


def views_of(rig: Rig, board: Board, corners: Corners) -> list[tuple[DetectedCorners, ...]]:
    """Corners as a detector gives them; those outside of the images are left out."""
    views = []
    for image in np.unique(corners.image).tolist():
        eyes = []
        for k, eye in enumerate(rig.eyes):
            pixels = corners.pixels[(corners.image == image) & (corners.eye == k)]
            inside = np.flatnonzero(np.all((pixels >= 0.0) & (pixels <= (eye.width - 1, eye.height - 1)), axis=1))
            eyes.append(DetectedCorners(inside, pixels[inside]))
        views.append(tuple(eyes))
    return views


def draw_board(board: Board, eye: CameraModel, T_eye_board: np.ndarray) -> np.ndarray:
    """(H, W) uint8 image of a board, white around it, blurred as by pixels with an area."""
    texture, origin = _texture(board)
    rays = _fine_rays(eye)
    T_board_eye = se3_inverse(T_eye_board)
    turned, centre = rays @ T_board_eye[:3, :3].T, T_board_eye[:3, 3]
    with np.errstate(divide="ignore", invalid="ignore"):
        place = centre + turned * (-centre[2] / turned[..., 2:])
    in_texture = ((place[..., :2] - origin) * _DENSITY - 0.5).astype(np.float32)
    image = cv2.remap(texture, in_texture, None, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT, borderValue=230)
    return cv2.resize(image, (eye.width, eye.height), interpolation=cv2.INTER_AREA)


@cache
def _fine_rays(eye: CameraModel) -> np.ndarray:
    """Rays through the parts of all pixels."""
    scale = _SUPERSAMPLED
    places = [(np.arange(count * scale) + 0.5) / scale - 0.5 for count in (eye.width, eye.height)]
    return eye.unproject(np.stack(np.meshgrid(*places), axis=-1))


@cache
def _texture(board: Board) -> tuple[np.ndarray, np.ndarray]:
    """The board as an image, grey values 30 and 230, and the place of its corner (0, 0) on the board, metres."""
    if isinstance(board, Chessboard):
        side = round(board.square * _DENSITY)
        squares = np.add.outer(np.arange(board.rows + 1), np.arange(board.columns + 1)) % 2
        return _grey(np.kron(squares, np.ones((side, side)))), np.full(2, -board.square)
    if isinstance(board, Charuco):
        side = round(board.square * _DENSITY)
        drawn = board.opencv.generateImage((board.columns * side, board.rows * side))
        return _grey(drawn > 127), np.full(2, -board.square)
    assert isinstance(board, AprilGrid)
    tag, gap = round(board.tag * _DENSITY), round(board.tag * board.spacing * _DENSITY)
    step = tag + gap
    drawn = np.ones((board.rows * step + gap, board.columns * step + gap))
    dictionary = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_APRILTAG_36h11)
    for k in range(board.columns * board.rows):
        row, column = divmod(k, board.columns)
        marker = cv2.aruco.generateImageMarker(dictionary, k, tag, borderBits=2)
        top, left = gap + row * step, gap + column * step
        # Kalibr's y goes up; OpenCV's tags are turned by 180 degrees against its own.
        drawn[top : top + tag, left : left + tag] = marker[:, ::-1] > 127
    for row in range(board.rows + 1):
        for column in range(board.columns + 1):
            drawn[row * step : row * step + gap, column * step : column * step + gap] = 0
    return _grey(drawn), np.full(2, -board.tag * board.spacing)


def _grey(white: np.ndarray) -> np.ndarray:
    return np.where(white > 0, 230, 30).astype(np.uint8)
