"""A mesh from depth maps: Open3D's truncated signed distance function and marching cubes."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from sigmaslam.errors import InputError
from sigmaslam.files import atomic_path
from sigmaslam.geometry.camera import RectifiedStereo
from sigmaslam.geometry.se3 import se3_inverse

# Distances are truncated at so many voxels, and a voxel of the mesh is so many of the cloud's.
_TRUNCATION, _COARSER = 4.0, 2.0
# Depths farther than so many voxels are left out: surfaces there are coarser than the voxels.
_FARTHEST = 1000.0


def need_open3d() -> Any:
    """The module Open3D.

    Raises:
        InputError: it is not installed.
    """
    try:
        import open3d
    except ImportError as error:
        raise InputError("--mesh needs Open3D: pip install 'sigmaslam[dense]', or leave --mesh out") from error
    return open3d


class DepthVolume:
    """Depth maps of a world, integrated into a sparse volume.

    Args:
        voxel: side of a voxel of the cloud, metres.
        camera: that sees the depths.
    """

    def __init__(self, voxel: float, camera: RectifiedStereo) -> None:
        self._library = need_open3d()
        side = _COARSER * voxel
        self._farthest = _FARTHEST * voxel
        integration = self._library.pipelines.integration
        self._volume = integration.ScalableTSDFVolume(
            voxel_length=side, sdf_trunc=_TRUNCATION * side, color_type=integration.TSDFVolumeColorType.RGB8
        )
        self._intrinsics = self._library.camera.PinholeCameraIntrinsic(
            camera.width, camera.height, camera.fx, camera.fy, camera.cx, camera.cy
        )

    def integrate(self, depth: np.ndarray, image: np.ndarray, pose: np.ndarray) -> None:
        """Takes a depth map.

        Args:
            depth: (H, W) float32 metres, 0 where there is none.
            image: (H, W) uint8 grey values.
            pose: (4, 4) T_world_camera.
        """
        geometry = self._library.geometry
        colour = np.ascontiguousarray(np.repeat(image[..., None], 3, axis=2))
        picture = geometry.RGBDImage.create_from_color_and_depth(
            geometry.Image(colour),
            geometry.Image(np.ascontiguousarray(depth)),
            depth_scale=1.0,
            depth_trunc=self._farthest,
            convert_rgb_to_intensity=False,
        )
        self._volume.integrate(picture, self._intrinsics, se3_inverse(pose))

    def write(self, path: Path) -> None:
        """Writes the mesh as PLY, with normals and grey values."""
        mesh = self._volume.extract_triangle_mesh()
        mesh.compute_vertex_normals()
        with atomic_path(path) as temporary:
            if not self._library.io.write_triangle_mesh(str(temporary), mesh):
                raise InputError(f"{path}: Open3D could not write the mesh: choose another place")
