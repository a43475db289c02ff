"""One recording, four ways: as it is, backwards, in a mirror, and both. What holds on one way alone is luck.

In a mirror the eyes change places, so that another image is followed; backwards nothing comes nearer.

    python -m sigmaslam_benchmarks.tracking.other_ways RECORDING --truth-sigmas 0.1 0.05 > table.md
"""

import argparse
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from sigmaslam.geometry.camera import CameraModel, StereoCamera
from sigmaslam.geometry.trajectory import Trajectory
from sigmaslam.readers import StereoFrame, open_sequence
from sigmaslam.readers.trajectory_files import read_trajectory
from sigmaslam.slam.tracker import StereoTracker
from sigmaslam_benchmarks.live.judge import DrivenPose, References, pose_errors
from sigmaslam_benchmarks.tracking.stereo_peers import MissingPeerError, open_peer
from sigmaslam_evaluation.metrics.trajectory_errors import absolute_trajectory_error, associate
from sigmaslam_evaluation.metrics.truth_covariance import truth_covariance
from sigmaslam_evaluation.truth_conventions import find_truth

WAYS = ("forward", "backwards", "mirror", "backwards mirror")
METHODS = ("ours", "cuvslam", "klt-pnp")
_MIRROR = np.diag([-1.0, 1.0, 1.0, 1.0])

Drive = tuple[StereoCamera, list[StereoFrame], np.ndarray]
"""Camera, pairs, and their true poses (N, 4, 4)."""


def open_drive(folder: Path) -> Drive:
    """A recording of rectified pairs whose every pair has a true pose."""
    sequence, truth = open_sequence(folder), read_trajectory(find_truth(folder))
    frames = list(sequence.frames())
    times = np.array([each.timestamp for each in frames])
    rows, there = associate(Trajectory(times, np.tile(np.eye(4), (len(times), 1, 1))), truth)
    return sequence.camera, [frames[k] for k in rows], truth.poses[there]


def turn(drive: Drive, way: str) -> Drive:
    """The drive, one of `WAYS`."""
    camera, frames, truth = drive
    if "backwards" in way:
        frames = [replace(there, timestamp=here.timestamp) for here, there in zip(frames, frames[::-1], strict=True)]
        truth = truth[::-1]
    if "mirror" in way:
        truth = _MIRROR @ truth @ camera.T_left_right @ _MIRROR
        other = _MIRROR @ np.linalg.inv(camera.T_left_right) @ _MIRROR
        frames = [replace(each, left=_flipped(each.right), right=_flipped(each.left)) for each in frames]
        camera = replace(camera, left=_seen(camera.right), right=_seen(camera.left), T_left_right=other)
    return camera, frames, truth


def _flipped(image: np.ndarray) -> np.ndarray:
    return np.ascontiguousarray(image[:, ::-1])


def _seen(model: CameraModel) -> CameraModel:
    """A camera without distortion in a mirror."""
    assert not any(model.distortion)
    return replace(model, cx=model.width - 1 - model.cx)


def track(drive: Drive, method: str) -> list[DrivenPose]:
    """What a method of `METHODS` says of each pair.

    Raises:
        MissingPeerError: it is not installed.
    """
    camera, frames, _ = drive
    if method == METHODS[0]:
        tracker = StereoTracker(camera, threads=1)
        return [
            DrivenPose(k, found.status, found.T_world_camera, found.covariance)
            for k, found in enumerate(tracker.step(each.left, each.right, each.timestamp) for each in frames)
        ]
    peer = open_peer(method, camera, [each.timestamp for each in frames])
    steps = [peer.step(each.left, each.right, each.timestamp) for each in frames]
    peer.close()
    nowhere = np.full((4, 4), np.nan)
    return [
        DrivenPose(k, each.status, nowhere if each.T_world_camera is None else each.T_world_camera, each.covariance)
        for k, each in enumerate(steps)
    ]


def describe(poses: Sequence[DrivenPose], drive: Drive, sigmas: tuple[float, float]) -> list[str]:
    """Cells of a row: frames with a pose, ATE, length, frames called `tracking` beyond 99.9 %, NEES."""
    _, frames, truth = drive
    kept = [k for k, each in enumerate(poses) if np.isfinite(each.T_world_camera).all()]
    times, found = np.array([frames[k].timestamp for k in kept]), np.array([poses[k].T_world_camera for k in kept])
    ate = absolute_trajectory_error(Trajectory(times, found), Trajectory(times, truth[kept])).rmse
    ways = [np.linalg.norm(np.diff(each[:, :3, 3], axis=0), axis=1).sum() for each in (found, truth[kept])]
    cells = [str(len(kept)), f"{1e3 * ate:.0f}", f"{100.0 * (ways[0] / ways[1] - 1.0):+.2f}"]
    if any(each.covariance is None for each in poses):
        return [*cells, "-", "-"]
    errors = pose_errors(poses, References(truth, truth_covariance(*sigmas)))
    is_tracked = np.array([each.status == "tracking" for each in poses])
    return [*cells, str(int((errors.beyond & is_tracked).sum())), f"{np.nanmean(errors.pose) / 6.0:.2f}"]


def main() -> None:
    """Tracks a recording all ways with ours and the peers that are installed, and prints the table."""
    parser = argparse.ArgumentParser(
        prog="python -m sigmaslam_benchmarks.tracking.other_ways",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("recording", type=Path, help="folder of rectified pairs, with its truth")
    parser.add_argument("--truth-sigmas", type=float, nargs=2, default=(0.0, 0.0), metavar=("M", "DEG"), help="of it")
    parser.add_argument("--methods", nargs="+", choices=METHODS, default=METHODS)
    arguments = parser.parse_args()
    drive = open_drive(arguments.recording)
    print("| way | method | frames with a pose | ATE mm | length % | `tracking` beyond 99.9 % | NEES |")
    print("|---|---|---:|---:|---:|---:|---:|")
    for way in WAYS:
        turned = turn(drive, way)
        for method in arguments.methods:
            try:
                cells = describe(track(turned, method), turned, arguments.truth_sigmas)
            except MissingPeerError as error:
                cells = [str(error), "", "", "", ""]
            print("|", " | ".join([way, method, *cells]), "|", flush=True)


if __name__ == "__main__":
    main()
