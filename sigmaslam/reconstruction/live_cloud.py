"""A dense cloud that is made while a run goes on, of keyframes as soon as two views behind them are there."""

from collections.abc import Callable
from pathlib import Path

import numpy as np

from sigmaslam.bodies.object_tracker import ObjectEstimate
from sigmaslam.errors import InputError
from sigmaslam.geometry.camera import StereoCamera
from sigmaslam.geometry.rectification import StereoRectifier
from sigmaslam.live.frame_sink import TrackedFrame
from sigmaslam.reconstruction.cloud import VoxelCloud, write_cloud
from sigmaslam.reconstruction.depth_fusion import DepthView
from sigmaslam.reconstruction.disparity import semi_global_disparity
from sigmaslam.reconstruction.reconstruct import (
    NEIGHBOURS,
    default_voxel,
    fuse_keyframe,
    least_views,
    make_picture,
    measure_view,
)
from sigmaslam.reconstruction.recorded_keyframes import MOST_FRAMES, RecordedKeyframes
from sigmaslam.run_record.dense_points import DENSE_NAME, write_dense_points
from sigmaslam.run_record.relative_pose_file import FramePairs
from sigmaslam.slam.estimate import Estimate
from sigmaslam.slam.relative_poses import SPANS, RelativePoses


class CloudSink:
    """Makes the cloud of `sigmaslam map reconstruct` of the poses as they are said.

    A few views and a bounded number of voxels are in memory; a pose far from the one before it begins anew.

    Args:
        run: folder of the run, whose report shows it.
        show: takes points (N, 3) of each keyframe, metres, and their colours (N, 3), red, green and blue to 255.
    """

    def __init__(
        self, path: Path, run: Path, camera: StereoCamera, show: Callable[[np.ndarray, np.ndarray], None] | None = None
    ) -> None:
        self.name, self._show = str(path), show
        self._path, self._run, self._camera = path, run, camera
        self._rectifier = StereoRectifier(camera)
        self._cloud: VoxelCloud | None = None
        self._views: list[tuple[Estimate, np.ndarray, DepthView]] = []
        self._keyframes = self._since = 0

    def add(self, frame: TrackedFrame) -> None:
        """Takes a frame."""
        said, seen = frame.result, frame.seen
        if isinstance(said, ObjectEstimate) or seen is None or not said.has_pose:
            return
        if said.status in ("lost", "relocalised") or said.loop is not None:
            self._fuse_last()
        self._since += 1
        if said.status in ("lost", "skipped") or (said.tracks is None and self._since < MOST_FRAMES):
            return
        self._since = 0
        offset = said.calibration.disparity_offset
        view = measure_view(seen.left, seen.right, self._rectifier, semi_global_disparity, offset, seen.usable)
        self._views = [
            *self._views[-2 * NEIGHBOURS :],
            (said, make_picture(seen.left, frame.colour, self._rectifier), view),
        ]
        if len(self._views) > NEIGHBOURS:
            self._fuse(len(self._views) - 1 - NEIGHBOURS)

    def close(self) -> None:
        """Writes the cloud, and what the report shows of it."""
        self._fuse_last()
        if self._cloud is None:
            raise InputError("no keyframe has a pose: track a longer sequence")
        points = self._cloud.cloud(least_views(self._keyframes))
        write_cloud(self._path, points)
        write_dense_points(self._run / DENSE_NAME, points.points, points.sigma, points.colours)

    def _fuse_last(self) -> None:
        """Fuses the views that wait for others: none come, or from another place of the world."""
        for number in range(max(len(self._views) - NEIGHBOURS, 0), len(self._views)):
            self._fuse(number)
        self._views = []

    def _fuse(self, number: int) -> None:
        if self._views[number][0].tracks is None:
            return
        views = {k: (picture, view) for k, (_, picture, view) in enumerate(self._views)}
        depth = fuse_keyframe(number, views, self._recorded(), self._rectifier)
        self._cloud = self._cloud or VoxelCloud(default_voxel(depth, self._rectifier.rectified))
        points, sigma = depth.cloud(self._rectifier.rectified, self._cloud.size)
        self._cloud.add(points, sigma)
        if self._show is not None:
            self._show(points.points, points.colours)
        self._keyframes += 1

    def _recorded(self) -> RecordedKeyframes:
        """The views in memory, as if they were read from the folder of a run."""
        said = [each for each, _, _ in self._views]
        relative = RelativePoses.concatenate([each.relative_poses for each in said])
        times = np.array([each.timestamp for each in said])
        later = np.repeat(np.arange(len(said)), [len(each.relative_poses) for each in said])
        last = said[-1].calibration
        calibration = last.disparity_offset, last.disparity_offset_sigma, last.raised
        offset, sigma, raised = np.tile(calibration, (len(said), 1)).T
        return RecordedKeyframes(
            *(self._run, "", self._camera, np.array([each.tracks is not None for each in said]), times),
            np.array([each.T_world_camera for each in said]),
            np.array([each.covariance for each in said]),
            *(offset, sigma, raised, np.arange(len(said))),
            FramePairs(np.array(SPANS)[relative.span], 0 * later, later, relative.pose, relative.covariance),
            np.stack([relative.timestamp, times[later]], axis=1),
        )
