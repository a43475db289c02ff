"""Images with poses for other people's tools: nerfstudio's transforms.json and COLMAP's text model."""

import json
from pathlib import Path

import cv2
import numpy as np

from sigmaslam.errors import InputError
from sigmaslam.files import atomic_write_text
from sigmaslam.geometry.camera import RectifiedStereo
from sigmaslam.geometry.se3 import matrix_to_quaternion, se3_inverse
from sigmaslam.reconstruction.cloud import DenseCloud, write_cloud
from sigmaslam.table import even_rows

# Points of the COLMAP model, an even selection: so many start a splat.
_MOST_POINTS = 200_000
# nerfstudio's cameras look along -z with y up; ours along z with y down.
_FLIP = np.diag([1.0, -1.0, -1.0, 1.0])


class PosedImages:
    """Rectified left images of keyframes, written as they come.

    The folder gets images/NNNNNN.png; transforms.json and points.ply, which nerfstudio reads; sparse/0 with
    cameras.txt, images.txt and points3D.txt, which COLMAP does. Lengths are metres, the world is that of the run.

    Args:
        folder: new or empty.
    """

    def __init__(self, folder: Path, camera: RectifiedStereo) -> None:
        self._folder, self._camera = folder, camera
        self._poses: list[np.ndarray] = []
        (folder / "images").mkdir(parents=True)
        (folder / "sparse" / "0").mkdir(parents=True)

    def add(self, picture: np.ndarray, pose: np.ndarray) -> None:
        """Takes a picture (H, W, 3) uint8, red, green and blue, and its pose (4, 4) T_world_camera."""
        path = self._folder / "images" / _name(len(self._poses))
        if not cv2.imwrite(str(path), cv2.cvtColor(picture, cv2.COLOR_RGB2BGR)):
            raise InputError(f"{path}: could not be written: choose another place for --export")
        self._poses.append(pose)

    def write(self, cloud: DenseCloud) -> None:
        """Writes poses, and the points of a cloud."""
        camera = self._camera
        write_cloud(self._folder / "points.ply", cloud)
        size = {"w": camera.width, "h": camera.height}
        lens = {"fl_x": camera.fx, "fl_y": camera.fy, "cx": camera.cx + 0.5, "cy": camera.cy + 0.5}
        frames = [
            {"file_path": f"images/{_name(k)}", "transform_matrix": (pose @ _FLIP).tolist()}
            for k, pose in enumerate(self._poses)
        ]
        content = {"camera_model": "OPENCV", **size, **lens, "ply_file_path": "points.ply", "frames": frames}
        atomic_write_text(self._folder / "transforms.json", json.dumps(content, indent=1) + "\n")
        # Both count from the corner of the first pixel, we from its centre.
        model = self._folder / "sparse" / "0"
        lens_text = " ".join(f"{value:.6f}" for value in lens.values())
        atomic_write_text(model / "cameras.txt", f"1 PINHOLE {camera.width} {camera.height} {lens_text}\n")
        # Two lines an image; the second one, of keypoints, is empty.
        images = [f"{k + 1} {_inverse_pose(pose)} 1 {_name(k)}\n\n" for k, pose in enumerate(self._poses)]
        atomic_write_text(model / "images.txt", "".join(images))
        rows = even_rows(len(cloud), _MOST_POINTS)
        lines = [
            f"{k + 1} {x:.5f} {y:.5f} {z:.5f} {red:.0f} {green:.0f} {blue:.0f} 0\n"
            for k, (x, y, z, red, green, blue) in enumerate(np.hstack([cloud.points[rows], cloud.colours[rows]]))
        ]
        atomic_write_text(model / "points3D.txt", "".join(lines))


def _name(number: int) -> str:
    return f"{number:06d}.png"


def _inverse_pose(pose: np.ndarray) -> str:
    """Quaternion w, x, y, z and translation of T_camera_world."""
    inverse = se3_inverse(pose)
    x, y, z, w = matrix_to_quaternion(inverse[:3, :3])
    return " ".join(f"{value:.9f}" for value in (w, x, y, z, *inverse[:3, 3]))
