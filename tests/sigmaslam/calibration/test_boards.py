"""Corners of rendered boards, against where they are."""

from __future__ import annotations

import numpy as np
import pytest

from sigmaslam.calibration.boards import AprilGrid, Board, Charuco, Chessboard, parse_board
from sigmaslam.errors import InputError
from sigmaslam.geometry.se3 import se3_exp
from tests.support.simulated_board import APRIL_GRID, CHARUCO, CHESSBOARD, FISHEYE, RADTAN, board_poses, draw_board

# Turns Kalibr's grid, whose y goes up, so that it stands upright before a camera.
UPRIGHT = se3_exp(np.array([0.0, 0.0, 0.0, np.pi, 0.0, 0.0]))


def test_a_charuco_board_of_older_printings_is_read():
    board = Charuco(8, 6, 0.035, 0.025, "DICT_5X5_100")
    old = board.opencv
    old.setLegacyPattern(True)
    found = board.detect(np.pad(old.generateImage((960, 720)), 40, constant_values=255))
    np.testing.assert_array_equal(found.ids, np.arange(35))


@pytest.mark.long
@pytest.mark.parametrize("board", [CHESSBOARD, CHARUCO, APRIL_GRID], ids=lambda board: type(board).__name__)
@pytest.mark.parametrize("eye", [RADTAN, FISHEYE], ids=lambda eye: eye.distortion_model)
def test_corners_are_where_the_board_was_drawn(board: Board, eye):
    depth = 0.45 if eye is RADTAN else 0.28
    for T in board_poses(board, 2, seed=4, depth=depth):
        pose = T @ _about(board.points.mean(axis=0), UPRIGHT) if isinstance(board, AprilGrid) else T
        found = board.detect(draw_board(board, eye, pose))
        assert len(found) >= 0.5 * len(board.points)
        assert len(np.unique(found.ids)) == len(found)
        points = board.points @ pose[:3, :3].T + pose[:3, 3]
        expected = eye.project(points)
        if isinstance(board, Chessboard) and np.linalg.norm(expected[0] - found.pixels[0]) > 5.0:
            expected = expected[::-1]
        errors = np.linalg.norm(found.pixels - expected[found.ids], axis=1)
        assert np.median(errors) < 0.1
        assert np.mean(errors < 0.5) > 0.95


def test_nothing_is_found_where_no_board_is():
    noise = np.random.default_rng(0).integers(0, 255, (240, 320), np.uint8)
    for board in (CHESSBOARD, CHARUCO, APRIL_GRID):
        assert len(board.detect(noise)) == 0


def test_boards_have_words():
    assert parse_board("chessboard:9x6:0.025") == CHESSBOARD
    assert parse_board("charuco:7x5:0.035:0.025:DICT_5X5_100") == CHARUCO
    assert parse_board("aprilgrid:4x3:0.05:0.3") == APRIL_GRID
    assert CHARUCO.points.shape == (24, 3)
    np.testing.assert_allclose(APRIL_GRID.points[4 * 5 + 2], [0.05 * 2.3, 0.05 * 2.3, 0.0])


@pytest.mark.parametrize(
    "text",
    [
        "",
        "chessboard",
        "chessboard:9:0.025",
        "chessboard:9x6",
        "chessboard:9x6:-0.025",
        "chessboard:9x6:0.025:1",
        "chessboard:1x6:0.025",
        "chessboard:9x6:nan",
        "chessboard:9x6:25",
        "charuco:8x6:0.03:0.04:DICT_5X5_100",
        "circles:4x11:0.02",
    ],
)
def test_other_words_are_refused(text: str):
    with pytest.raises(InputError, match=r"--board is .*: give chessboard:9x6:0.025"):
        parse_board(text)


def test_an_unknown_dictionary_is_named():
    with pytest.raises(InputError, match=r"'DICT_9X9' is no dictionary of markers; known are .*DICT_5X5_100"):
        parse_board("charuco:8x6:0.03:0.02:DICT_9X9")


def _about(centre: np.ndarray, T: np.ndarray) -> np.ndarray:
    there, back = np.eye(4), np.eye(4)
    there[:3, 3], back[:3, 3] = centre, -centre
    return there @ T @ back
