from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from sigmaslam.geometry.camera import RectifiedStereo
from sigmaslam.geometry.se3 import se3_exp, transform_points
from sigmaslam.reconstruction import cloud
from sigmaslam.reconstruction.cloud import DenseCloud, DepthPixels, VoxelCloud, inverse, largest_eigenvalue, write_cloud

# Places of the six numbers of a symmetric matrix.
SIX = [[0, 1, 2], [1, 3, 4], [2, 4, 5]]
CAMERA = RectifiedStereo(500.0, 500.0, 320.0, 240.0, 0.12, 640, 480)


def test_covariances_of_points_are_those_of_drawn_poses_and_disparities():
    rng = np.random.default_rng(1)
    pose = se3_exp(np.array([1.0, -2.0, 0.5, 0.3, -0.2, 0.1]))
    root = 1e-3 * rng.standard_normal((6, 6))
    pixel = DepthPixels(np.array([[400, 100]]), np.array([12.0]), np.array([0.01]), np.full((1, 3), 90, np.uint8))
    cloud = pixel.cloud(CAMERA, pose, root @ root.T)
    count = 40_000
    pixels = pixel.pixels + rng.uniform(-0.5, 0.5, (count, 2))
    disparity = 12.0 + 0.1 * rng.standard_normal(count)
    points = CAMERA.triangulate(np.column_stack([pixels, disparity]))
    poses = pose @ se3_exp(rng.standard_normal((count, 6)) @ root.T)
    drawn = np.einsum("nab,nb->na", poses[:, :3, :3], points) + poses[:, :3, 3]
    expected = np.cov(drawn.T)
    scale = np.sqrt(np.outer(np.diag(expected), np.diag(expected)))
    np.testing.assert_allclose(cloud.covariances[0][SIX] / scale, expected / scale, atol=0.04)
    np.testing.assert_allclose(cloud.points[0], transform_points(pose, pixel.points(CAMERA))[0])


def test_closed_forms_of_three_by_three_matrices_are_those_of_the_library():
    rng = np.random.default_rng(3)
    turns = np.linalg.qr(rng.standard_normal((500, 3, 3)))[0]
    roots = np.concatenate([turns * np.array([1e-3, 0.1, 1.0]), np.eye(3)[None], np.diag([1.0, 1.0, 2.0])[None]])
    matrices = roots @ roots.transpose(0, 2, 1)
    six = matrices[:, (0, 0, 0, 1, 1, 2), (0, 1, 2, 1, 2, 2)]
    np.testing.assert_allclose(largest_eigenvalue(six), np.linalg.eigvalsh(matrices)[:, -1], rtol=1e-9)
    np.testing.assert_allclose(inverse(six)[:, SIX] @ matrices, np.broadcast_to(np.eye(3), (502, 3, 3)), atol=1e-6)


def _points(points: list[list[float]], variances: list[float]) -> DenseCloud:
    six = np.array([[each, 0, 0, each, 0, each] for each in variances], np.float32)
    colours = np.outer(np.arange(len(points)) % 50, [1, 2, 5]).astype(np.float32)
    return DenseCloud(np.array(points), six, colours, np.ones(len(points), np.int32))


def _add(voxels: VoxelCloud, cloud: DenseCloud) -> None:
    voxels.add(cloud, cloud.sigma)


def test_points_of_a_voxel_are_weighted_by_information_and_gain_none():
    voxels = VoxelCloud(1.0)
    _add(voxels, _points([[0.2, 0.5, 0.5], [3.5, 0.5, 0.5]], [1.0, 4.0]))
    _add(voxels, _points([[0.8, 0.5, 0.5]], [0.5]))
    cloud = voxels.cloud()
    assert cloud.views.tolist() == [2, 1]
    np.testing.assert_allclose(cloud.points, [[0.6, 0.5, 0.5], [3.5, 0.5, 0.5]], rtol=1e-9)
    # The mean information of 1 and 2, and not their sum.
    np.testing.assert_allclose(cloud.covariances[:, 0], [1.0 / 1.5, 4.0], rtol=1e-6)


def test_voxels_follow_sigma_and_finer_points_take_the_place_of_coarser_ones():
    voxels = VoxelCloud(0.1)
    coarse = [[x, 0.5, 0.5] for x in (0.05, 0.15, 0.25, 0.35, 5.05, 5.15)]
    _add(voxels, _points(coarse, [3.2**2] * 6))
    # An eighth of 3.2 m is four times the side.
    assert len(voxels.cloud()) == 2
    _add(voxels, _points([[0.12, 0.5, 0.5]], [0.5**2]))
    cloud = voxels.cloud()
    assert cloud.views.tolist() == [1, 2]
    np.testing.assert_allclose(cloud.sigma, [0.5, 3.2], rtol=1e-5)


def test_an_uncertain_pose_makes_no_voxel_coarser():
    voxels = VoxelCloud(0.1)
    cloud = _points([[x, 0.5, 0.5] for x in (0.05, 0.15, 0.25, 0.35)], [3.2**2] * 4)
    voxels.add(cloud, np.full(4, 0.5))
    np.testing.assert_allclose(voxels.cloud().sigma, [3.2] * 4, rtol=1e-5)


def test_points_of_too_few_views_are_left_out():
    voxels = VoxelCloud(1.0)
    for _ in range(2):
        _add(voxels, _points([[0.5, 0.5, 0.5]], [1.0]))
    _add(voxels, _points([[3.5, 0.5, 0.5]], [1.0]))
    np.testing.assert_allclose(voxels.cloud(min_views=2).points, [[0.5, 0.5, 0.5]])
    assert len(voxels.cloud(min_views=3)) == 0


def test_the_order_in_which_keyframes_come_does_not_matter():
    rng = np.random.default_rng(2)
    parts = [_points(rng.uniform(0, 4, (60, 3)).tolist(), rng.uniform(0.1, 1, 60).tolist()) for _ in range(4)]
    clouds = []
    # Few voxels in memory, too.
    for order, most in ((parts, 1000), (parts[::-1], 1000), (parts, 20)):
        voxels = VoxelCloud(0.7, most)
        for part in order:
            _add(voxels, part)
            assert len(voxels._voxels) <= most
        clouds.append(voxels.cloud())
    for other in clouds[1:]:
        for first, second in zip(clouds[0].columns(), other.columns(), strict=True):
            np.testing.assert_allclose(first, second, rtol=1e-5)


def test_a_voxel_keeps_the_most_certain_pixel_of_a_keyframe():
    pixels = DepthPixels(
        np.array([[320, 240], [321, 240], [500, 240]]),
        np.array([12.0, 12.0, 12.0]),
        np.array([0.04, 0.01, 0.09]),
        np.zeros((3, 3), np.uint8),
    )
    kept = pixels.thinned(CAMERA, 0.5)
    assert sorted(kept.variance.tolist()) == [0.01, 0.09]


def test_compiled_thinning_is_that_of_numpy(monkeypatch: pytest.MonkeyPatch):
    pytest.importorskip("sigmaslam.reconstruction._depths", reason="installed without a compiler")
    rng = np.random.default_rng(0)
    places, disparity = rng.integers(0, 480, (4000, 2)), rng.uniform(2.0, 60.0, 4000)
    pixels = DepthPixels(
        places, disparity, rng.choice([0.01, 0.04, 1.0], 4000), rng.integers(0, 256, (4000, 3)).astype(np.uint8)
    )
    compiled = pixels.thinned(CAMERA, 0.3)
    monkeypatch.setattr(cloud, "kernels", None)
    for one, another in zip(compiled.columns(), pixels.thinned(CAMERA, 0.3).columns(), strict=True):
        np.testing.assert_array_equal(one, another)
    assert len(compiled) < 3000


def test_compiled_voxels_are_those_of_numpy(monkeypatch: pytest.MonkeyPatch):
    pytest.importorskip("sigmaslam.reconstruction._depths", reason="installed without a compiler")
    rng = np.random.default_rng(4)
    parts = [_points(rng.normal(0, 1, (500, 3)).tolist(), rng.uniform(1, 99, 500).tolist()) for _ in range(3)]
    clouds = []
    for _ in range(2):
        voxels = VoxelCloud(0.3, 400)
        for part in parts:
            _add(voxels, part)
        clouds.append(voxels.cloud())
        monkeypatch.setattr(cloud, "kernels", None)
    assert 100 < len(clouds[0]) < 1000
    for one, another in zip(clouds[0].columns(), clouds[1].columns(), strict=True):
        np.testing.assert_allclose(one, another, rtol=1e-6, atol=1e-9)


def test_the_file_holds_every_number(tmp_path: Path):
    cloud = _points([[1.0, 2.0, 3.0], [4.0, 5.0, 6.0]], [0.25, 4.0])
    write_cloud(tmp_path / "cloud.ply", cloud)
    header, _, body = (tmp_path / "cloud.ply").read_bytes().partition(b"end_header\n")
    kinds = {"float": "<f4", "uchar": "u1", "int": "<i4"}
    lines = [line.split() for line in header.decode().splitlines() if line.startswith("property")]
    vertices = np.frombuffer(body, [(name, kinds[kind]) for _, kind, name in lines])
    assert vertices["y"].tolist() == [2.0, 5.0]
    assert vertices["sigma"].tolist() == [0.5, 2.0]
    assert [vertices[name].tolist() for name in ("red", "green", "blue")] == [[0, 1], [0, 2], [0, 5]]
    assert vertices["covariance_yy"].tolist() == [0.25, 4.0]
    assert vertices["covariance_xy"].tolist() == [0.0, 0.0]


def test_without_points_there_is_an_empty_cloud(tmp_path: Path):
    write_cloud(tmp_path / "cloud.ply", VoxelCloud(1.0).cloud())
    assert b"element vertex 0\n" in (tmp_path / "cloud.ply").read_bytes()
