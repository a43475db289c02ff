"""What a run writes."""

from pathlib import Path

import numpy as np

from sigmaslam.run_record.run_folder import write_map_points
from sigmaslam.slam.point_map import PointMap


def test_a_ply_file_round_trips(tmp_path: Path):
    rng = np.random.default_rng(0)
    root = rng.normal(size=(5, 3, 3))
    points, covariances = rng.normal(size=(5, 3)), root @ root.transpose(0, 2, 1)
    point_map = PointMap(points, covariances, np.arange(3, 8), np.zeros(5), np.zeros((5, 2)), np.full(5, np.nan))
    write_map_points(tmp_path / "map.ply", point_map)
    header, _, body = (tmp_path / "map.ply").read_bytes().partition(b"end_header\n")
    assert header.splitlines()[:3] == [b"ply", b"format binary_little_endian 1.0", b"element vertex 5"]
    vertices = np.frombuffer(body, "<f4").reshape(5, 4)
    np.testing.assert_allclose(vertices[:, :3], point_map.points, rtol=1e-6)
    np.testing.assert_allclose(vertices[:, 3] ** 2, np.linalg.eigvalsh(point_map.covariances)[:, -1], rtol=1e-5)


def test_a_ply_file_has_grey_values_where_they_are_known(tmp_path: Path):
    grey = np.array([0.0, 7.0, 255.0], np.float32)
    point_map = PointMap(np.eye(3), np.tile(np.eye(3), (3, 1, 1)), np.ones(3), np.zeros(3), np.zeros((3, 2)), grey)
    write_map_points(tmp_path / "map.ply", point_map)
    header, _, body = (tmp_path / "map.ply").read_bytes().partition(b"end_header\n")
    assert [line.split()[1:] for line in header.splitlines()[3:]] == [
        [b"float", b"x"],
        [b"float", b"y"],
        [b"float", b"z"],
        [b"uchar", b"red"],
        [b"uchar", b"green"],
        [b"uchar", b"blue"],
        [b"float", b"sigma"],
    ]
    vertices = np.frombuffer(body, [("place", "<f4", 3), ("colour", "u1", 3), ("sigma", "<f4")])
    np.testing.assert_array_equal(vertices["place"], np.eye(3))
    np.testing.assert_array_equal(vertices["colour"], grey[:, None].repeat(3, 1))
    np.testing.assert_array_equal(vertices["sigma"], 1.0)


def test_an_empty_map_is_a_valid_file(tmp_path: Path):
    write_map_points(tmp_path / "map.ply", PointMap.empty())
    assert b"element vertex 0\n" in (tmp_path / "map.ply").read_bytes()
