"""A dense cloud that is made while a run goes on, of keyframes as soon as two views behind them are there."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from sigmaslam.bodies.object_tracker import ObjectEstimate
from sigmaslam.geometry.camera import StereoCamera
from sigmaslam.geometry.rectification import StereoRectifier
from sigmaslam.live.frame_sink import TrackedFrame
from sigmaslam.reconstruction.cloud import write_cloud
from sigmaslam.reconstruction.depth_fusion import DepthView
from sigmaslam.reconstruction.disparity import semi_global_disparity
from sigmaslam.reconstruction.reconstruct import NEIGHBOURS, CloudBuilder, add_to_run, fuse_keyframe, measure_view
from sigmaslam.reconstruction.recorded_keyframes import MOST_FRAMES, RecordedKeyframes
from sigmaslam.run_record.relative_pose_file import FramePairs
from sigmaslam.slam.estimate import Estimate
from sigmaslam.slam.relative_poses import SPANS, RelativePoses


@dataclass(frozen=True, slots=True)
class _LiveView:
    """A keyframe, or a frame between two that are far apart, with what was said of it."""

    said: Estimate
    image: np.ndarray
    view: DepthView


class CloudSink:
    """Makes the cloud of `sigmaslam map reconstruct` of the poses as they are said, and reads nothing back.

    A few views and a bounded number of voxels are in memory; a pose far from the one before it begins anew.

    Args:
        path: PLY file of the cloud.
        run: folder of the run, whose report shows it.
        camera: of the run.
    """

    def __init__(self, path: Path, run: Path, camera: StereoCamera) -> None:
        self.name = str(path)
        self._path, self._run, self._camera = path, run, camera
        self._rectifier = StereoRectifier(camera)
        self._builder = CloudBuilder(self._rectifier.rectified)
        self._views: list[_LiveView] = []
        self._since = 0

    def add(self, frame: TrackedFrame) -> None:
        """Takes a frame."""
        said, seen = frame.result, frame.seen
        if isinstance(said, ObjectEstimate) or seen is None or not said.has_pose:
            return
        if said.status in ("lost", "relocalised") or said.loop is not None:
            # The poses before are in another place of the world than those that come.
            self._fuse_last()
        self._since += 1
        if said.status in ("lost", "skipped") or (said.tracks is None and self._since < MOST_FRAMES):
            return
        self._since = 0
        offset = said.calibration.disparity_offset
        view = measure_view(seen.left, seen.right, self._rectifier, semi_global_disparity, offset)
        self._views = [*self._views[-2 * NEIGHBOURS :], _LiveView(said, seen.left.copy(), view)]
        if len(self._views) > NEIGHBOURS:
            self._fuse(len(self._views) - 1 - NEIGHBOURS)

    def close(self) -> None:
        """Writes the cloud, and what the report shows of it."""
        self._fuse_last()
        points, summary = self._builder.finish()
        write_cloud(self._path, points)
        add_to_run(self._run, points, summary)

    def _fuse_last(self) -> None:
        """Fuses the views that wait for others, which do not come."""
        for number in range(max(len(self._views) - NEIGHBOURS, 0), len(self._views)):
            self._fuse(number)
        self._views = []

    def _fuse(self, number: int) -> None:
        if self._views[number].said.tracks is None:
            return
        images = {k: (each.image, each.view) for k, each in enumerate(self._views)}
        self._builder.add(fuse_keyframe(number, images, self._keyframes(), self._rectifier))

    def _keyframes(self) -> RecordedKeyframes:
        """The views in memory, as if they were read from the folder of a run."""
        said = [each.said for each in self._views]
        relative = RelativePoses.concatenate([each.relative_poses for each in said])
        times = np.array([each.timestamp for each in said])
        later = np.repeat(np.arange(len(said)), [len(each.relative_poses) for each in said])
        earlier = np.zeros_like(later)
        return RecordedKeyframes(
            self._run,
            "",
            self._camera,
            np.array([each.tracks is not None for each in said]),
            times,
            np.array([each.T_world_camera for each in said]),
            np.array([each.covariance for each in said]),
            said[-1].calibration.disparity_offset,
            said[-1].calibration.disparity_offset_sigma,
            np.arange(len(said)),
            FramePairs(np.array(SPANS)[relative.span], earlier, later, relative.pose, relative.covariance),
            np.stack([relative.timestamp, times[later]], axis=1),
        )
