from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from sigmaslam.errors import InputError
from sigmaslam.geometry.camera import RectifiedStereo
from sigmaslam.geometry.se3 import se3_exp, se3_inverse, transform_points
from sigmaslam.reconstruction.cloud import DenseCloud
from sigmaslam.reconstruction.posed_images import PosedImages
from sigmaslam.reconstruction.reconstruct import reconstruct_run

CAMERA = RectifiedStereo(50.0, 60.0, 31.0, 23.0, 0.1, 64, 48)
POSE = se3_exp(np.array([1.0, -2.0, 0.5, 0.3, -0.2, 0.1]))
POINT = np.array([0.4, 0.3, 2.0])


def _cloud(points: np.ndarray) -> DenseCloud:
    count = len(points)
    six = np.tile(np.array([1, 0, 0, 1, 0, 1], np.float32), (count, 1))
    return DenseCloud(points, six, np.full((count, 3), 90, np.float32), np.ones(count, np.int32))


@pytest.fixture
def written(tmp_path: Path) -> Path:
    images = PosedImages(tmp_path / "out", CAMERA)
    images.add(np.full((48, 64, 3), 7, np.uint8), np.eye(4))
    images.add(np.full((48, 64, 3), (9, 5, 1), np.uint8), POSE)
    images.write(_cloud(transform_points(POSE, POINT[None])))
    return tmp_path / "out"


def _expected() -> np.ndarray:
    """Where the second image shows the point, from the corner of its first pixel."""
    return np.array([50.0 * 0.2 + 31.5, 60.0 * 0.15 + 23.5])


def test_colmap_s_model_projects_the_point_to_its_pixel(written: Path):
    model = written / "sparse" / "0"
    kind, width, height, *lens = (model / "cameras.txt").read_text().split()[1:]
    assert (kind, width, height) == ("PINHOLE", "64", "48")
    fx, fy, cx, cy = map(float, lens)
    lines = (model / "images.txt").read_text().split("\n")
    assert lines[1] == lines[3] == ""
    number, w, x, y, z, *rest = lines[2].split()
    assert (number, rest[3:]) == ("2", ["1", "000001.png"])
    world = np.array((model / "points3D.txt").read_text().split()[1:4], float)
    seen = Rotation.from_quat(np.array([x, y, z, w], float)).apply(world) + np.array(rest[:3], float)
    pixel = np.array([fx, fy]) * seen[:2] / seen[2] + (cx, cy)
    np.testing.assert_allclose(pixel, _expected(), atol=2e-3)


def test_nerfstudio_s_transforms_project_the_point_to_its_pixel(written: Path):
    content = json.loads((written / "transforms.json").read_text())
    frame = content["frames"][1]
    assert cv2.imread(str(written / frame["file_path"]))[0, 0].tolist() == [1, 5, 9]
    seen = transform_points(se3_inverse(np.array(frame["transform_matrix"])), transform_points(POSE, POINT[None]))[0]
    # It looks along -z with y up.
    pixel = (
        content["fl_x"] * seen[0] / -seen[2] + content["cx"],
        content["fl_y"] * -seen[1] / -seen[2] + content["cy"],
    )
    np.testing.assert_allclose(pixel, _expected(), atol=1e-6)
    assert (written / content["ply_file_path"]).is_file()


def test_a_folder_that_holds_something_is_refused_before_anything_is_read(written: Path):
    with pytest.raises(InputError, match="not an empty folder: choose another --export"):
        reconstruct_run(written, written / "cloud.ply", export=written)
