"""A mesh from depth maps: Open3D's truncated signed distance function and marching cubes."""

from pathlib import Path
from typing import Any

import numpy as np

from sigmaslam.errors import InputError
from sigmaslam.files import atomic_path
from sigmaslam.geometry.camera import RectifiedStereo
from sigmaslam.geometry.se3 import se3_inverse

# Distances are truncated at so many voxels, and a voxel of the mesh is so many of the cloud's.
_TRUNCATION, _COARSER = 4.0, 2.0
# Blocks of voxels that are made room for at first, and of the depths that a voxel has seen the least that count.
_BLOCKS, _LEAST_WEIGHT = 10_000, 0.5
# Depths farther than so many voxels are left out: surfaces there are coarser than the voxels.
_FARTHEST = 1000.0


def need_open3d() -> Any:
    """The module Open3D.

    Raises:
        InputError: it is not installed, or lacks a library of the system.
    """
    try:
        import open3d
    except ImportError as error:
        raise InputError(f"--mesh needs Open3D ({error}): pip install 'sigmaslam[dense]', or leave it out") from error
    return open3d


class DepthVolume:
    """Depth maps of a world, integrated into sparse blocks of voxels; Open3D's older volumes give no mesh in 0.20.

    Args:
        voxel: side of a voxel of the cloud, metres.
    """

    def __init__(self, voxel: float, camera: RectifiedStereo) -> None:
        self._library = need_open3d()
        core = self._library.core
        self._farthest = _FARTHEST * voxel
        self._is_empty = True
        self._intrinsics = core.Tensor(camera.matrix)
        self._grid = self._library.t.geometry.VoxelBlockGrid(
            attr_names=("tsdf", "weight", "color"),
            attr_dtypes=(core.float32, core.float32, core.float32),
            attr_channels=((1), (1), (3)),
            voxel_size=_COARSER * voxel,
            block_resolution=16,
            block_count=_BLOCKS,
            device=core.Device("CPU:0"),
        )

    def integrate(self, depth: np.ndarray, picture: np.ndarray, pose: np.ndarray) -> None:
        """Takes a depth map.

        Args:
            depth: (H, W) float32 metres, 0 where there is none.
            picture: (H, W, 3) uint8 red, green and blue.
            pose: (4, 4) T_world_camera.
        """
        if not ((depth > 0.0) & (depth < self._farthest)).any():
            return
        self._is_empty = False
        core, image = self._library.core, self._library.t.geometry.Image
        depths = image(core.Tensor(np.ascontiguousarray(depth)))
        colours = image(core.Tensor(picture.astype(np.float32) / 255.0))
        view = self._intrinsics, core.Tensor(np.ascontiguousarray(se3_inverse(pose)))
        blocks = self._grid.compute_unique_block_coordinates(depths, *view, 1.0, self._farthest, _TRUNCATION)
        self._grid.integrate(blocks, depths, colours, *view, 1.0, self._farthest, _TRUNCATION)

    def write(self, path: Path) -> None:
        """Writes the mesh as PLY, with normals and colours.

        Raises:
            InputError: no surface was seen, or the file cannot be written.
        """
        if self._is_empty:
            raise InputError(f"{path}: no point is near enough for a mesh: leave --mesh out, or give a larger --voxel")
        mesh = self._grid.extract_triangle_mesh(weight_threshold=_LEAST_WEIGHT).to_legacy()
        mesh.compute_vertex_normals()
        # Means of white exceed one by their rounding.
        mesh.vertex_colors = self._library.utility.Vector3dVector(np.clip(mesh.vertex_colors, 0.0, 1.0))
        with atomic_path(path) as temporary:
            if not self._library.io.write_triangle_mesh(str(temporary), mesh):
                raise InputError(f"{path}: Open3D could not write the mesh: choose another place")
