from __future__ import annotations

import numpy as np

from sigmaslam_benchmarks.tracking.dense_gallery import draw_points


def test_the_nearer_point_hides_the_farther_and_what_is_behind_is_not_drawn():
    points = np.array([[0.0, 0.0, 2.0], [0.0, 0.0, 4.0], [0.0, 0.0, -3.0]])
    colours = np.array([[10, 0, 0], [200, 0, 0], [90, 0, 0]], np.uint8)
    for order in ([0, 1, 2], [2, 1, 0]):
        picture = draw_points(points[order], colours[order], np.eye(4), focal=500.0, spacing=0.01)
        height, width = picture.shape[:2]
        assert picture[height // 2, width // 2].tolist() == [10, 0, 0]
        assert not (picture[..., 0] == 90).any()


def test_a_point_is_drawn_where_the_pinhole_says():
    picture = draw_points(np.array([[0.2, -0.1, 2.0]]), np.full((1, 3), 255, np.uint8), np.eye(4), 500.0, 1e-4)
    v, u = np.nonzero(picture[..., 0] == 255)
    height, width = picture.shape[:2]
    assert abs(u.mean() - width / 2 - 50.0) <= 1.0
    assert abs(v.mean() - height / 2 + 25.0) <= 1.0
