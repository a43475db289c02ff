from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from sigmaslam.errors import InputError
from sigmaslam.geometry.camera import RectifiedStereo
from sigmaslam.geometry.se3 import se3_exp
from sigmaslam.reconstruction.mesh import DepthVolume, need_open3d

CAMERA = RectifiedStereo(200.0, 200.0, 99.5, 59.5, 0.2, 200, 120)


def test_without_open3d_the_extra_is_named(monkeypatch):
    monkeypatch.setitem(__import__("sys").modules, "open3d", None)
    with pytest.raises(InputError, match=r"sigmaslam\[dense\]"):
        need_open3d()


def test_a_wall_becomes_a_flat_mesh_in_the_world(tmp_path: Path):
    open3d = pytest.importorskip("open3d")
    volume = DepthVolume(0.02, CAMERA)
    pose = se3_exp(np.array([1.0, 2.0, 3.0, 0.0, 0.5, 0.0]))
    depth, image = np.full((120, 200), 2.0, np.float32), np.full((120, 200, 3), (90, 60, 30), np.uint8)
    depth[:, :40] = 0.0
    volume.integrate(depth, image, pose)
    volume.write(tmp_path / "mesh.ply")
    mesh = open3d.io.read_triangle_mesh(str(tmp_path / "mesh.ply"))
    seen = (np.asarray(mesh.vertices) - pose[:3, 3]) @ pose[:3, :3]
    assert len(seen) > 500
    np.testing.assert_allclose(seen[:, 2], 2.0, atol=0.01)
    # Nothing where there is no depth, but for a voxel or two.
    assert seen[:, 0].min() > (40 - 99.5) / 200 * 2.0 - 0.1
    np.testing.assert_allclose(np.asarray(mesh.vertex_colors).mean(axis=0), np.array([90, 60, 30]) / 255, atol=0.01)


def test_nothing_seen_is_no_mesh(tmp_path: Path):
    pytest.importorskip("open3d")
    with pytest.raises(InputError, match="no point is near"):
        DepthVolume(0.02, CAMERA).write(tmp_path / "mesh.ply")
    assert not (tmp_path / "mesh.ply").exists()
