"""Good frames with their truth: rendered rooms and streets, and recordings of real cameras."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from sigmaslam.errors import InputError
from sigmaslam.geometry.camera import StereoCamera
from sigmaslam.geometry.trajectory import Trajectory
from sigmaslam.readers import StereoSequence, open_sequence
from sigmaslam.readers.inertial import InertialRecording, find_imu, read_imu
from sigmaslam.readers.selection import Selection
from sigmaslam.readers.trajectory_files import read_trajectory
from sigmaslam_benchmarks.live.driver_faults import DrivenFrame
from sigmaslam_benchmarks.live.judge import References
from sigmaslam_benchmarks.rendered_camera import open_rendered
from sigmaslam_benchmarks.trial import render
from sigmaslam_evaluation.metrics.trajectory_errors import associate
from sigmaslam_evaluation.metrics.truth_covariance import truth_covariance
from sigmaslam_evaluation.truth_conventions import find_truth

if TYPE_CHECKING:
    from sigmaslam_synthetic.simulation import Recipe

RENDERED = {"room": (360, 270), "street": (576, 176)}
"""Width and height of each preset, as in the benchmark consistency."""
REAL = {
    "drive": ("kitti_raw_0926_0039_a", "poses.txt", (0.21, 0.05)),
    "mh01": ("euroc_mh01_f000_099", "groundtruth.tum", (0.002, 0.2)),
    "kitti01": ("kitti_odometry_01_f000_050", "poses.txt", (0.21, 0.05)),
}
"""Folder, its truth, and the sigmas of this: metres and degrees."""
SEQUENCES = (*RENDERED, *REAL)


@dataclass(frozen=True, slots=True)
class Recording:
    """Good frames that faults are put into.

    Attributes:
        name: of its results.
        kind: one of `SEQUENCES`.
        frames: number of pairs.
        seed: of the render, and of the faults.
        imu: samples a second of the inertial sensor that is rendered; None: none is.
    """

    name: str
    kind: str
    frames: int
    seed: int
    imu: float | None = None

    @property
    def exact(self) -> bool:
        """The truth is exact."""
        return self.kind in RENDERED

    def open(self, runs: Path, data: Path | None) -> GoodFrames:
        """Reads the frames; renders what is missing into the folder `runs`."""
        if self.exact:
            source = render(runs, self._recipe(), 1)
            return _read(open_rendered(source), source, read_trajectory(find_truth(source)), np.zeros((6, 6)))
        assert data is not None
        folder, truth, sigmas = REAL[self.kind]
        sequence = open_sequence(data / folder).select(Selection(count=self.frames))
        true = read_trajectory(data / folder / truth)
        return _read(sequence, data / folder, true, truth_covariance(*sigmas))

    def _recipe(self) -> Recipe:
        from sigmaslam_synthetic.simulation import Recipe

        width, height = RENDERED[self.kind]
        return Recipe(self.kind, self.frames, self.seed, width=width, height=height, imu=self.imu)


@dataclass(frozen=True, slots=True)
class GoodFrames:
    """All pairs of a recording in memory, with calibration and truth, and its inertial sensor where it has one."""

    frames: list[DrivenFrame]
    camera: StereoCamera
    truth: References
    imu: InertialRecording | None = None


def choose_recordings(
    names: Sequence[str] | None,
    data: Path | None,
    first_seed: int,
    seeds: int,
    frames: Mapping[str, int],
    imu: float | None = None,
) -> list[Recording]:
    """The recordings that are asked for; of each preset as many as there are seeds.

    Args:
        names: of `frames`; None: all that there are.
        data: folder of the real data sets; None: renders alone.
        first_seed, seeds: of the renders; the faults of real recordings have the first one.
        frames: pairs, by the name of each recording that is offered.
        imu: samples a second of the inertial sensor that is rendered; None: none is.
    Raises:
        InputError: the data are not there.
    """
    wanted = names or [name for name in frames if name in RENDERED or data is not None]
    missing = [name for name in wanted if name in REAL and (data is None or not (data / REAL[name][0]).is_dir())]
    if missing:
        raise InputError(
            f"{data or 'no folder'} does not hold {', '.join(missing)}: give the folder of the data sets with --data"
        )
    return [
        *(
            Recording(f"{name}{seed}", name, frames[name], seed, imu)
            for seed in range(first_seed, first_seed + seeds)
            for name in wanted
            if name in RENDERED
        ),
        *(Recording(name, name, frames[name], first_seed) for name in wanted if name in REAL),
    ]


def _read(sequence: StereoSequence, folder: Path, truth: Trajectory, covariance: np.ndarray) -> GoodFrames:
    frames = [DrivenFrame(k, each.timestamp, each.left, each.right) for k, each in enumerate(sequence.frames())]
    times = np.array([frame.timestamp for frame in frames])
    poses = np.full((len(frames), 4, 4), np.nan)
    here, there = associate(Trajectory(times, np.tile(np.eye(4), (len(frames), 1, 1))), truth)
    poses[here] = truth.poses[there]
    table = find_imu(folder)
    imu = None if table is None else read_imu(table)
    return GoodFrames(frames, sequence.camera, References(poses, covariance), imu)
